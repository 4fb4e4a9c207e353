"""Stations and trajectories as files hold them: joints by name, a list of positions a station."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.errors import BadCommand, BadTable
from modcal_core.geometry import Array
from modcal_core.robots import vector
from modcal_core.schema import TEXT, list_of, require, stated

_STATIONS = list_of({"type": "object", "required": ("position",)})
_SCHEMA = {
    "type": "object",
    "required": ("modcal_plan", "joints"),
    "properties": {
        "modcal_plan": {"enum": [1]},
        "joints": list_of(TEXT),
        "stations": _STATIONS,
        "ties": list_of({"type": "object", "properties": {"stations": _STATIONS}}),
    },
}
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
_FORM = "give joint_names and points with positions and time_from_start, as modcal plan writes them"


@dataclass(frozen=True)
class Trajectory:
    """Postures q (k, n) [rad, m] of these joints at times t (k,) [s], at rest at each of them."""

    names: tuple[str, ...]
    t: Array
    q: Array

    def led_up_to(self, position: Array, speed: float, farthest: float) -> Trajectory:
        """The trajectory, its first point reached from ``position`` (n,) at no more than ``speed`` [rad/s, m/s].

        Raises BadCommand where a joint would have to go farther than ``farthest`` [rad, m]: nobody has looked at that
        way.
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
    try:
        if not isinstance(data, Mapping):
            raise TypeError(f"{type(data).__name__} at the top")
        names = tuple(str(name) for name in data["joint_names"])
        points = list(data["points"])
        if not points or len(points) > _MAX_POINTS or not names or len(set(names)) != len(names):
            raise ValueError(f"{len(points)} points for joints {', '.join(names)}")
        q = np.array([[float(x) for x in point["positions"]] for point in points])
        after = [point["time_from_start"] for point in points]
        t = np.array([float(d["sec"]) + 1e-9 * float(d["nanosec"]) for d in after])
    except (KeyError, TypeError, ValueError) as error:
        raise BadTable(source, f"is not a trajectory ({error!r})", _FORM) from error
    if q.shape != (len(points), len(names)) or not (np.isfinite(q).all() and np.isfinite(t).all()):
        raise BadTable(source, f"its positions are not {len(names)} finite numbers each", _FORM)
    if t[0] < 0.0 or not (np.diff(t) > 0.0).all():
        raise BadTable(source, "its times do not rise from zero", _FORM)
    return Trajectory(names, t, q)
