"""Which posture belongs to each reading.

Three kinds of recording are told apart. Where every reading carries the stamp of a joint state, someone paired them
already: each pair is a station. Otherwise the arm is looked for standing still (a *dwell*): positions and readings are
averaged there, and the scatter about the mean says how uncertain the mean is. A recording without dwells is a motion,
and each reading becomes a sample with the posture interpolated to its stamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, so3
from modcal_core.measurements.dwells import (
    StationRules,
    deviation_of_mean,
    dwells_of,
    find_dwells,
    inliers,
    spread_rows,
)
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.path import PLAY, at_samples, came_by
from modcal_core.measurements.recording import (
    POSE,
    ReadingTrack,
    Recording,
    following,
    joints_by_time,
    means_between,
)

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class TrackSamples:
    """Samples of one reading track, before they are put together."""

    q: Array
    stamps: Array
    reading: Array
    R: Array
    sigma_position: Array
    sigma_rotation: Array
    motion: Array  # (4, N, n): velocity, acceleration, acceleration and jerk over a while
    moving: bool
    spans: Array  # (N, 2) [s], over which it was averaged


_COLUMNS = ("q", "stamps", "reading", "R", "sigma_position", "sigma_rotation")
_MOTION = ("velocity", "acceleration", "mean_acceleration", "mean_jerk")
_MIN_DWELLS = 3  # fewer are a pause, not a recording that goes from station to station
_PAIRED = 0.5  # share of the readings that must fall on joint states to be taken as pairs: most of them
_MIN_COURSE = 20  # joint states from which it is told how well a spline through them interpolates
_USUALLY = 90.0  # % of them; starts and stops are no smooth motion
_INTERPOLATED = 1e-4  # rad or m; at a metre 0.1 mm, as good as a tracker in motion
_MORE = 1.5  # usual steps that a gap between joint states may be: none is missing
_ALIKE = 0.01  # s within which offsets are one: the jitter of a driver's loop at 100 Hz
# s before and after, from which an acceleration is known: a step of an encoder of 18 bits then counts for 0.01 rad/s²,
# and a motion of a turn a second is seen to a hundredth
_BESIDE = 0.06


def paired_columns(recording: Recording, names: tuple[str, ...], rules: StationRules | None = None) -> dict[str, Any]:
    """What :class:`~modcal_core.measurements.samples.Samples` of a recording, for these joints in this order, are made
    of, by the names of their fields. Raises BadRecording when joints and readings have nothing in common.
    """
    rules = rules or StationRules()
    tracks = [r for r in recording.readings if r.kind in kinds() and len(r.stamps)]
    t, q, velocity, effort = joints_by_time(recording, names, "velocity", "effort")
    dwells = dwells_of(t, q, tracks, rules)
    pieces = [_cut(track, t, q, velocity, dwells, rules) for track in tracks]
    counts = [len(p.q) for p in pieces]
    if not sum(counts):
        remedy = "record both at once on synchronised clocks, holding each posture for a second"
        raise BadRecording("joint states and readings", _why_nothing(tracks, t, dwells), remedy)
    frames = tuple(dict.fromkeys(track.frame for track in tracks))
    whole: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in pieces]) for name in _COLUMNS}
    whole |= zip(_MOTION, np.concatenate([p.motion for p in pieces], axis=1), strict=True)
    moving = np.repeat([p.moving for p in pieces], counts)
    return {
        **whole,
        "names": names,
        "frames": frames,
        "station": np.unique(whole["stamps"], return_inverse=True)[1],  # equal stamps are one, numbered by time
        "frame": np.repeat([frames.index(track.frame) for track in tracks], counts),
        "kind": np.repeat(np.array([track.kind for track in tracks], dtype=KIND_NAMES), counts),
        "moving": moving,
        "approach": _approach(whole["stamps"], whole["q"], whole["velocity"], moving, t, q),
        "path": at_samples(whole["stamps"], whole["q"], t, q),
        "effort": _held(whole["stamps"], moving, t, effort, rules),
        "following": following(recording.commands, names, t, q, np.concatenate([p.spans for p in pieces])),
        "signals": recording.signals,
        "sockets": recording.sockets,
        "clock": recording.has_clock,
    }


def efforts_at_rest(
    recording: Recording, names: tuple[str, ...], rules: StationRules | None = None
) -> tuple[Array, Array, Array]:
    """Postures [rad, m] in which the arm stood, mean efforts there [N m, N], NaN where not sent, and the way each joint
    came, −1, 0 (unknown) or 1, (N, n) each.
    """
    t, q, effort = joints_by_time(recording, names, "effort")
    rows = [slice(*np.searchsorted(t, span)) for span in find_dwells(t, q, rules or StationRules())]
    if not rows:
        return (np.empty((0, len(names))),) * 3
    at, given = (np.stack([x[of].mean(axis=0) for of in rows]) for x in (q, effort))
    middle = np.array([t[of].mean() for of in rows])
    return at, given, _approach(middle, at, np.zeros_like(at), np.zeros(len(at), bool), t, q)


def _cut(track: ReadingTrack, t: Array, q: Array, velocity: Array, dwells: Array, rules: StationRules) -> TrackSamples:
    _, read, rows = np.intersect1d(track.stamps, t, return_indices=True)  # with exactly the same stamp
    gaps = np.diff(np.unique(np.round(track.stamps / _ALIKE)) * _ALIKE)  # a station's row may have been written twice
    sparse = not len(gaps) or float(np.median(gaps)) > rules.window
    # one topic may have been heard for longer than the other; what counts is the time that both cover
    shared = int(((track.stamps >= t[0]) & (track.stamps <= t[-1])).sum()) if len(t) else 0
    if len(rows) and len(rows) >= _PAIRED * shared and (sparse or len(dwells) < _MIN_DWELLS):
        if sparse:
            # a course between stations far apart is not known; what the joints said of their speed is
            return _as_is(track, read, q[rows], np.stack([velocity[rows], *np.zeros((3, *q[rows].shape))]), False)
        return _as_is(track, read, q[rows], _motion(_course(t, q), t[rows] - t[0]), moving=True)
    if len(dwells) >= _MIN_DWELLS:
        return averaged(track, t, q, dwells)
    return _interpolated(track, t, q, rules)


def _values(track: ReadingTrack, rows: np.ndarray) -> tuple[Array, Array]:
    values = track.values[rows]
    if track.kind == POSE:
        return values[:, :3], so3.from_quaternion(values[:, 3:])
    if values.shape[1] < 3:
        values = np.pad(values, ((0, 0), (0, 3 - values.shape[1])))
    return values, np.tile(np.eye(3), (len(values), 1, 1))


def _as_is(track: ReadingTrack, rows: np.ndarray, q: Array, motion: Array, moving: bool) -> TrackSamples:
    position, R = _values(track, rows)
    unknown = np.full(len(rows), np.nan)
    stamps = track.stamps[rows]
    once = np.stack([stamps, stamps], axis=1)
    return TrackSamples(q, stamps, position, R, unknown, unknown, motion, moving, once)


def _nothing(track: ReadingTrack, joints: int) -> TrackSamples:
    none = np.empty((0, joints))
    return _as_is(track, np.empty(0, int), none, np.empty((4, 0, joints)), moving=False)


def _course(t: Array, q: Array) -> CubicSpline:
    """Joint positions as a smooth function of the time since the first stamp: seconds since the epoch would lose digits
    in the powers of a spline. Later repeats of a stamp are left out.
    """
    from scipy.interpolate import CubicSpline  # takes half a second, and only moving recordings need it

    keep = np.r_[True, np.diff(t) > 0.0]
    return CubicSpline(t[keep] - t[0], q[keep])


def _motion(course: CubicSpline, at: Array) -> Array:
    """Velocity, acceleration, and acceleration and jerk over a while, of a course at times (N,): (4, N, n).

    The spline's own curvature follows every jerk, and the noise of encoders; second differences do neither.
    """
    first, last = float(course.x[0]), float(course.x[-1])
    beside = min(_BESIDE, 0.25 * (last - first))

    def mean(middle: Array) -> Array:
        return np.asarray((course(middle - beside) - 2.0 * course(middle) + course(middle + beside)) / beside**2)

    inside = np.clip(at, first + beside, last - beside)
    beyond = at - inside  # next to an end the course of the acceleration goes on
    near = mean(inside)
    near += np.abs(beyond / beside)[:, None] * (near - mean(inside - np.sign(beyond) * beside))
    middle = np.clip(at, first + 2.0 * beside, last - 2.0 * beside)
    jerk = (mean(middle + beside) - mean(middle - beside)) / (2.0 * beside)
    return np.stack([course(at, 1), course(at, 2), near, jerk])


def _interpolated(track: ReadingTrack, t: Array, q: Array, rules: StationRules) -> TrackSamples:
    """Every reading that has joint states close by on both sides, with the posture interpolated to its stamp."""
    if len(np.unique(t)) < 4:
        return _nothing(track, q.shape[1])
    after = np.searchsorted(t, track.stamps)
    rows = np.flatnonzero((after > 0) & (after < len(t)))
    rows = rows[t[after[rows]] - t[after[rows] - 1] <= _widest(t, q, rules)]
    rows = rows[spread_rows(len(rows), rules.most)]
    course, at = _course(t, q), track.stamps[rows] - t[0]
    return _as_is(track, rows, course(at), _motion(course, at), moving=True)


def _widest(t: Array, q: Array, rules: StationRules) -> float:
    """Seconds between joint states up to which postures are interpolated.

    Joint states that always come farther apart than the rules' gap will do if the motion between them is known: every
    second one left out is found by a spline through the others, whose error falls with the fourth power of the step.
    """
    step = float(np.median(np.diff(t)))
    if step <= 0.5 * rules.gap or len(t) < _MIN_COURSE:
        return rules.gap
    known = np.arange(0, len(t), 2)
    left = np.arange(1, known[-1], 2)
    left = left[(t[left + 1] - t[left - 1]) < 3.0 * step]
    if not len(left):
        return rules.gap
    missed = np.abs(_course(t[known], q[known])(t[left] - t[0]) - q[left]).max(axis=1)
    exact = float(np.percentile(missed, _USUALLY)) / 16.0 <= _INTERPOLATED
    return max(rules.gap, _MORE * step) if exact else rules.gap


def averaged(track: ReadingTrack, t: Array, q: Array, dwells: Array) -> TrackSamples:
    """One sample a dwell: means on the manifold, and the standard deviations of those means."""
    track = track.in_order()
    out: list[tuple[Array, float, Array, Array, float, float, tuple[float, float]]] = []
    for start, end in dwells:
        rows = np.arange(*np.searchsorted(track.stamps, (start, end)))
        joint_rows = slice(*np.searchsorted(t, (start, end)))
        if len(rows) == 0 or joint_rows.start == joint_rows.stop:
            continue
        position, R = _values(track, rows)
        keep = inliers(position)
        position, R = position[keep], R[keep]
        R_mean = so3.mean(R)
        p_mean = position.mean(axis=0)
        turned = so3.log(np.swapaxes(R_mean[None], 1, 2) @ R)
        std_p = deviation_of_mean(position - p_mean, min(3, kinds()[track.kind].dimensions))
        std_r = deviation_of_mean(turned) if track.kind == POSE else np.nan
        middle = 0.5 * (start + end)
        out.append((q[joint_rows].mean(axis=0), middle, p_mean, R_mean, std_p, std_r, (start, end)))
    if not out:
        return _nothing(track, q.shape[1])
    q_mean, stamp, p, R, deviation_p, deviation_r, spans = (np.array(c) for c in zip(*out, strict=True))
    return TrackSamples(q_mean, stamp, p, R, deviation_p, deviation_r, np.zeros((4, *q_mean.shape)), False, spans)


def _approach(stamps: Array, at: Array, velocity: Array, moving: np.ndarray, t: Array, q: Array) -> Array:
    """The direction in which each joint last moved before each sample at postures ``at``, −1, 0 or 1, (N, n); where
    only stations were recorded, straight from the one before.
    """
    way = came_by(at_samples(stamps, at, t, q, np.array([PLAY]))[..., 0])
    told = moving | (np.searchsorted(t, stamps + 1e-9) == 0)
    return np.where(told[:, None], np.sign(np.nan_to_num(velocity)), way)


def _held(stamps: Array, moving: np.ndarray, t: Array, effort: Array, rules: StationRules) -> Array:
    """What the actuators exerted at each sample, averaged over the half window around it, (N, n); NaN where unknown."""
    first = np.searchsorted(t, stamps - 0.5 * rules.window)
    last = np.searchsorted(t, stamps + 0.5 * rules.window, side="right")
    nearest = np.clip(np.searchsorted(t, stamps), 0, len(t) - 1)
    mean = means_between(effort, first, last)
    return np.where(moving[:, None] | np.isnan(mean), effort[nearest], mean)


def _why_nothing(tracks: list[ReadingTrack], t: Array, dwells: Array) -> str:
    if not tracks or not len(t):
        return "no reading is there" if len(t) else "no joint state is there"
    first, last = min(r.stamps.min() for r in tracks), max(r.stamps.max() for r in tracks)
    if first > t[-1] or last < t[0]:
        apart = first - t[-1] if first > t[-1] else t[0] - last
        return f"do not overlap in time: {apart:.1f} s apart"
    counts = {len(r.stamps) for r in tracks}
    if counts == {len(t)} and len(t) > 2:
        apart = tracks[0].stamps - t
        if float(np.ptp(apart)) < _ALIKE:
            return f"come in pairs, but every reading is stamped {np.median(apart):+.3f} s off its joint state"
    return f"no reading falls on one of {len(t)} joint states or {len(dwells)} dwells"
