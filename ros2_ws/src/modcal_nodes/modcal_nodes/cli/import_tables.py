"""``modcal import``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from modcal_core.errors import BadTable, ModcalError, about
from modcal_core.files import read_yaml, write_file
from modcal_core.measurements.imported import remedies_of
from modcal_core.measurements.recording import IMPORTED, Recording
from modcal_core.robots.tables import from_table
from modcal_core.robots.urdf_elements import chain_urdf
from modcal_msgs_py.recording_write import write_recording
from modcal_msgs_py.tables import import_tables
from modcal_nodes.cli.console import Output, speaking, tell
from modcal_nodes.cli.export import read_table, told
from modcal_nodes.cli.robot import described

_EXISTING = click.Path(exists=True, path_type=Path)


@click.command("import")
@click.argument("mapping", type=_EXISTING)
@click.option("--data", type=_EXISTING, default=None, help="Folder of the tables. Default: the folder of MAPPING.")
@click.option("--urdf", type=_EXISTING, default=None, help="Robot description to put into the bag.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=None, help="The bag or URDF to write. Default: MAPPING's name."
)
@speaking
def import_command(mapping: Path, data: Path | None, urdf: Path | None, out: Path | None, output: Output) -> None:
    """Convert CSV tables into a bag, as described by MAPPING (a YAML file).

    A kinematic table (.csv, or .yaml that states a convention: dh, mdh or cpc) becomes a URDF, which every other verb
    takes.
    """
    table = read_table(mapping)
    if table is not None:
        with about(str(mapping)):
            chain = from_table(table)
        out = out or Path(f"{mapping.stem}.urdf")
        write_file(out, chain_urdf(chain))
        output.result(*told(out, chain))
        return
    stated = read_yaml(mapping)
    folder, out = data or mapping.parent, out or Path(mapping.stem)
    with output.working() as watch:
        recording = import_tables(stated, folder, mapping.name, partial(watch, "reading the tables"))
        recording = replace(recording, warnings=(f"{IMPORTED}{mapping.name}.", *recording.warnings))
        urdf = urdf or _stated_urdf(stated, mapping, folder)
        if urdf is not None:
            recording = replace(recording, robot_description=urdf.read_text(encoding="utf-8"))
            watch("comparing conventions")
            with remedies_of(recording.warnings):
                recording = _proved(recording, stated)
        write_recording(recording, out, partial(watch, f"writing {out.name}"))
    frames = list(recording.frames)
    found = {"bag": str(out), "stations": sum(len(r.stamps) for r in recording.readings), "frames": frames}
    line = f"{out}: {found['stations']} stations, {len(frames)} frame{'s' * (len(frames) != 1)}"
    output.result(found, partial(tell, [line]))


def _proved(recording: Recording, stated: Mapping[str, Any]) -> Recording:
    """The recording with a note where its poses are inverse.

    Raises BadRecording where another convention than the stated one fits the robot better beyond doubt.
    """
    from modcal_core.measurements.stations import cut_stations
    from modcal_core.plausibility.conventions import proved  # brings SciPy along, which kinematic tables do without

    try:
        chain = described(recording, None, None, None, None).mechanism
        samples = cut_stations(recording, chain.names)
    except ModcalError:  # of another robot, or with nothing in common: `modcal calibrate` says so where it matters
        return recording
    sequences = {str((t.get("pose") or {}).get("euler", {}).get("sequence", "")) for t in stated["tables"]}
    undone = proved(samples, chain, sequences.pop() or None if len(sequences) == 1 else None)[1]
    if undone is None:
        return recording
    note = "Poses look inverse (tracker in tool): `modcal calibrate` inverts them; state inverse: true on import."
    return replace(recording, warnings=(*recording.warnings, note))


def _stated_urdf(stated: dict[str, object], mapping: Path, folder: Path) -> Path | None:
    name = stated.get("urdf")
    if name is None:
        return None
    for root in (mapping.parent, folder):
        if (root / str(name)).is_file():
            return root / str(name)
    raise BadTable(f"{mapping.name}: urdf {name}", "is neither beside the mapping nor in --data", "correct the path")
