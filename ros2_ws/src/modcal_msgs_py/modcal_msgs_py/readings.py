"""The numbers of a reading in messages; what an instrument says of its own error."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.measurements import SignalTrack
from modcal_core.measurements.kinds import kinds
from modcal_msgs_py.layout import Messages, OneMessage
from modcal_msgs_py.topics import POSES

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


def columns_of(kind: str, type_name: str, said: Messages) -> list[Array]:
    """The columns, (n, 1) each, of readings of a kind, out of messages of this type."""
    if type_name not in _PARTS:
        return [said.column(path) for path in _PATHS[type_name]]
    p, q = _PARTS[type_name]
    paths = [f"{p}/{a}" for a in "xyz"]
    if kinds()[kind].message in POSES:
        paths += [f"{q}/{a}" for a in "xyzw"]
    return [said.column(path) for path in paths]


def reading_of(kind: str, message: Any) -> Array:
    """The numbers (k,) of a reading of a kind, out of a message of the kind's own type."""
    return np.hstack(columns_of(kind, kinds()[kind].message, OneMessage(message)))[0]


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
    nanoseconds = round(value * 1e9)
    stamp.sec, stamp.nanosec = nanoseconds // 10**9, nanoseconds % 10**9


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
        out = []
        for name in names:
            if kept := self._values.get(name):
                stamps, values = np.array(kept).T
                out.append(SignalTrack(name, stamps, values[:, None]))
        return tuple(out)

    def silent(self, names: tuple[str, ...], now: float) -> tuple[str, ...]:
        """Those of the names that were received once, but not recently."""
        return tuple(n for n in names if self._values.get(n) and abs(now - self._values[n][-1][0]) > _SILENT)
