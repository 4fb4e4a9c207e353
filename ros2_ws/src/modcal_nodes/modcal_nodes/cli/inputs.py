"""Which robot a verb is about: its description, its base and its tip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import click

from modcal_core.errors import BadRobot, about
from modcal_core.files import read_yaml
from modcal_core.measurements import Recording
from modcal_core.robot import Robot
from modcal_core.robots import Mechanism, delta_from_data, other_tips, read_chain

_OTHERS = 3  # tips that are named

BASE = click.option("--base", metavar="LINK", help="Link where the arm begins. Default: the root link.")
TIP = click.option("--tip", metavar="LINK", help="Link where it ends. Default: the link behind most joints.")
TOOL = click.option(
    "--tool", type=float, nargs=3, default=(0.05, 0.0, 0.1), metavar="X Y Z",
    help="Position of the tracked target in the tip link [m].",
)  # fmt: skip


def chain_line(base: str, tip: str, joints: int, others: Sequence[str] = ()) -> str:
    """The chain that a verb works on, in a line. others: tips of other arms that might have been meant."""
    line = f"arm: {base} → {tip}, {joints} joint{'s' * (joints != 1)}"
    if others:
        line += (
            f"; --tip {' or --tip '.join(others[:_OTHERS])} for {'the other' if len(others) == 1 else 'another'} arm"
        )
    return line


def arm_line(robot: Robot) -> str:
    """The same of a robot."""
    return chain_line(robot.base, robot.tip, robot.n, robot.other_tips)


def file_line(path: Path, chain: Mechanism, tip: str | None = None) -> str:
    """The same of an arm that was read from a file. tip: as it was given."""
    of_urdf = tip is None and path.suffix not in (".yaml", ".yml")
    others = other_tips(path.read_text(encoding="utf-8", errors="replace"), chain.base) if of_urdf else ()
    return chain_line(chain.base, chain.tip, chain.n, others)


def read_robot(path: Path, base: str | None = None, tip: str | None = None) -> Mechanism:
    """The robot in a file: a kinematic table or a Delta where its name ends in .yaml or .yml, else a URDF's arm."""
    if path.suffix in (".yaml", ".yml"):
        if base is not None or tip is not None:
            raise BadRobot(str(path), "is a table, which describes one whole arm", "leave out --base and --tip")
        from modcal_core.robots import from_table  # few arms come as tables

        data = read_yaml(path)
        if isinstance(data, Mapping) and "modcal_delta" in data:
            return delta_from_data(data, str(path))
        with about(str(path)):
            return from_table(data)
    with about(str(path)):
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
    with about(f"{recording.source}, robot_description" if urdf is None else str(urdf)):
        return Robot.from_urdf(urdf or recording.robot_description or "", base, tip, recorded)


# --- ``--topic``, ``--ignore`` and ``--tf``

TOPICS = (
    click.option(
        "--topic", "topic", multiple=True, metavar="ROLE=NAME",
        help="The topic for a role, e.g. tracker/pose=/vrpn/tool/pose. Repeatable.",
    ),
    click.option("--ignore", "ignore", multiple=True, metavar="TOPIC", help="Leave a topic out. Repeatable."),
    click.option(
        "--tf", "tf", metavar="PARENT:CHILD", help="The tracker's readings are these frames in /tf, e.g. tracker:tool."
    ),
)  # fmt: skip


# --- Kinds of paths that verbs are given


class _Named(click.Path):
    """A path that is not the empty text, which would be the folder where the command runs."""

    def convert(
        self, value: str | PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:  # what click declares: a path of path_type
        """The path. Refuses the empty text."""
        if str(value) == "":
            self.fail("is empty, as an unset variable of a script is; name what shall be written", param, ctx)
        return super().convert(value, param, ctx)


EXISTING = click.Path(exists=True, path_type=Path)
WRITTEN = _Named(path_type=Path)
