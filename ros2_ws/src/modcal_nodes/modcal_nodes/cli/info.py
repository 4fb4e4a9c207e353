"""``modcal info``."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from modcal_core.errors import ModcalError
from modcal_core.measurements.inspection import inspect
from modcal_msgs_py.mcap_read import read_bag
from modcal_nodes.cli.robot import delta_of

_EXISTING = click.Path(exists=True, path_type=Path)


@click.command("info")
@click.argument("bag", type=_EXISTING)
@click.option("--urdf", type=_EXISTING, default=None, help="Robot description. Default: the one in the bag.")
@click.option("--delta", type=_EXISTING, default=None, help="Description of a Delta robot instead.")
@click.option("--base", default=None, metavar="LINK")
@click.option("--tip", default=None, metavar="LINK")
def info_command(bag: Path, urdf: Path | None, delta: Path | None, base: str | None, tip: str | None) -> None:
    """Say what is in BAG, what it can be used for, and what looks wrong."""
    recording = read_bag(bag)
    console = Console(emoji=False)
    findings: tuple[str, ...] = ()
    try:
        chain, _ = delta_of(recording, delta, urdf, base, tip)
    except ModcalError as error:
        if any(given is not None for given in (urdf, delta, base, tip)):
            raise
        chain, findings = None, (f"No robot: {error}.",)
    seen = inspect(recording, chain)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name, side in (
        ("topic", "left"),
        ("what", "left"),
        ("messages", "right"),
        ("Hz", "right"),
        ("largest gap", "right"),
    ):
        table.add_column(name, justify=side, overflow="fold")  # type: ignore[arg-type]
    for track in seen.tracks:
        table.add_row(track.topic, track.what, str(track.count), f"{track.rate:.4g}", f"{track.largest_gap:.3g} s")
    console.print(table)
    console.print(f"{recording.duration:.1f} s")
    if chain is not None:
        console.print(f"robot: {chain.base} → {chain.tip}, {chain.n} joints", highlight=False)
    for use in seen.uses:
        console.print(f"can be used for {use}", style="green", highlight=False)
    for finding in (*findings, *seen.findings):
        console.print(finding, style="yellow", highlight=False)
