"""``modcal info`` and ``modcal import``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from modcal_core.errors import BadTable, ModcalError
from modcal_core.measurements.inspection import inspect
from modcal_msgs_py.mcap_read import read_bag
from modcal_msgs_py.recording_write import write_recording
from modcal_msgs_py.tables import import_tables
from modcal_nodes.cli.robot import robot_of
from modcal_nodes.files import read_yaml

_EXISTING = click.Path(exists=True, path_type=Path)


@click.command("info")
@click.argument("bag", type=_EXISTING)
@click.option("--urdf", type=_EXISTING, default=None, help="Robot description. Default: the one in the bag.")
@click.option("--base", default=None, metavar="LINK")
@click.option("--tip", default=None, metavar="LINK")
def info_command(bag: Path, urdf: Path | None, base: str | None, tip: str | None) -> None:
    """Say what is in BAG, what it can be used for, and what looks wrong."""
    recording = read_bag(bag)
    console = Console()
    findings: tuple[str, ...] = ()
    try:
        chain, _ = robot_of(recording, urdf, base, tip)
    except ModcalError as error:
        if urdf is not None or base is not None or tip is not None:
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


@click.command("import")
@click.argument("mapping", type=_EXISTING)
@click.option("--data", type=_EXISTING, default=None, help="Folder of the tables. Default: that of MAPPING.")
@click.option("--urdf", type=_EXISTING, default=None, help="Robot description to put into the bag.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="The bag. Default: the mapping's name.")
def import_command(mapping: Path, data: Path | None, urdf: Path | None, out: Path | None) -> None:
    """Turn CSV tables into a bag, as MAPPING (a YAML file) says."""
    stated = read_yaml(mapping)
    folder = data or mapping.parent
    recording = import_tables(stated, folder, mapping.name)
    urdf = urdf or _stated_urdf(stated, mapping, folder)
    if urdf is not None:
        recording = replace(recording, robot_description=urdf.read_text(encoding="utf-8"))
    out = out or Path(mapping.stem)
    write_recording(recording, out)
    count = sum(len(r.stamps) for r in recording.readings)
    click.echo(f"{out}: {count} stations, {len(recording.frames)} frame{'s' * (len(recording.frames) != 1)}")


def _stated_urdf(stated: dict[str, object], mapping: Path, folder: Path) -> Path | None:
    name = stated.get("urdf")
    if name is None:
        return None
    for root in (mapping.parent, folder):
        if (root / str(name)).is_file():
            return root / str(name)
    raise BadTable(f"{mapping.name}: urdf {name}", "is neither beside the mapping nor in --data", "correct the path")
