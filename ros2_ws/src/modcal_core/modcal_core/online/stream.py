"""Joint states and readings as they come; samples as soon as they are whole.

The same three ways as in a recording (:mod:`modcal_core.measurements.pairing`), without its end being known: readings
taken while the arm stands still are averaged once it has moved on, over what the same detector of dwells finds;
readings that carry the stamp of a joint state are paired with it where messages are sparse; on an arm that never stops
a reading gets the posture interpolated to its stamp. Memory does not grow: a few seconds of messages are held.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, so3
from modcal_core.measurements import (
    LATE_STEPS,
    NOISE_FACTOR,
    POSE,
    SECOND_DIFFERENCE,
    SHORTEST,
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

_HELD = 4096  # commands; 4 s at 1 kHz, and any stand at the usual rates


class RecentCommands:
    """The last commands for these joints. Stamps in seconds, positions in rad and m."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._t = np.empty(2 * _HELD)
        self._q = np.empty((2 * _HELD, len(names)))
        self._first = self._end = 0

    def add(self, stamps: Array, positions: Array) -> None:
        """Take commands (k, n), NaN for joints that they do not name, at rising stamps (k,); later ones are replaced.

        So a trajectory takes the place of what is left of the one before.
        """
        stamps, positions = stamps[-_HELD:], positions[-_HELD:]
        if not len(stamps):
            return
        self._end = self._first + int(np.searchsorted(self._t[self._first : self._end], stamps[0]))
        if self._end + len(stamps) > len(self._t):
            keep = slice(max(self._end - _HELD, self._first), self._end)
            kept = keep.stop - keep.start
            self._t[:kept], self._q[:kept] = self._t[keep].copy(), self._q[keep].copy()
            self._first, self._end = 0, kept
        if self._end > self._first:  # what a message does not name stays as it was told
            positions = np.where(np.isfinite(positions), positions, self._q[self._end - 1])
        rows = slice(self._end, self._end + len(stamps))
        self._t[rows], self._q[rows] = stamps, positions
        self._end = rows.stop
        self._first = max(self._first, self._end - _HELD)

    def following(self, t: Array, q: Array, span: tuple[float, float]) -> Array:
        """Commanded − measured (n,) over a span [s]; NaN where unknown. t (m,), q (m, n): joint states about it."""
        told = self._t[self._first : self._end]
        about = slice(max(int(np.searchsorted(t, span[0])) - 1, 0), int(np.searchsorted(t, span[1], side="right")) + 1)
        t, q = t[about], q[about]
        if not len(told) or not len(t) or t[-1] < told[0]:
            return np.full(len(self._names), np.nan)
        since = max(int(np.searchsorted(told, t[0], side="right")) - 1, 0)
        until = int(np.searchsorted(told, t[-1], side="right")) + 1
        rows = slice(self._first + since, min(self._first + until, self._end))
        unknown = np.full((rows.stop - rows.start, len(self._names)), np.nan)
        track = JointTrack(self._names, self._t[rows], self._q[rows], unknown, unknown, unknown[:, 0])
        return following((track,), self._names, t, q, np.array([span]))[0]


_STREAM_HELD = 8192  # joint states, and readings of each frame
_LONGEST = 3.0  # s of standing still that make one sample; a longer stand makes several
_JUMP = 1.0  # s; a stamp that lies this far before the last one is a clock that was set back, not a late message
_RESTLESS = 30.0  # s without a stand after which readings in motion are used
_STENCIL = 0.01  # s on either side of a reading that its posture is interpolated from ...
_EITHER_SIDE = 2  # ... and, where joint states are farther apart, so many on either side at least
_UNIT = 1e-3  # how far from 1 a quaternion's norm may be; drivers round to four digits at worst
_STEPS = 15  # between joint states, whose median is the usual one: a silence is none
_STANDS = 40  # of late, by which it is known how long this arm stands
_BEFORE = 1.0  # s of joint states before a stand that its beginning is looked for in


@dataclass
class Counts:
    """What was left out, by reason."""

    late: int = 0
    jumps: int = 0
    unpaired: int = 0


@dataclass
class _Readings:
    """Readings of one frame that are not used up."""

    kind: str
    waiting: deque[tuple[float, Array]] = field(default_factory=lambda: deque(maxlen=_STREAM_HELD))
    last: float = -np.inf


