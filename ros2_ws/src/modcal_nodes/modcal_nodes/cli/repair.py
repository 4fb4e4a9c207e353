"""``modcal repair``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click
from rich.console import Console

from modcal_msgs_py import Repair, repair_bag
from modcal_nodes.cli.console import Output, speaking, table
from modcal_nodes.cli.inputs import WRITTEN


@click.command("repair")
@click.argument("bag", type=click.Path(exists=True, path_type=Path))
@click.option("--out", type=WRITTEN, help="The new bag. Default: BAG_repaired.")
@speaking
def repair_command(bag: Path, out: Path | None, output: Output) -> None:
    """Repair BAG, which was truncated: killed recorder, full disk, power failure.

    Every whole message is kept as it is. BAG itself is not changed; if it is intact, nothing is written.
    """
    if out is None:
        place = bag.resolve()
        out = place.parent / f"{place.stem if place.is_file() else place.name}_repaired"
    with output.working() as watch:
        done = repair_bag(bag, out, watch)
    data = {
        "bag": str(bag),
        "repaired": None if done.folder is None else str(done.folder),
        "reasons": list(done.reasons),
        "messages": dict(done.saved),
    }
    output.result(data, partial(_show, bag, done))


def _show(bag: Path, done: Repair, console: Console) -> None:
    count = sum(done.saved.values())
    if done.folder is None:
        console.print(f"{bag} is whole ({count} messages): nothing to repair")
        return
    for reason in done.reasons:
        console.print(reason, style="yellow")
    shown = table({"topic": "", "messages saved": ""})
    for topic, saved in done.saved.items():
        shown.add_row(topic, str(saved))
    console.print(shown)
    console.print(f"{done.folder}: {count} messages saved", style="bold")
