"""Which robot a verb is about: its description, its base and its tip."""

from __future__ import annotations

from pathlib import Path

import click

from modcal_core.errors import BadRobot
from modcal_core.files import read_yaml
from modcal_core.measurements.recording import Recording
from modcal_core.robot import Robot
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain

BASE = click.option("--base", default=None, metavar="LINK", help="Link where the arm begins. Default: the root link.")
TIP = click.option(
    "--tip", default=None, metavar="LINK", help="Link where it ends. Default: the link behind most joints."
)
TOOL = click.option(
    "--tool", type=float, nargs=3, default=(0.05, 0.0, 0.1), show_default=True, metavar="X Y Z",
    help="Position of the tracked target in the tip link [m].",
)  # fmt: skip


def read_robot(path: Path, base: str | None = None, tip: str | None = None) -> Chain:
    """The arm in a file: a kinematic table where its name ends in .yaml or .yml, else a URDF."""
    if path.suffix in (".yaml", ".yml"):
        if base is not None or tip is not None:
            raise BadRobot(str(path), "is a table, which describes one whole arm", "leave out --base and --tip")
        from modcal_core.robots.tables import from_table  # few arms come as tables

        return from_table(read_yaml(path))
    return read_chain(path.read_text(encoding="utf-8", errors="replace"), base, tip)


def described(recording: Recording, delta: Path | None, urdf: Path | None, base: str | None, tip: str | None) -> Robot:
    """The nominal robot: a Delta from its file, or an arm from a URDF or else from the recording's description."""
    if delta is not None:
        if urdf is not None or base is not None or tip is not None:
            raise BadRobot(f"--delta {delta}", "cannot be combined with --urdf, --base or --tip", "leave them out")
        return Robot.from_delta(delta)
    if urdf is None and recording.robot_description is None:
        raise BadRobot(
            recording.source, "holds no robot_description", "give --urdf or --delta FILE, or record the topic"
        )
    recorded = frozenset(name for track in recording.joints for name in track.names)
    return Robot.from_urdf(urdf or recording.robot_description or "", base, tip, recorded)
