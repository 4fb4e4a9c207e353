"""What verbs are given: robots, numbers by joint, and stations."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadRecording, BadRobot, BadTable, about
from modcal_core.files import read_yaml
from modcal_core.geometry import Array
from modcal_core.measurements import Recording
from modcal_core.robot import Robot
from modcal_core.robots import Mechanism, from_csv

_OTHERS = 3  # tips that are named


def chain_line(base: str, tip: str, joints: int, others: Sequence[str] = ()) -> str:
    """The chain that a verb works on, in a line. others: tips of other arms that might have been meant."""
    line = f"arm: {base} → {tip}, {joints} joint{'s' * (joints != 1)}"
    if others:
        which = "the other" if len(others) == 1 else "another"
        line += f"; --tip {' or --tip '.join(others[:_OTHERS])} for {which} arm"
    return line


def arm_line(robot: Robot) -> str:
    """The same of a robot."""
    return chain_line(robot.base, robot.tip, robot.n, robot.other_tips)


def read_robot(path: Path, base: str | None = None, tip: str | None = None) -> Robot:
    """The robot in a file: a kinematic table or a Delta in YAML or CSV, by the end of its name, else a URDF's arm."""
    with about(str(path)):
        if path.suffix.lower() not in (".yaml", ".yml", ".csv"):
            return Robot.from_urdf(path, base, tip)
        if base is not None or tip is not None:
            raise BadRobot(str(path), "is a table, which describes one whole arm", "leave out --base and --tip")
        data = read_table(path)
        is_delta = isinstance(data, Mapping) and "modcal_delta" in data
        return Robot.from_delta(path) if is_delta else Robot.from_table(data)


def read_table(path: Path) -> Any:
    """The kinematic table in a .csv file, or whatever is in a YAML file. Raises BadTable."""
    if path.suffix.lower() == ".csv":
        return from_csv(path.read_text(encoding="utf-8", errors="replace"), path.name)
    return read_yaml(path)


def described(recording: Recording, delta: Path | None, urdf: Path | None, base: str | None, tip: str | None) -> Robot:
    """The nominal robot: a Delta from its file, or an arm from a URDF or else from the recording's description."""
    if delta is not None:
        if urdf is not None or base is not None or tip is not None:
            raise BadRobot(f"--delta {delta}", "cannot be combined with --urdf, --base or --tip", "leave them out")
        return Robot.from_delta(delta)
    if urdf is None and recording.robot_description is None:
        remedy = "give --urdf or --delta FILE, or record the topic"
        raise BadRobot(recording.source, "holds no robot_description", remedy)
    recorded = frozenset(name for track in recording.joints for name in track.names)
    if urdf is None and base is None and tip is None and recording.arm is not None:
        base, tip = recording.arm
    with about(f"{recording.source}, robot_description" if urdf is None else str(urdf)):
        return Robot.from_urdf(urdf or recording.robot_description or "", base, tip, recorded)


def whole_rows(recording: Recording, names: Sequence[str], q: Array) -> np.ndarray:
    """Rows of joint positions (N, n) in which every joint has one, (N,). Raises BadRecording where there is none."""
    whole = np.isfinite(q).all(axis=1)
    if not whole.any():
        missing = [name for name, x in zip(names, q.T, strict=True) if not np.isfinite(x).any()] or ["all at once"]
        where = f"{recording.source}, joint_states"
        raise BadRecording(where, f"do not contain {', '.join(missing)}", "give another --tip")
    return np.asarray(whole)


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
