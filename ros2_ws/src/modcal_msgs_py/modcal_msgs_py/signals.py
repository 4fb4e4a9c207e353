"""Temperatures as they come over the wire, as the tracks that effects are driven by."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.measurements.recording import SignalTrack
from modcal_msgs_py.stamps import seconds

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
