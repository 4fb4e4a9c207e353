"""Commanded joints out of messages: joint states of commands, trajectories, and what a controller reports."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements import JointTrack
from modcal_msgs_py.layout import MessageLayout
from modcal_msgs_py.track_rows import TrackRows

JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
_REFERENCE = ("reference", "desired")  # of a controller's state, since Humble and before
_DENSE = 0.05  # s between the points that a trajectory is kept as
_LONGEST = 3600.0  # s that a trajectory may last; more is no time
_MAX_POINTS = 5000  # of one trajectory


@dataclass
class Commands:
    """Everything that was commanded so far, by topic and names."""

    _points: dict[tuple[str, tuple[str, ...]], TrackRows] = field(default_factory=dict)
    _plans: dict[tuple[str, tuple[str, ...]], list[tuple[float, Array, Array]]] = field(default_factory=dict)

    def add(self, topic: str, type_name: str, message: Any, stamp: float, received: float) -> None:
        """Take one message. What names other joints than it has numbers for says nothing, and is passed over."""
        if type_name == TRAJECTORY:
            times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points]
            self._plan(topic, tuple(message.joint_names), stamp, received, times, [p.positions for p in message.points])
            return
        names, positions = message.name if type_name == JOINT_STATE else message.joint_names, ()
        if type_name == JOINT_STATE:
            positions = message.position
        else:
            told = (getattr(getattr(message, name, None), "positions", ()) for name in _REFERENCE)
            positions = next((p for p in told if len(p)), ())
        self._state(topic, tuple(names), np.array([stamp]), np.array([received]), np.atleast_2d(positions))

    def add_rows(
        self, topic: str, type_name: str, layout: MessageLayout, stamps: Array, received: Array,
        column: Callable[[str], Array],
    ) -> None:  # fmt: skip
        """Take messages of one layout: ``add`` for each."""
        of = "name" if type_name == JOINT_STATE else "joint_names"
        names = tuple(layout.texts[f"{of}[{i}]"] for i in range(layout.counts.get(of, 0)))
        if type_name == TRAJECTORY:
            at = [f"points[{i}]" for i in range(layout.counts.get("points", 0))]
            clock = [column(f"{p}/time_from_start/sec") + 1e-9 * column(f"{p}/time_from_start/nanosec") for p in at]
            positions = [column(f"{p}/positions") for p in at]
            for k, (stamp, came) in enumerate(zip(stamps.tolist(), received.tolist(), strict=True)):
                self._plan(topic, names, stamp, came, [float(c[k, 0]) for c in clock], [p[k] for p in positions])
            return
        paths = ("position",) if type_name == JOINT_STATE else tuple(f"{name}/positions" for name in _REFERENCE)
        found = (column(path) for path in paths if path in layout.columns)
        told = next((values for values in found if values.shape[1]), None)
        if told is not None:
            self._state(topic, names, stamps, received, told)

    def _state(self, topic: str, names: tuple[str, ...], stamps: Array, received: Array, positions: Array) -> None:
        if names and positions.shape[1] == len(names) == len(set(names)):
            rows = self._points.setdefault((topic, names), TrackRows(len(names)))
            rows.extend(stamps, received, positions)

    def _plan(
        self, topic: str, names: tuple[str, ...], stamp: float, received: float, times: list[float], points: list[Any]
    ) -> None:
        t = np.array(times, dtype=float)
        if not len(t) or len(t) > _MAX_POINTS or len(set(names)) != len(names):
            return
        if any(len(p) != len(names) for p in points) or t[0] < 0.0 or not t[-1] < _LONGEST:
            return
        if not (np.diff(t) > 0.0).all():
            return
        x = np.array([np.asarray(p, dtype=float) for p in points])
        self._plans.setdefault((topic, names), []).append(
            (received, stamp + t, np.column_stack([np.full(len(t), stamp), x]))
        )

    def forget_before(self, received: float) -> None:
        """Forget what was received before this time [s], but for the last of each, which may hold still."""
        for rows in self._points.values():
            last = rows.columns()[1][-1:]
            rows.forget_before(min(received, float(last[0])) if len(last) else received)
        for key, plans in self._plans.items():
            late = [plan for plan in plans if plan[0] >= received]
            self._plans[key] = late or plans[-1:]

    def tracks(self, order: Callable[[str], int]) -> tuple[JointTrack, ...]:
        """The commands as tracks of positions. order: of a topic, those of the lowest number first."""
        found = [(topic, self._of_points(topic, names, rows)) for (topic, names), rows in self._points.items()]
        found += [(topic, _of_plans(topic, names, plans)) for (topic, names), plans in self._plans.items()]
        return tuple(track for topic, track in sorted(found, key=lambda pair: order(pair[0])))

    @staticmethod
    def _of_points(topic: str, names: tuple[str, ...], rows: TrackRows) -> JointTrack:
        stamps, received, position = rows.columns()
        return _track(topic, names, stamps, position, received)


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
    return _track(topic, names, t, x, np.full(len(t), np.nan))


def _between(t: Array) -> Iterator[Array]:
    """Stamps from one point of a trajectory to the next, close enough to be one course."""
    for first, last in pairwise(t.tolist()):
        yield np.linspace(first, last, int((last - first) / _DENSE) + 2)
    yield t[-1:]


def _track(topic: str, names: tuple[str, ...], stamps: Array, position: Array, received: Array) -> JointTrack:
    unknown = np.full(position.shape, np.nan)
    return JointTrack(names, stamps, position, unknown, unknown, received, topic)
