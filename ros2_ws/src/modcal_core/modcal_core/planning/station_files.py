"""Stations and trajectories as files hold them: joints by name, a list of positions a station."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.errors import BadCommand, BadTable
from modcal_core.geometry import Array
from modcal_core.robots import vector
from modcal_core.schema import NUMBER, TEXT, holding, list_of, require, stated

_STATIONS = list_of(holding(("position",)))
_SCHEMA = holding(
    ("modcal_plan", "joints"),
    modcal_plan={"enum": [1]},
    joints=list_of(TEXT),
    stations=_STATIONS,
    ties=list_of(holding((), stations=_STATIONS)),
)
_PLAN = "give the plan.yaml that modcal plan wrote"


def stations_from_data(data: Any, names: Sequence[str], source: str) -> Array:
    """Postures (N, n) [rad, m] of these joints in what a plan.yaml holds. Raises BadTable."""
    data = stated(data)
    require(data, _SCHEMA, source, _PLAN)
    rows = [*data.get("stations", ()), *(s for tie in data.get("ties", ()) for s in tie.get("stations") or ())]
    found = {f"{source}, station {i + 1}": row["position"] for i, row in enumerate(rows)}
    return _of_joints(data["joints"], found, names, source)


def stations_from_rows(rows: Sequence[Sequence[str]], names: Sequence[str], source: str) -> Array:
    """Postures (N, n) [rad, m] of these joints in a table whose first row names its columns. Raises BadTable."""
    head = [cell.strip() for cell in rows[0]] if rows else []
    wanted = [k for k, name in enumerate(head) if name in names]
    found = {
        f"{source}, row {i}": [row[k] if k < len(row) else "" for k in wanted]
        for i, row in enumerate(rows[1:], 2)
        if any(cell.strip() for cell in row)
    }
    return _of_joints([head[k] for k in wanted], found, names, source)


def _of_joints(joints: Sequence[str], rows: Mapping[str, Any], names: Sequence[str], source: str) -> Array:
    for name in names:
        if list(joints).count(name) != 1:
            raise BadTable(f"{source}: joint {name}", "is not named once", f"name {', '.join(names)}")
    values = [vector(row, len(joints), where) for where, row in rows.items()]
    if not values:
        raise BadTable(source, "holds no station", "give one row a station")
    return np.stack(values)[:, [list(joints).index(name) for name in names]]


# --- A trajectory as ``modcal plan`` writes it, read back and checked, and led up to from where the arm stands

_RISE = 1.5  # peak of a cubic's speed over its mean
_MIN_LEAD = 0.5  # s from the start to the first point
_MAX_POINTS = 100_000  # of a file, for memory
_TIME = holding(("sec", "nanosec"), sec=NUMBER, nanosec=NUMBER)
_PLACED = holding(("positions", "time_from_start"), positions=list_of(NUMBER), time_from_start=_TIME)
_TRAJECTORY = holding(("joint_names", "points"), joint_names=list_of(TEXT, 1), points=list_of(_PLACED, 1, _MAX_POINTS))
_FORM = "give joint_names and points with positions and time_from_start, as modcal plan writes them"


@dataclass(frozen=True)
class Trajectory:
    """Postures q (k, n) [rad, m] of these joints at times t (k,) [s], at rest at each of them."""

    names: tuple[str, ...]
    t: Array
    q: Array

    def led_up_to(self, position: Array, speed: float, farthest: float) -> Trajectory:
        """The trajectory, its first point reached from ``position`` (n,) at no more than ``speed`` [rad/s, m/s]. Raises
        BadCommand where a joint would have to go farther than ``farthest`` [rad, m]: nobody has looked at that way.
        """
        off = np.abs(self.q[0] - position)
        if not off.max() <= farthest:
            worst = int(np.argmax(off))
            said = f"is {off[worst]:.3g} from the first point, {farthest:g} is the limit"
            raise BadCommand(f"joint {self.names[worst]}", said, "bring the arm to the first point before")
        lead = max(_RISE * float(off.max()) / speed, _MIN_LEAD)
        return Trajectory(self.names, self.t - self.t[0] + lead, self.q)


def trajectory_from_data(data: Any, source: str) -> Trajectory:
    """The trajectory in the content of a YAML file; raises BadTable for anything that is not one."""
    require(data, _TRAJECTORY, source, _FORM)
    names, points = tuple(data["joint_names"]), data["points"]
    if len(set(names)) < len(names) or any(len(point["positions"]) != len(names) for point in points):
        raise BadTable(source, f"its positions are not one of each joint ({', '.join(names)})", _FORM)
    q = np.array([point["positions"] for point in points], dtype=float)
    t = np.array([point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"] for point in points])
    if t[0] < 0.0 or not (np.diff(t) > 0.0).all():
        raise BadTable(source, "its times do not rise from zero", _FORM)
    return Trajectory(names, t, q)
