"""Columns of one track that grow message by message, and the track that they become.

Commands come as joint states or trajectories, and become the course that was commanded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modcal_core.geometry import Array
from modcal_core.measurements import JointTrack
from modcal_msgs_py.layout import Messages


class TrackRows:
    """Growing columns of one track by their names, eight bytes a number, however long a node listens.

    What was handed out of them stays as it is: later rows are written behind it, or to a larger copy.
    """

    def __init__(self) -> None:
        self._count = 0
        self._columns: dict[str, Array] = {}

    def __len__(self) -> int:
        """How many rows there are."""
        return self._count

    def extend(self, **columns: NDArray[Any]) -> None:
        """Add rows to all columns, the same ones each time: ``stamps`` and ``received`` (n,), others (n,) or (n, k)."""
        begin, end = self._count, self._count + len(columns["stamps"])
        for name, numbers in columns.items():
            known = self._columns.get(name)
            if known is None or end > len(known):
                known, old = np.empty((2 * end, *numbers.shape[1:])), known  # what is not written yet takes no memory
                if old is not None:
                    known[:begin] = old[:begin]
                self._columns[name] = known
            known[begin:end] = numbers
        self._count = end

    def forget_before(self, received: float) -> None:
        """Forget all rows but those since the first that was received at this time or later."""
        columns = self.columns()
        late = np.flatnonzero(columns["received"] >= received).tolist() if columns else []
        first = late[0] if late else self._count
        self._columns = {name: column[first:].copy() for name, column in columns.items()}
        self._count -= first

    def columns(self) -> dict[str, Array]:
        """The columns so far."""
        return {name: column[: self._count] for name, column in self._columns.items()}


JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
STATE_OF_CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
_REFERENCE = ("reference", "desired")  # of a controller's state, since Humble and before
_DENSE = 0.05  # s between the points that a trajectory is kept as
_LONGEST = 3600.0  # s that a trajectory may last; more is no time
_MAX_POINTS = 5000  # of one trajectory


@dataclass
class Commands:
    """Everything that was commanded so far, by topic and names."""

    _points: dict[tuple[str, tuple[str, ...]], TrackRows] = field(default_factory=dict)
    _plans: dict[tuple[str, tuple[str, ...]], list[tuple[float, Array, Array]]] = field(default_factory=dict)

    def take(self, topic: str, type_name: str, said: Messages, stamps: Array, received: Array) -> None:
        """Take messages with these stamps (n,) [s]. What names other joints than it has numbers for is passed over."""
        names = said.texts("name" if type_name == JOINT_STATE else "joint_names")
        if type_name == TRAJECTORY:
            at = [f"points[{i}]" for i in range(said.count("points"))]
            seconds = [f"{p}/time_from_start/sec" for p in at]
            nanoseconds = [f"{p}/time_from_start/nanosec" for p in at]
            clock = [said.column(s) + 1e-9 * said.column(ns) for s, ns in zip(seconds, nanoseconds, strict=True)]
            positions = [said.column(f"{p}/positions") for p in at]
            for k, (stamp, came) in enumerate(zip(stamps.tolist(), received.tolist(), strict=True)):
                self._plan(topic, names, stamp, came, [float(c[k, 0]) for c in clock], [p[k] for p in positions])
            return
        paths = ("position",) if type_name == JOINT_STATE else tuple(f"{name}/positions" for name in _REFERENCE)
        found = (said.column(path) for path in paths if said.has(path))
        told = next((values for values in found if values.shape[1]), None)
        if told is not None and names and told.shape[1] == len(names) == len(set(names)):
            rows = self._points.setdefault((topic, names), TrackRows())
            rows.extend(stamps=stamps, received=received, position=told)

    def _plan(
        self, topic: str, names: tuple[str, ...], stamp: float, received: float, times: list[float], points: list[Any]
    ) -> None:
        t = np.array(times, dtype=float)
        fits = 0 < len(t) <= _MAX_POINTS and all(len(p) == len(names) == len(set(names)) for p in points)
        if not fits or t[0] < 0.0 or not t[-1] < _LONGEST or not (np.diff(t) > 0.0).all():
            return
        x = np.array([np.asarray(p, dtype=float) for p in points])
        self._plans.setdefault((topic, names), []).append(
            (received, stamp + t, np.column_stack([np.full(len(t), stamp), x]))
        )

    def forget_before(self, received: float) -> None:
        """Forget what was received before this time [s], but for the last of each, which may hold still."""
        for rows in self._points.values():
            last = rows.columns()["received"][-1:]
            rows.forget_before(min(received, float(last[0])) if len(last) else received)
        for key, plans in self._plans.items():
            late = [plan for plan in plans if plan[0] >= received]
            self._plans[key] = late or plans[-1:]

    def tracks(self, order: Callable[[str], int]) -> tuple[JointTrack, ...]:
        """The commands as tracks of positions. order: of a topic, those of the lowest number first."""
        found = [(topic, _track(topic, names, **rows.columns())) for (topic, names), rows in self._points.items()]
        found += [(topic, _of_plans(topic, names, plans)) for (topic, names), plans in self._plans.items()]
        return tuple(track for topic, track in sorted(found, key=lambda pair: order(pair[0])))


def _of_plans(topic: str, names: tuple[str, ...], plans: list[tuple[float, Array, Array]]) -> JointTrack:
    """Commanded course of trajectories: each starts where the one before had arrived, and ends when the next begins."""
    plans = sorted(plans, key=lambda plan: float(plan[2][0, 0]))
    starts = [float(plan[2][0, 0]) for plan in plans]
    stamps: list[Array] = []
    positions: list[Array] = []
    for (_, t, values), until in zip(plans, [*starts[1:], np.inf], strict=True):
        x, start = values[:, 1:], float(values[0, 0])
        if positions and t[0] > start:
            t, x = np.r_[start, t], np.vstack([positions[-1][-1], x])
        at = np.unique(np.concatenate([*_between(t), [min(until, t[-1])]]))
        at = at[at <= until]
        if len(at) and at[0] < until:
            stamps.append(at)
            positions.append(np.stack([np.interp(at, t, column) for column in x.T], axis=1))
    t = np.concatenate(stamps) if stamps else np.empty(0)
    x = np.concatenate(positions) if positions else np.empty((0, len(names)))
    return _track(topic, names, t, np.full(len(t), np.nan), x)


def _between(t: Array) -> Iterator[Array]:
    """Stamps from one point of a trajectory to the next, close enough to be one course."""
    for first, last in pairwise(t.tolist()):
        yield np.linspace(first, last, int((last - first) / _DENSE) + 2)
    yield t[-1:]


def _track(topic: str, names: tuple[str, ...], stamps: Array, received: Array, position: Array) -> JointTrack:
    unknown = np.full(position.shape, np.nan)
    return JointTrack(names, stamps, position, unknown, unknown, received, topic)