@dataclass(frozen=True)
class _Ended:
    """A stand that has just ended, at a stamp [s], and the approach directions (n,) of the joints."""

    since: float
    stamp: float
    approach: Array


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
        self._t = np.empty(2 * _STREAM_HELD)
        self._q = np.empty((2 * _STREAM_HELD, n))
        self._effort = np.empty((2 * _STREAM_HELD, n))
        self._first = self._end = 0
        self._low = self._high = np.zeros(n)
        self._since = -np.inf  # when the present stand began
        self._stood = -np.inf  # when the last one ended
        self._used = -np.inf  # up to when readings of stands have been averaged
        self._ended: _Ended | None = None
        self._began = -np.inf
        self._approach = Approach()
        self._commands = RecentCommands(self.names)
        self._stands: deque[tuple[float, float]] = deque(maxlen=_STANDS)  # when, and how long [s]
        self._rules = self._asked
        self._steps: deque[float] = deque(maxlen=_STEPS)
        self._step = np.nan
        self._noise = np.zeros(n)
        self._ready: list[Samples] = []
        for readings in self._readings.values():
            readings.waiting.clear()
            readings.last = -np.inf

    def joint_state(self, stamp: float, q: Array, effort: Array | None = None) -> None:
        """Take one joint state, q (n,) [rad, m]. Raises BadRecording for a position that is not finite."""
        if not (np.isfinite(q).all() and np.isfinite(stamp)):
            worst = self.names[int(np.argmin(np.isfinite(q)))]
            raise BadRecording(f"joint {worst}", "position is not finite", "fix the driver; the message is left out")
        if self._end > self._first:
            last = self._t[self._end - 1]
            if stamp < last - _JUMP:
                self._forget()
                self.counts.jumps += 1
            elif stamp <= last:
                self.counts.late += 1
                return
        self._append(stamp, q, effort)
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
        readings = self._readings.setdefault((kind, frame), _Readings(kind))
        if stamp < readings.last - _JUMP:
            readings.waiting.clear()
        elif stamp <= readings.last:
            self.counts.late += 1
            return
        readings.last = stamp
        self.counts.unpaired += len(readings.waiting) == readings.waiting.maxlen
        readings.waiting.append((stamp, np.array(values, dtype=float)))

    def take(self) -> list[Samples]:
        """The samples that have become whole since the last time, one row each, in the order of their stamps."""
        for (_, frame), readings in self._readings.items():
            self._pair_or_interpolate(frame, readings)
        out, self._ready = self._ready, []
        return out

    def flush(self) -> None:
        """Make a sample of the present stand, if it is long enough."""
        self._average_ended(np.inf)
        if self._end > self._first:
            last = float(self._t[self._end - 1])
            self._average(_Ended(self._since, last, self._approach.direction), np.inf)

    def _append(self, stamp: float, q: Array, effort: Array | None) -> None:
        if self._end == len(self._t):
            keep = slice(self._end - _STREAM_HELD, self._end)
            for a in (self._t, self._q, self._effort):
                a[:_STREAM_HELD] = a[keep]
            self._first, self._end = 0, _STREAM_HELD
        self._t[self._end], self._q[self._end] = stamp, q
        if effort is not None and self._end > self._first:  # a stand's mean must not be lost to one that is not finite
            effort = np.where(np.isfinite(effort), effort, self._effort[self._end - 1])
        self._effort[self._end] = np.nan if effort is None else effort
        self._end += 1
        self._first = max(self._first, self._end - _STREAM_HELD)

    def _watch_motion(self, stamp: float, q: Array) -> None:
        if self._end - self._first < 2:
            self._begin_stand(stamp, q)
            self._began = stamp
            self._approach.update(q)
            return
        step = stamp - self._t[self._end - 2]
        self._steps.append(step)
        self._step = sorted(self._steps)[len(self._steps) // 2]
        if self._end - self._first > 2:
            # a running median of the second difference: encoder noise must not look like motion
            jerk = np.abs(q - 2.0 * self._q[self._end - 2] + self._q[self._end - 3])
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
                self._ended = _Ended(self._since, stamp - step, self._approach.direction)
            self._begin_stand(stamp, q)
        else:
            self._low, self._high = low, high
            if stamp - self._since >= _LONGEST:
                self._average(_Ended(self._since, stamp, self._approach.direction), stamp - 0.5 * self._rules.window)
                self._since = stamp - self._rules.settle  # it stands already: nothing to settle
        # last, for a stand that has just ended was approached by the motion before this one
        self._approach.update(q)

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
        first = self._first + int(np.searchsorted(self._t[self._first : self._end], ended.since - _BEFORE))
        t, q = self._t[first : self._end], self._q[first : self._end]
        for begin, until in find_dwells(t, q, self._rules, fitted=False):
            start, end = max(float(begin), self._used), min(float(until), latest)
            least = min(self._rules.least, float(until - begin))
            if end > ended.since and begin <= ended.stamp and end - start >= least:
                self._used = end
                self._average_dwell(ended, start, end, t, q, self._effort[first : self._end])

    def _average_dwell(self, ended: _Ended, start: float, end: float, t: Array, q: Array, effort: Array) -> None:
        made = False
        for (kind, frame), readings in self._readings.items():
            inside = [(s, v) for s, v in readings.waiting if start <= s <= end]
            if not inside:
                continue
            stamps, values = np.array([s for s, _ in inside]), np.stack([v for _, v in inside])
            piece = averaged(ReadingTrack(kind, frame, stamps, values, stamps), t, q, np.array([[start, end]]))
            if not len(piece.q):
                continue
            made = True
            mean = effort[(t >= start) & (t <= end)].mean(axis=0)
            row = (piece.reading[0], piece.R[0], piece.sigma_position[0], piece.sigma_rotation[0])
            self._emit(
                kind, frame, 0.5 * (start + end), piece.q[0], *row, effort=mean, approach=ended.approach,
                span=(start, end),
            )  # fmt: skip
        if made:
            self._station += 1
            self._stood = ended.stamp

    def _pair_or_interpolate(self, frame: str, readings: _Readings) -> None:
        if self._end - self._first < 2:
            return
        t = self._t[self._first : self._end]
        sparse = self._step > self._rules.window
        moving = not sparse and t[-1] - max(self._stood, self._began) > _RESTLESS
        while readings.waiting:
            stamp, values = readings.waiting[0]
            if stamp > t[-1] - (0.0 if sparse else _STENCIL) or (moving and stamp > t[-_EITHER_SIDE]):
                return  # the joint states around it have not come yet
            if not sparse and not moving and stamp >= self._since:
                return  # it may belong to a stand
            if not sparse and not moving and t[-1] - stamp < _LONGEST + self._rules.settle:
                return
            readings.waiting.popleft()
            if sparse:
                self._pair(frame, readings.kind, stamp, values, t)
            elif moving:
                self._interpolate(frame, readings.kind, stamp, values, t)

    def _pair(self, frame: str, kind: str, stamp: float, values: Array, t: Array) -> None:
        row = int(np.searchsorted(t, stamp))
        if row == len(t) or t[row] != stamp:
            self.counts.unpaired += 1
            return
        k = self._first + row
        self._emit(kind, frame, stamp, self._q[k], *_parts(kind, values), effort=self._effort[k])
        self._station += 1

    def _interpolate(self, frame: str, kind: str, stamp: float, values: Array, t: Array) -> None:
        """The posture at a reading's stamp: a cubic through the joint states around it, by least squares."""
        first, at, last = np.searchsorted(t, (stamp - _STENCIL, stamp, stamp + _STENCIL))
        first, last = min(first, max(0, at - _EITHER_SIDE)), min(max(last, at + _EITHER_SIDE), len(t))
        u = t[first:last] - stamp
        if len(u) < 2 * _EITHER_SIDE or u[0] > 0.0 or u[-1] < 0.0 or np.diff(u).max() > self._rules.gap:
            self.counts.unpaired += 1
            return
        scale = max(-u[0], u[-1])
        powers = np.vander(u / scale, 4, increasing=True)
        rows = slice(self._first + first, self._first + last)
        c = np.linalg.lstsq(powers, self._q[rows], rcond=None)[0]
        self._emit(
            kind, frame, stamp, c[0], *_parts(kind, values), effort=self._effort[rows].mean(axis=0),
            velocity=c[1] / scale, acceleration=2.0 * c[2] / scale**2,
        )  # fmt: skip
        self._station += 1

    def _emit(
        self,
        kind: str,
        frame: str,
        stamp: float,
        q: Array,
        position: Array,
        R: Array,
        sigma_position: float,
        sigma_rotation: float,
        effort: Array,
        velocity: Array | None = None,
        acceleration: Array | None = None,
        approach: Array | None = None,
        span: tuple[float, float] | None = None,
    ) -> None:
        zero = np.zeros((1, len(self.names)))
        came = self._approach.direction if approach is None else approach
        heard = self._t[self._first : self._end], self._q[self._first : self._end]
        self._ready.append(
            Samples(
                names=self.names,
                frames=tuple(self.frames),
                q=np.array(q, dtype=float)[None],
                stamps=np.array([stamp]),
                station=np.array([self._station]),
                frame=np.array([self.frames.index(frame)]),
                kind=np.array([kind], dtype=KIND_NAMES),
                reading=np.array(position)[None],
                R=np.array(R)[None],
                sigma_position=np.array([sigma_position]),
                sigma_rotation=np.array([sigma_rotation]),
                velocity=zero if velocity is None else velocity[None],
                moving=np.array([velocity is not None]),
                acceleration=zero if acceleration is None else acceleration[None],
                approach=(np.sign(velocity) if velocity is not None else came)[None],
                effort=np.array(effort)[None],
                following=self._commands.following(*heard, (stamp, stamp) if span is None else span)[None],
            )
        )


def _parts(kind: str, values: Array) -> tuple[Array, Array, float, float]:
    R = so3.from_quaternion(values[3:]) if kind == POSE else np.eye(3)
    return values[:3], R, float("nan"), float("nan")
