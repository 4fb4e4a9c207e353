"""The numbers of a reading in messages; what an instrument says of its own error."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modcal_core.errors import BadCommand, BadRecording
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import POSE, ReadingTrack, SignalTrack
from modcal_core.measurements.kinds import kinds
from modcal_msgs_py.layout import Messages, OneMessage
from modcal_msgs_py.topics import POSES
from modcal_msgs_py.track_rows import TrackRows

_WITH_COVARIANCE = ("geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry")
_PARTS = {  # where position and orientation stand
    "geometry_msgs/msg/PoseStamped": ("pose/position", "pose/orientation"),
    "geometry_msgs/msg/TransformStamped": ("transform/translation", "transform/rotation"),
    **{name: ("pose/pose/position", "pose/pose/orientation") for name in _WITH_COVARIANCE},
}
_PATHS = {
    "geometry_msgs/msg/PointStamped": [f"point/{a}" for a in "xyz"],
    "geometry_msgs/msg/Vector3Stamped": [f"vector/{a}" for a in "xyz"],
    "sensor_msgs/msg/Range": ["range"],
}


def paths_of(kind: str, type_name: str) -> list[str]:
    """Where the numbers of a reading of a kind stand in messages of this type."""
    if type_name not in _PARTS:
        return _PATHS[type_name]
    p, q = _PARTS[type_name]
    turn = [f"{q}/{a}" for a in "xyzw"] if kinds()[kind].message in POSES else []
    return [*(f"{p}/{a}" for a in "xyz"), *turn]


def values_of(kind: str, type_name: str, said: Messages) -> Array:
    """The numbers (n, k) of readings of a kind, out of messages of this type."""
    return np.hstack([said.column(path) for path in paths_of(kind, type_name)])


def reading_of(kind: str, message: Any) -> Array:
    """The numbers (k,) of a reading of a kind, out of a message of the kind's own type."""
    return np.asarray(values_of(kind, kinds()[kind].message, OneMessage(message))[0])


def stated_in(type_name: str, n: int, said: Messages) -> Array:
    """What messages of this type say of their own error, as :func:`deviations`, (n, 2)."""
    return deviations(said.column("pose/covariance")) if type_name in _WITH_COVARIANCE else np.full((n, 2), np.nan)


