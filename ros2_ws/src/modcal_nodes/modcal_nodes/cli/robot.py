"""Which robot a verb is about: its description, its base and its tip."""

from __future__ import annotations

from pathlib import Path

import click

from modcal_core.errors import BadRobot
from modcal_core.measurements.recording import Recording
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import Mechanism
from modcal_core.robots.urdf import read_chain
from modcal_nodes.io.files import read_yaml

Robot = tuple[Mechanism, str | None]

BASE = click.option("--base", default=None, metavar="LINK", help="Where the arm begins. Default: the root link.")
TIP = click.option("--tip", default=None, metavar="LINK", help="Where it ends. Default: the link behind most joints.")
TOOL = click.option(
    "--tool", type=float, nargs=3, default=(0.05, 0.0, 0.1), show_default=True, metavar="X Y Z",
    help="What the tracker sees, in the tip [m].",
)  # fmt: skip


def read_robot(path: Path, base: str | None = None, tip: str | None = None) -> Chain:
    """The arm in a file: a kinematic table where its name ends in .yaml or .yml, else a URDF."""
    if path.suffix in (".yaml", ".yml"):
        if base is not None or tip is not None:
            raise BadRobot(str(path), "is a table, which is one arm from end to end", "leave out --base and --tip")
        from modcal_core.robots.tables import from_table  # few arms come as tables

        return from_table(read_yaml(path))
    return read_chain(path.read_text(encoding="utf-8", errors="replace"), base, tip)


def delta_of(recording: Recording, delta: Path | None, urdf: Path | None, base: str | None, tip: str | None) -> Robot:
    """The nominal robot and its URDF text: a Delta from its file, which has none, or else :func:`robot_of`."""
    if delta is None:
        return robot_of(recording, urdf, base, tip)
    if urdf is not None or base is not None or tip is not None:
        raise BadRobot(f"--delta {delta}", "goes with none of --urdf, --base and --tip", "leave them out")
    from modcal_nodes.io.inputs import read_delta  # brings SciPy along, which `modcal info` does without

    return read_delta(delta), None


def robot_of(recording: Recording, urdf: Path | None, base: str | None, tip: str | None) -> tuple[Chain, str]:
    """The nominal arm and its URDF text: from a file, or else from the recording's robot_description."""
    text = recording.robot_description if urdf is None else urdf.read_text(encoding="utf-8", errors="replace")
    if text is None:
        raise BadRobot(
            recording.source, "holds no robot_description", "give --urdf or --delta FILE, or record the topic"
        )
    recorded = frozenset(name for track in recording.joints for name in track.names)
    return read_chain(text, base, tip, recorded), text
