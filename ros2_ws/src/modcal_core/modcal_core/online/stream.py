"""Joint states and readings as they come; samples as soon as they are whole.

The same three ways as in a recording (:mod:`modcal_core.measurements.pairing`), without its end being known: readings
taken while the arm stands still are averaged once it has moved on, over what the same detector of dwells finds;
readings that carry the stamp of a joint state are paired with it where messages are sparse; on an arm that never stops
a reading gets the posture interpolated to its stamp. Memory does not grow: a few seconds of messages are held.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, so3
from modcal_core.measurements import (
    BURST,
    LATE_STEPS,
    LONGEST_PAUSE,
    NOISE_FACTOR,
    POSE,
    SECOND_DIFFERENCE,
    SHORTEST,
    SMALLEST_BURST,
    Approach,
    JointTrack,
    ReadingTrack,
    Samples,
    StationRules,
    averaged,
    find_dwells,
    fitted_rules,
    following,
)
from modcal_core.measurements.kinds import KIND_NAMES, kinds

_COMMANDS = 4096  # 4 s at 1 kHz, and any stand at the usual rates
_HELD = 8192  # joint states, and readings of each frame


class LatestRows:
    """The last rows of some columns (n), by their stamps [s]."""

    def __init__(self, columns: int, held: int) -> None:
        self._held = held
        self._t, self._x = np.empty(2 * held), np.empty((2 * held, columns))
        self._first = self._end = 0

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def t(self) -> Array:
        """Stamps (k,) [s]."""
        return self._t[self._first : self._end]

    @property
    def x(self) -> Array:
        """Rows (k, n)."""
        return self._x[self._first : self._end]

    def add(self, stamps: Array, rows: Array) -> None:
        """Take rows (k, n) at rising stamps (k,), NaN for what stays as it was; later ones are replaced.

        So a trajectory takes the place of what is left of the one before.
        """
        stamps, rows = stamps[-self._held :], rows[-self._held :]
        if not len(stamps):
            return
        self._end = self._first + int(np.searchsorted(self.t, stamps[0]))
        if self._end + len(stamps) > len(self._t):
            kept = min(self._held, len(self))
            self._t[:kept], self._x[:kept] = self.t[-kept:].copy(), self.x[-kept:].copy()
            self._first, self._end = 0, kept
        if len(self):
            rows = np.where(np.isfinite(rows), rows, self.x[-1])
        at = slice(self._end, self._end + len(stamps))
        self._t[at], self._x[at] = stamps, rows
        self._end = at.stop
        self._first = max(self._first, self._end - self._held)

    def following(self, t: Array, q: Array, span: tuple[float, float]) -> Array:
        """Of commands: commanded − measured (n,) over a span [s]; NaN where unknown. t (m,), q (m, n): joint states
        about it.
        """
        about = slice(max(int(np.searchsorted(t, span[0])) - 1, 0), int(np.searchsorted(t, span[1], side="right")) + 1)
        t, q, told = t[about], q[about], self.t
        if not len(told) or not len(t) or t[-1] < told[0]:
            return np.full(self._x.shape[1], np.nan)
        since = max(int(np.searchsorted(told, t[0], side="right")) - 1, 0)
        rows = slice(since, int(np.searchsorted(told, t[-1], side="right")) + 1)
        names, unknown = tuple(map(str, range(q.shape[1]))), np.full_like(self.x[rows], np.nan)
        track = JointTrack(names, told[rows], self.x[rows], unknown, unknown, unknown[:, 0])
        return following((track,), names, t, q, np.array([span]))[0]


_LONGEST = 3.0  # s of standing still that make one sample; a longer stand makes several
_JUMP = 1.0  # s; a stamp that lies this far before the last one is a clock that was set back, not a late message
_RESTLESS = 30.0  # s without a stand after which readings in motion are used
_STENCIL = 0.01  # s on either side of a reading that its posture is interpolated from ...
_EITHER_SIDE = 2  # ... and, where joint states are farther apart, so many on either side at least
_UNIT = 1e-3  # how far from 1 a quaternion's norm may be; drivers round to four digits at worst
_STEPS = 15  # between joint states, whose median is the usual one: a silence is none
_STANDS = 40  # of late, by which it is known how long this arm stands
_AVERAGED = ("q", "reading", "R", "sigma_position", "sigma_rotation")
_BEFORE = 1.0  # s of joint states before a stand that its beginning is looked for in


@dataclass
class Counts:
    """What was left out, or stamped again, by reason."""

    late: int = 0
    jumps: int = 0
    unpaired: int = 0
    bursts: int = 0  # of readings that were handed over together, whose stamps were spread


@dataclass
class _Readings:
    """Readings of one frame that are not used up."""

    waiting: deque[tuple[float, Array]] = field(default_factory=lambda: deque(maxlen=_HELD))
    last: float = -np.inf
    before: float = -np.inf  # when the one before the present burst came
    first: float = -np.inf  # of those that came within a moment of each other, to the last one
    burst: int = 0  # how many they are

    def add(self, stamp: float, values: Array) -> bool:
        """Take a reading; whether it shows a burst.

        Readings of a burst share the time since the one before it, as in a recording (:func:`without_bursts`).
        """
        if stamp - self.last > BURST:
            self.before, self.first, self.burst = self.last, stamp, 0
        self.last, self.burst = stamp, self.burst + 1
        self.waiting.append((stamp, values))
        pause = self.first - self.before
        if self.burst < SMALLEST_BURST or not stamp - self.first <= pause <= LONGEST_PAUSE:
            return False
        for k in range(min(self.burst, len(self.waiting))):
            at = stamp - k * (stamp - self.before) / self.burst
            self.waiting[-1 - k] = at, self.waiting[-1 - k][1]
        return self.burst == SMALLEST_BURST


@dataclass(frozen=True)
class _Ended:
    """A stand that has just ended, at a stamp [s], the approach directions (n,) and the path of the joints."""

    since: float
    stamp: float
    approach: Array
    path: Array


class SampleStream:
    """Samples of one arm from messages as they arrive. Stamps in seconds, joints in the order of ``names``."""

    def __init__(self, names: tuple[str, ...], rules: StationRules | None = None) -> None:
        self.names = names
        self.frames: list[str] = []  # names of the frames that are expected; others are added behind them
        self.counts = Counts()
        self._asked = self._rules = rules or StationRules()
        self._station = 0
        self._readings: dict[tuple[str, str], _Readings] = {}
        self._forget()

    def _forget(self) -> None:
        n = len(self.names)
        self._states = LatestRows(2 * n, _HELD)  # positions and efforts
        self._commands = LatestRows(n, _COMMANDS)
        self._low = self._high = np.zeros(n)
        self._since = self._began = -np.inf  # when the present stand began, and the stream
        self._stood = self._used = -np.inf  # when the last stand ended, and up to when readings have been averaged
        self._ended: _Ended | None = None
        self._approach = Approach()
        self._stands: deque[tuple[float, float]] = deque(maxlen=_STANDS)  # when, and how long [s]
        self._rules = self._asked
        self._steps: deque[float] = deque(maxlen=_STEPS)
        self._step = np.nan
        self._noise = np.zeros(n)
        self._ready: list[Samples] = []
        for readings in self._readings.values():
            readings.waiting.clear()
            readings.last = readings.before = -np.inf

    @property
    def _q(self) -> Array:
        return self._states.x[:, : len(self.names)]

    @property
    def _effort(self) -> Array:
        return self._states.x[:, len(self.names) :]

    def joint_state(self, stamp: float, q: Array, effort: Array | None = None) -> None:
        """Take one joint state, q (n,) [rad, m]. Raises BadRecording for a position that is not finite."""
        if not (np.isfinite(q).all() and np.isfinite(stamp)):
            worst = self.names[int(np.argmin(np.isfinite(q)))]
            raise BadRecording(f"joint {worst}", "position is not finite", "fix the driver; the message is left out")
        last = self._states.t[-1] if len(self._states) else -np.inf
        if stamp < last - _JUMP:
            self._forget()
            self.counts.jumps += 1
        elif stamp <= last:
            self.counts.late += 1
            return
        # a stand's mean must not be lost to an effort that is not finite: the last one stays
        efforts = np.full(len(q), np.nan) if effort is None else effort
        self._states.add(np.array([stamp]), np.r_[q, efforts][None])
        self._watch_motion(stamp, q)

    def command(self, stamps: Array, positions: Array) -> None:
        """Take what the joints are told: positions (k, n) [rad, m], NaN where not named, at rising stamps (k,)."""
        self._commands.add(stamps, positions)

    def reading(self, kind: str, frame: str, stamp: float, values: Array) -> None:
        """Take one reading, as wide as its kind. Raises BadRecording for one that is not finite or no rotation."""
        if len(values) != kinds()[kind].width or not (np.isfinite(values).all() and np.isfinite(stamp)):
            raise BadRecording(f"{kind} in {frame}", "is not finite", "leave out readings without a target")
        if kind == POSE and abs(float(np.linalg.norm(values[3:])) - 1.0) > _UNIT:
            raise BadRecording(
                f"pose in {frame}",
                f"its quaternion has length {np.linalg.norm(values[3:]):.3f}",
                "publish unit quaternions x y z w",
            )
        if frame not in self.frames:
            self.frames.append(frame)
        readings = self._readings.setdefault((kind, frame), _Readings())
        if stamp < readings.last - _JUMP:
            readings.waiting.clear()
        elif stamp <= readings.last:
            self.counts.late += 1
            return
        self.counts.unpaired += len(readings.waiting) == readings.waiting.maxlen
        self.counts.bursts += readings.add(stamp, np.array(values, dtype=float))

    def take(self) -> list[Samples]:
        """The samples that have become whole since the last time, one row each, in the order of their stamps."""
        for (kind, frame), readings in self._readings.items() if len(self._states) > 1 else ():
            self._pair_or_interpolate(kind, frame, readings)
        out, self._ready = self._ready, []
        return out

    def flush(self) -> None:
        """Make a sample of the present stand, if it is long enough."""
        self._average_ended(np.inf)
        if len(self._states):
            self._average(self._stand(float(self._states.t[-1])), np.inf)

    def _watch_motion(self, stamp: float, q: Array) -> None:
        if len(self._states) < 2:
            self._begin_stand(stamp, q)
            self._began = stamp
            self._approach.update(q)
            return
        step = stamp - self._states.t[-2]
        self._steps.append(step)
        self._step = sorted(self._steps)[len(self._steps) // 2]
        if len(self._states) > 2:
            # a running median of the second difference: encoder noise must not look like motion
            jerk = np.abs(q - 2.0 * self._q[-2] + self._q[-3])
            self._noise = np.where(jerk > self._noise, 1.02 * self._noise + 1e-9, 0.98 * self._noise)
        self._average_ended(stamp)
        low, high = np.minimum(self._low, q), np.maximum(self._high, q)
        allowed = np.maximum(self._rules.still, NOISE_FACTOR / SECOND_DIFFERENCE * self._noise)
        if (high - low > allowed).any() or step > self._rules.gap + LATE_STEPS * self._step:
            if stamp - step - self._since >= SHORTEST:
                self._stands.append((stamp - step, stamp - step - self._since))
                times = np.array([length for _, length in self._stands])
                self._rules = fitted_rules(self._asked, times, stamp - step - self._stands[0][0])
                self._average_ended(np.inf)
                self._ended = self._stand(stamp - step)
            self._begin_stand(stamp, q)
        else:
            self._low, self._high = low, high
            if stamp - self._since >= _LONGEST:
                self._average(self._stand(stamp), stamp - 0.5 * self._rules.window)
                self._since = stamp - self._rules.settle  # it stands already: nothing to settle
        # last, for a stand that has just ended was approached by the motion before this one
        self._approach.update(q)

    def _stand(self, stamp: float) -> _Ended:
        return _Ended(self._since, stamp, self._approach.direction, self._approach.path)

    def _begin_stand(self, stamp: float, q: Array) -> None:
        self._since, self._low, self._high = stamp, q.copy(), q.copy()

    def _average_ended(self, now: float) -> None:
        """Average what was read in the stand that has ended, once half a window [s] behind it is known."""
        ended = self._ended
        if ended is not None and now > ended.stamp + 0.5 * self._rules.window + 2.0 * self._step:
            self._ended = None
            self._average(ended, np.inf)

    def _average(self, ended: _Ended, latest: float) -> None:
        """Make a sample of each dwell of a stand, as for a recording; of one in progress up to the latest dwell."""
        first = int(np.searchsorted(self._states.t, ended.since - _BEFORE))
        t, q, effort = self._states.t[first:], self._q[first:], self._effort[first:]
        for begin, until in find_dwells(t, q, self._rules, fitted=False):
            start, end = max(float(begin), self._used), min(float(until), latest)
            least = min(self._rules.least, float(until - begin))
            if end > ended.since and begin <= ended.stamp and end - start >= least:
                self._used = end
                self._average_dwell(ended, (start, end), t, q, effort)

    def _average_dwell(self, ended: _Ended, span: tuple[float, float], t: Array, q: Array, effort: Array) -> None:
        before, mean = len(self._ready), effort[(t >= span[0]) & (t <= span[1])].mean(axis=0)
        for (kind, frame), readings in self._readings.items():
            inside = [(s, v) for s, v in readings.waiting if span[0] <= s <= span[1]]
            if not inside:
                continue
            stamps, values = np.array([s for s, _ in inside]), np.stack([v for _, v in inside])
            piece = averaged(ReadingTrack(kind, frame, stamps, values, stamps), t, q, np.array([span]))
            if len(piece.q):
                one = {name: getattr(piece, name)[0] for name in _AVERAGED}
                came = {"approach": ended.approach, "path": ended.path}
                self._emit(kind, frame, 0.5 * sum(span), span, **one, **came, effort=mean)
        if len(self._ready) > before:
            self._station += 1
            self._stood = ended.stamp

    def _pair_or_interpolate(self, kind: str, frame: str, readings: _Readings) -> None:
        t, waiting = self._states.t, readings.waiting
        growing = readings.burst if readings.burst > 1 and t[-1] <= readings.last + _STENCIL else 0
        sparse = self._step > self._rules.window
        moving = not sparse and t[-1] - max(self._stood, self._began) > _RESTLESS
        while len(waiting) > growing:
            stamp, values = waiting[0]
            if stamp > t[-1] - (0.0 if sparse else _STENCIL) or (moving and stamp > t[-_EITHER_SIDE]):
                return  # the joint states around it have not come yet
            if not (sparse or moving) and (stamp >= self._since or t[-1] - stamp < _LONGEST + self._rules.settle):
                return  # it may belong to a stand
            waiting.popleft()
            if sparse or moving:
                posture = self._paired(stamp, t) if sparse else self._interpolated(stamp, t)
                if posture is None:
                    self.counts.unpaired += 1
                    continue
                turn = {"R": so3.from_quaternion(values[3:])} if kind == POSE else {}
                self._emit(kind, frame, stamp, (stamp, stamp), reading=values[:3], **turn, **posture)
                self._station += 1

    def _paired(self, stamp: float, t: Array) -> dict[str, Any] | None:
        """The posture of the joint state with a reading's stamp; None where there is none."""
        row = int(np.searchsorted(t, stamp))
        return None if row == len(t) or t[row] != stamp else {"q": self._q[row], "effort": self._effort[row]}

    def _interpolated(self, stamp: float, t: Array) -> dict[str, Any] | None:
        """The posture at a reading's stamp: a cubic through the joint states around it, by least squares."""
        first, at, last = np.searchsorted(t, (stamp - _STENCIL, stamp, stamp + _STENCIL))
        rows = slice(min(first, max(0, at - _EITHER_SIDE)), min(max(last, at + _EITHER_SIDE), len(t)))
        u = t[rows] - stamp
        if len(u) < 2 * _EITHER_SIDE or u[0] > 0.0 or u[-1] < 0.0 or np.diff(u).max() > self._rules.gap:
            return None
        scale = max(-u[0], u[-1])
        c = np.linalg.lstsq(np.vander(u / scale, 4, increasing=True), self._q[rows], rcond=None)[0]
        motion = {"velocity": c[1] / scale, "approach": np.sign(c[1])}
        motion |= dict.fromkeys(("acceleration", "mean_acceleration"), 2.0 * c[2] / scale**2)
        return {"q": c[0], "effort": self._effort[rows].mean(axis=0), "moving": True, **motion}

    def _emit(self, kind: str, frame: str, stamp: float, span: tuple[float, float], **fields: Any) -> None:
        """Make a sample of one row. span: that commands count of [s]. fields: of the samples, of one row each."""
        usual: dict[str, Any] = {"stamps": stamp, "station": self._station, "frame": self.frames.index(frame)}
        usual |= {"approach": self._approach.direction, "path": self._approach.path_at(fields["q"])}
        usual |= {"following": self._commands.following(self._states.t, self._q, span)}
        arrays: dict[str, Any] = {name: np.array(value)[None] for name, value in {**usual, **fields}.items()}
        kinds = np.array([kind], dtype=KIND_NAMES)
        self._ready.append(Samples(names=self.names, frames=tuple(self.frames), kind=kinds, **arrays))