def deviations(covariance: Array) -> Array:
    """RMS over space of position [m] and angle [rad] of covariances (n, 36) as geometry_msgs lays them out, (n, 2).

    NaN where nothing, or nothing that can be, is stated: zeros, and the −1 of drivers that do not know.
    """
    C = covariance.reshape(-1, 6, 6)
    variances = np.stack([np.diagonal(C[:, k : k + 3, k : k + 3], axis1=1, axis2=2) for k in (0, 3)], axis=1)
    good = np.isfinite(variances).all(axis=2) & (variances >= 0.0).all(axis=2) & (variances.max(axis=2) > 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(good, np.sqrt(np.where(good[:, :, None], variances, 0.0).sum(axis=2)), np.nan)


def seconds(stamp: Any) -> float:
    """A builtin_interfaces/Time or Duration in seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def set_seconds(stamp: Any, value: float) -> None:
    """Write seconds into a builtin_interfaces/Time or Duration, to the nanosecond."""
    set_nanoseconds(stamp, round(value * 1e9))


def nanoseconds(stamp: Any) -> int:
    """A builtin_interfaces/Time in nanoseconds: exact, where seconds of today are off by up to 128 of them."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def set_nanoseconds(stamp: Any, value: int) -> None:
    """Write nanoseconds into a builtin_interfaces/Time or Duration."""
    stamp.sec, stamp.nanosec = divmod(value, 10**9)


_STEP = 1.0  # s between values that are kept
_MAX = 3600  # values; an effect may follow with a lag of many minutes
_MAX_NAMES = 64
_COLDEST, _HOTTEST = -273.15, 2000.0  # °C
_STALE = 10.0  # s
_SILENT = 60.0  # s without a value


class SignalsHeard:
    """What was received of every temperature, thinned to one value a second."""

    def __init__(self) -> None:
        self._values: dict[str, deque[tuple[float, float]]] = {}

    def hear_temperature(self, message: Any, now: float) -> None:
        """Take a Temperature received at ``now`` [s]. Raises BadCommand for one that cannot be."""
        name, value = f"temperature:{message.header.frame_id}", float(message.temperature)
        stamp = seconds(message.header.stamp) or now
        if not _COLDEST <= value <= _HOTTEST:
            raise BadCommand(name, f"{value:g} °C cannot be", "send degrees Celsius")
        if not abs(now - stamp) <= _STALE:
            raise BadCommand(name, f"its stamp is {abs(now - stamp):.3g} s off", "stamp it with this clock")
        if name not in self._values and len(self._values) >= _MAX_NAMES:
            raise BadCommand(name, f"{_MAX_NAMES} temperatures are received already", "publish fewer")
        kept = self._values.setdefault(name, deque(maxlen=_MAX))
        if kept and stamp < kept[-1][0]:  # the clock went back: what came before belongs to another time
            kept.clear()
        if len(kept) > 1 and stamp - kept[-2][0] < _STEP:
            kept.pop()  # the newest always stands last
        kept.append((stamp, value))

    def tracks(self, names: tuple[str, ...]) -> tuple[SignalTrack, ...]:
        """Tracks of those of these names that were received."""
        heard = {name: np.array(kept) for name in names if (kept := self._values.get(name))}
        return tuple(SignalTrack(name, rows[:, 0], rows[:, 1:]) for name, rows in heard.items())

    def silent(self, names: tuple[str, ...], now: float) -> tuple[str, ...]:
        """Those of the names that were received once, but not recently."""
        return tuple(n for n in names if self._values.get(n) and abs(now - self._values[n][-1][0]) > _SILENT)


# --- Readings out of /tf: how one frame moves in another, along the one way that leads from it to the other

_MAX_EDGES = 500
_UNIT = 0.5  # length of a quaternion below which a tracker has lost its target
_LONGEST_GAP = 0.25  # s between transforms that are interpolated; hands and carts are not that quick
_SHOWN = 8


@dataclass
class Transforms:
    """What /tf and /tf_static say; parent, child: frames that are asked for. notes: on the track, once it was made."""

    parent: str
    child: str
    notes: tuple[str, ...] = ()
    _edges: dict[tuple[str, str], TrackRows] = field(default_factory=dict)  # x y z qx qy qz qw [m] of one in another
    _static: set[tuple[str, str]] = field(default_factory=set)

    def add(self, parent: str, child: str, stamps: Array, received: Array, values: Array, static: bool) -> None:
        """Take transforms (n, 7) of one frame in another."""
        key = parent.strip("/"), child.strip("/")
        if key not in self._edges and len(self._edges) >= _MAX_EDGES:
            return
        if key not in self._edges and static:
            self._static.add(key)
        rows = self._edges.setdefault(key, TrackRows())
        rows.extend(stamps=np.where(stamps == 0.0, received, stamps), received=received, values=values)

    def forget_before(self, received: float) -> None:
        """Forget what was received before this time [s], but for what is static."""
        for key, rows in self._edges.items():
            if key not in self._static:
                rows.forget_before(received)

    def _once(self, key: tuple[str, str]) -> tuple[Array, Array, Array]:
        """Stamps (n,), received (n,), values (n, 7), in order, each stamp once."""
        columns = self._edges[key].columns()
        _, first = np.unique(columns["stamps"], return_index=True)
        return columns["stamps"][first], columns["received"][first], columns["values"][first]

    def track(self, description: str | None) -> ReadingTrack:
        """The child in the parent at the stamps of the one part of the way that moves, or of the slower one of two.

        description: the robot's, whose links must not be on the way but for fixed ones. Raises BadRecording.
        """
        name = f"tf {self.parent}:{self.child}"
        way = self._way()
        if way is None:
            there = ", ".join(f"{a}:{b}" for a, b in list(self._edges)[:_SHOWN]) or "nothing"
            raise BadRecording(name, "are not connected", f"name two frames that are; there are {there}")
        moving = {key: self._once(key) for key, _ in way if self._moves(key)}
        links = set() if description is None else set(re.findall(r"<link[^>]*\bname\s*=\s*[\"']([^\"']+)", description))
        if any(parent in links and child in links for parent, child in moving):
            said = "follows the robot's own links: it was computed from the joints and is not a measurement"
            raise BadRecording(name, said, "name the frames between which the tracker measures")
        if len(moving) not in (1, 2):
            said = "does not move" if not moving else f"is composed of {len(moving)} transforms that move"
            raise BadRecording(name, said, "name the frame of the tracker and that of its target, as it publishes them")
        if len(moving) == 2:
            parts = " and ".join(f"{parent}:{child}" for parent, child in moving)
            self.notes = (f"{name} is composed of two transforms that move, {parts}: the faster one is interpolated.",)
        stamps, received, _ = min(moving.values(), key=lambda columns: len(columns[0]))
        T = np.broadcast_to(np.eye(4), (len(stamps), 4, 4))
        for key, forward in way:
            step = _at(*moving[key][::2], stamps) if key in moving else _fixed(self._once(key)[2][-1])
            T = T @ (step if forward else se3.inverse(step))
        poses = np.full((len(stamps), 7), np.nan)
        finite = np.isfinite(T).all(axis=(1, 2))
        poses[finite] = se3.to_pose(T[finite])
        return ReadingTrack(POSE, self.parent, stamps, poses, received, "/tf")

    def _moves(self, key: tuple[str, str]) -> bool:
        values = self._edges[key].columns()["values"]
        return key not in self._static and len(values) > 1 and bool((values != values[0]).any())

    def _way(self) -> list[tuple[tuple[str, str], bool]] | None:
        """Pairs from parent to child, each with whether it is gone from its parent to its child."""
        ways: dict[str, list[tuple[tuple[str, str], bool]]] = {self.parent: []}
        reached = [self.parent]
        for here in reached:  # which grows meanwhile
            for a, b in self._edges:
                there = b if a == here else a if b == here else here
                if there not in ways:
                    ways[there] = [*ways[here], ((a, b), a == here)]
                    reached.append(there)
        return ways.get(self.child)


def _at(own: Array, values: Array, stamps: Array) -> Array:
    """Poses (n, 4, 4) at these stamps of x y z qx qy qz qw (m, 7) at stamps of their own; NaN without a neighbour near.

    Between two poses the place is interpolated linearly, the turn about one axis.
    """
    good = np.linalg.norm(values[:, 3:], axis=1) > _UNIT
    own, T = own[good], se3.from_pose(values[good])
    out = np.full((len(stamps), 4, 4), np.nan)
    if len(own) < 2:
        return out
    after = np.clip(np.searchsorted(own, stamps), 1, len(own) - 1)
    gap = own[after] - own[after - 1]
    near = np.isin(stamps, own) | ((stamps > own[0]) & (stamps < own[-1]) & (gap <= _LONGEST_GAP))
    first, last, share = T[after - 1][near], T[after][near], ((stamps - own[after - 1]) / gap)[near, None]
    turn = so3.log(np.swapaxes(first[:, :3, :3], 1, 2) @ last[:, :3, :3])
    place = first[:, :3, 3] + share * (last[:, :3, 3] - first[:, :3, 3])
    out[near] = se3.transform(first[:, :3, :3] @ so3.exp(share * turn), place)
    return out


def _fixed(values: Array) -> Array:
    """The pose (4, 4) of x y z qx qy qz qw (7,); NaN without an orientation."""
    return se3.from_pose(values) if np.linalg.norm(values[3:]) > _UNIT else np.full((4, 4), np.nan)
