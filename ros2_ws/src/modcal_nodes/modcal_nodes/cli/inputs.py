"""What verbs are given: robots, topics, paths, numbers and stations."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.errors import BadRobot, BadTable, about
from modcal_core.files import read_yaml
from modcal_core.geometry import Array
from modcal_core.measurements import Recording
from modcal_core.robot import Robot
from modcal_core.robots import Mechanism, delta_from_data, other_tips, read_chain
from modcal_msgs_py import Topics
from modcal_nodes.cli.console import option, repeated

_OTHERS = 3  # tips that are named


@dataclass(frozen=True)
class ChainOptions:
    """Where an arm begins and ends."""

    base: str | None = option("Link where the arm begins. Default: the root link.", metavar="LINK")
    tip: str | None = option("Link where it ends. Default: the link behind most joints.", metavar="LINK")


@dataclass(frozen=True)
class TopicOptions:
    """What the topics of a bag are."""

    topic: tuple[str, ...] = repeated(
        "The topic for a role, e.g. tracker/pose=/vrpn/tool/pose. Repeatable.", "ROLE=NAME"
    )
    ignore: tuple[str, ...] = repeated("Leave a topic out. Repeatable.", "TOPIC")
    tf: str | None = option(
        "The tracker's readings are these frames in /tf, e.g. tracker:tool.", metavar="PARENT:CHILD"
    )

    @property
    def topics(self) -> Topics:
        """The same as readers of bags take it."""
        return Topics.of(self.topic, self.ignore, self.tf)


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
    if urdf is None and base is None and tip is None and recording.arm is not None:
        base, tip = recording.arm
    with about(f"{recording.source}, robot_description" if urdf is None else str(urdf)):
        return Robot.from_urdf(urdf or recording.robot_description or "", base, tip, recorded)


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


_BEGIN = re.compile(r"[+-]?\d+(\.\d+)?")  # of what somebody wrote with a comma or a unit


class Decimal(click.FloatRange):
    """A finite number within a range."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, or a refusal that says how to write it."""
        try:
            number = float(value)
        except ValueError:
            pointed = str(value).strip().replace(",", ".")
            begin = _BEGIN.match(pointed)
            meant = f": write {pointed if _reads(pointed) else begin[0]}" if begin else ""
            self.fail(f"{value!r} is not a number{meant}.", param, ctx)
        if not isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return super().convert(number, param, ctx)


class Whole(click.IntRange):
    """A whole number within a range."""

    name = "whole number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, or a refusal."""
        try:
            number = int(value)
        except ValueError:
            self.fail(f"{value!r} is not a whole number.", param, ctx)
        return super().convert(number, param, ctx)


def _reads(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


def numbers_by_joint(said: Iterable[str], option: str) -> dict[str, float]:
    """JOINT=NUMBER texts as numbers by joint; empty ones are passed over. Raises BadTable, naming the option."""
    out: dict[str, float] = {}
    for text in filter(None, said):
        name, _, number = text.partition("=")
        try:
            out[name] = float(number)
        except ValueError:
            out[name] = np.nan
        if not name or not np.isfinite(out[name]):
            raise BadTable(f"{option} {text}", "is not JOINT=NUMBER", "write it as elbow_joint=1.2")
    return out


def read_stations(path: Path, chain: Mechanism) -> Array:
    """Postures (N, n) [rad, m] in a plan.yaml, or in a CSV file whose head names the joints. Raises BadTable."""
    from modcal_core.planning import stations_from_data, stations_from_rows  # few verbs plan

    if path.suffix == ".csv":
        with path.open(encoding="utf-8", errors="replace", newline="") as stream:
            return stations_from_rows(list(csv.reader(stream)), chain.names, str(path))
    return stations_from_data(read_yaml(path), chain.names, str(path))
