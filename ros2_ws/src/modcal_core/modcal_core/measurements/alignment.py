"""The tracker's clock against the joints' clock, from what both saw move.

The speed of the tool is the same in every frame, so the speed that the tracker reports and the speed that the joints
imply are one signal seen twice. Sliding one along the other, the lag with the highest correlation is the offset to half
a grid step. The same done piece by piece shows drift.

The speed of the tracked point is |v + dR/dt r|, with v and R of the tip link and r the point in it, which is not known
yet and whose speed peaks some milliseconds beside the tip's: both are fitted, by Gauss-Newton on the speeds. The
standard deviation of the delay is the sandwich estimate over stretches of time, which needs no model of the noise
(Huber 1967; Liang and Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.measurements.dwells import spread_rows
from modcal_core.measurements.recording import POINT, POSE, ReadingTrack, Recording, joints_by_time

# --- The tracker's delay together with the point of the tip link that it sees

_ROUNDS = 8  # of Gauss-Newton; three or four settle a start that is right to half a grid step
_SETTLED = 1e-6  # s, a last step far below what matters to any arm
_STRETCH = 2.0  # s over which errors of the speeds are taken to hang together: about one motion
_OUTLIER = 4.0  # robust standard deviations: one in 16 000 of a normal error lies beyond
_SLOW = 0.02  # m/s; at rest the speed says nothing of the delay
_NORMAL = 1.4826  # median of absolute values to standard deviation of a normal error
_FARTHEST = 1.0  # m, standard deviation of the point before it is fitted: tools are no longer
_MAX_STEPS = 2.5  # grid steps that the fit may move from its start, which the correlation has told to one
_SLOWLY = 15.0  # grid steps, of slow motions, whose correlation is flat, where the speeds then agree much better ...
_BETTER = 0.5  # ... so many times as far apart: a start that is right leaves nothing like that to be gained


@dataclass(frozen=True)
class ClockFit:
    """offset, std: seconds by which the readings are late. moved: speed of the fitted point on the grid (G,) [m/s]."""

    offset: float
    std: float
    moved: Array


def fit_offset(seen: Callable[[float], Array], velocity: Array, turning: Array, start: float, step: float) -> ClockFit:
    """The delay from a start, of which the correlation of speeds is sure to half a grid step.

    seen: speeds of the readings on the grid (G,) [m/s], NaN where unknown, were they late by so many seconds.
    velocity: of the tip (G, 3) [m/s]. turning: derivative of its rotation (G, 3, 3) [1/s]. step: of the grid [s]. Where
    the fit leaves the start behind, the start comes back, half a grid step uncertain.
    """
    point, offset, scales = np.zeros(3), start, []
    for _ in range(_ROUNDS):
        moved_by = velocity + turning @ point
        moved = np.linalg.norm(moved_by, axis=1)
        reported = seen(offset)
        slope = np.gradient(reported, step)
        error = reported - moved
        known = np.isfinite(error) & np.isfinite(slope) & np.isfinite(moved)
        if not (known & (moved > _SLOW)).any():
            return _as_started(start, velocity, step)
        scale = _NORMAL * float(np.median(np.abs(error[known & (moved > _SLOW)])))
        scales.append(scale)
        known[known] = np.abs(error[known]) <= max(_OUTLIER * scale, _SLOW)
        by_point = np.einsum("ni,nij->nj", moved_by[known], turning[known]) / np.maximum(moved[known], 1e-9)[:, None]
        rows, left = np.column_stack([by_point, -slope[known]]), error[known]
        prior = np.append(np.full(3, float(np.mean(left**2)) / _FARTHEST**2), 0.0)
        normal = rows.T @ rows + np.diag(prior)
        if not normal[3, 3] > 0.0 or np.linalg.cond(normal) > 1e15:
            return _as_started(start, velocity, step)
        change = np.linalg.solve(normal, rows.T @ left - prior * np.append(point, 0.0))
        point, offset = point + change[:3], offset + float(change[3])
        if abs(offset - start) > _SLOWLY * step:
            return _as_started(start, velocity, step)
        if abs(change[3]) < _SETTLED:
            break
    if abs(offset - start) > _MAX_STEPS * step and not scales[-1] < _BETTER * scales[0]:
        return _as_started(start, velocity, step)
    stretch = np.flatnonzero(known) // round(_STRETCH / step)
    scores = np.zeros((int(stretch[-1]) + 1, 4))
    np.add.at(scores, stretch, rows * left[:, None])
    spread = np.linalg.solve(normal, scores.T)
    std = float(np.sqrt(spread[3] @ spread[3]))
    return ClockFit(offset, std, np.linalg.norm(velocity + turning @ point, axis=1))


def _as_started(start: float, velocity: Array, step: float) -> ClockFit:
    return ClockFit(start, 0.5 * step, np.linalg.norm(velocity, axis=1))


STEP = 0.02  # s, grid of the speeds
SEARCH = 5.0  # s, largest lag looked for
TRUSTED = 0.6  # correlation from which a lag is accepted
APPLIED = 0.002  # s; a smaller offset is below what this method resolves
CLEARLY = 3.0  # standard deviations beyond which an offset is not chance: one in 370 of clocks that agree
LIMIT = 0.5  # s; a larger offset is a clock that is wrong rather than a delay
_LONGEST = 60_000  # grid points; a longer recording is looked at in its first part
_MIN_JUMP, _LONGEST_JUMP = 0.1, 2.5  # s, of a clock that is set while recording
_BESIDE_CHANCE = 0.9  # of what speeds miss by one lag, that two parts with lags of their own miss less by
_MOVING = 0.02  # m/s
_LEAP = 5.0  # times the usual speed in motion; a quintic's peak is less than twice its mean
_PIECE = 20.0  # s of recording that a jump is looked for in; a motion of a second or two is told in it
_MIN_PIECES = 4  # two on either side of a jump
_MIN_FOR_DRIFT = 3  # that a line is drawn through: two would always agree
_MIN = 50  # readings, joint states and grid points: one second of motion, less correlates by chance
_SLOWEST = 0.1  # s between joint states; slower ones do not show a motion's peaks
_SILENT = 0.2  # s between readings beyond which a speed between them is a guess
_LONG_ENOUGH = 60.0  # s, for a drift: two pieces of half a minute at least
_SURELY = 5.0  # standard deviations, and times what is resolved, by which a drift must be seen
_FINE = 0.25  # grid steps between the joint states that are looked at, at most


@dataclass(frozen=True)
class ClockOffset:
    """offset: seconds by which the reading's stamps are late. drift: seconds per second. at: stamp the offset is for.
    correlation: of the two speeds there. std: standard deviation of the offset [s].
    """

    offset: float
    drift: float
    at: float
    correlation: float
    std: float

    @property
    def clear(self) -> bool:
        """Whether the clocks differ by more than chance."""
        return bool(self.drift) or abs(self.offset) > CLEARLY * self.std

    def corrected(self, stamps: Array) -> Array:
        """The stamps on the joints' clock [s]."""
        return stamps - self.offset - self.drift * (stamps - self.at)


def align(
    recording: Recording, names: tuple[str, ...], tip: Callable[[Array], Array], limit: float = LIMIT
) -> tuple[Recording, tuple[str, ...]]:
    """The recording with the readings' stamps on the joints' clock, and a sentence for each clock that was corrected.

    tip: poses (N, 4, 4) [m] of the tip for joint positions (N, n), by the nominal arm. Raises BadRecording for a clock
    that is off by more than ``limit`` seconds.
    """
    t, q = joints_by_time(recording, names)
    tracks, notes = [], []
    for track in recording.readings:
        clock = clock_offset(track, t, q, tip) if track.kind in (POSE, POINT) else None
        worst = 0.0 if clock is None else float(np.abs(track.stamps - clock.corrected(track.stamps)).max())
        if clock is None or worst < APPLIED or not clock.clear:
            tracks.append(track)
            continue
        if worst > limit:
            raise BadRecording(
                f"clock of {track.topic} ({track.frame})",
                f"{clock.offset:+.2f} s off the joint states' clock, "
                + (f"drifting by {1e6 * clock.drift:+.0f} µs/s to {worst:.2f} s, " if clock.drift else "")
                + f"{limit:g} s is the limit",
                "synchronise the clocks (PTP, chrony), or state the offset with --clock-limit if it is meant",
            )
        tracks.append(replace(track, stamps=clock.corrected(track.stamps)))
        notes.append(
            f"The clock of {track.topic} ({track.frame}) was {1e3 * clock.offset:+.0f} ms off the joint states' clock"
            + (f" and drifted by {1e6 * clock.drift:+.0f} µs/s" if clock.drift else "")
            + "; stamps were corrected."
        )
    return replace(recording, readings=tuple(tracks)), tuple(notes)


def clock_offset(track: ReadingTrack, t: Array, q: Array, tip: Callable[[Array], Array]) -> ClockOffset | None:
    """How late the stamps of a reading are, or None when the motion does not tell. Raises BadRecording where they jump.

    t: joint stamps, sorted, (m,) [s]. q: joint positions (m, n). tip: their poses (m, 4, 4).
    """
    steps = np.diff(t)
    if len(track.stamps) < _MIN or len(t) < _MIN or np.median(steps) > _SLOWEST:
        return None
    if float(steps[steps <= _SLOWEST].sum()) < _MIN * STEP:  # rows that were written twice are no motion
        return None
    grid = np.arange(max(t[0], track.stamps.min() - SEARCH), min(t[-1], track.stamps.max() + SEARCH), STEP)[:_LONGEST]
    if len(grid) < _MIN:
        return None  # they hardly overlap, which cutting stations will say
    track = track.in_order()
    stamps, position = track.stamps, track.values[:, :3]
    seen = _speed(grid, stamps, position)
    apart = np.diff(np.unique(t))  # some recorders note each state twice
    every = max(1, int(_FINE * STEP / float(np.median(apart)))) if len(apart) else 1  # more states say nothing more
    poses = tip(q[::every])
    moved = _speed(grid, t[::every], poses[:, :3, 3])
    if not (np.nanmax(seen, initial=0.0) > _MOVING and np.nanmax(moved, initial=0.0) > _MOVING):
        return None
    seen, moved = _without_leaps(seen), _without_leaps(moved)
    whole = _lag(seen, moved, 0, round(SEARCH / STEP))
    middle = float(grid[0] + grid[-1]) / 2.0
    velocity = np.where(np.isfinite(moved)[:, None], _rate(grid, t[::every], poses[:, :3, 3]), np.nan)
    turning = _rate(grid, t[::every], poses[:, :3, :3].reshape(-1, 9)).reshape(-1, 3, 3)

    def seen_when(drift: float) -> Callable[[float], Array]:
        on_time = stamps - drift * (stamps - middle)
        return lambda late: _without_leaps(_speed(grid, on_time - late, position))

    lag, correlation = whole or (0.0, 0.0)
    fit = fit_offset(seen_when(0.0), velocity, turning, lag * STEP, STEP)
    drift = 0.0
    if len(grid) * STEP > _LONG_ENOUGH:
        drift = _drift(seen, _without_leaps(fit.moved), fit.offset / STEP)
    if drift:
        fit = fit_offset(seen_when(drift), velocity, turning, lag * STEP, STEP)

    def missed(part: slice, drift: float, found: ClockFit) -> Array:  # by the speeds of a part of the grid, in motion
        return np.asarray(np.abs(seen_when(drift)(found.offset)[part] - found.moved)[found.moved > _MOVING])

    def alone(part: slice, lag: float) -> Array:  # where it has a lag of its own
        own = fit_offset(lambda late: seen_when(0.0)(late)[part], velocity[part], turning[part], lag * STEP, STEP)
        return missed(part, 0.0, own)

    if (jump := _jump(seen, moved)) is not None:
        cut, before, after = jump
        # the tip's speed is not that of what the tracker sees, whose pieces may suit lags of their own by chance
        parts = np.nanmedian(np.r_[alone(slice(cut), before), alone(slice(cut, None), after)])
        if parts < _BESIDE_CHANCE * np.nanmedian(missed(slice(None), drift, fit)):
            raise BadRecording(
                f"clock of {track.topic} ({track.frame})",
                f"jumps by {(after - before) * STEP:+.2f} s against the joint states' clock, some {cut * STEP:.0f} s "
                "after the beginning",
                "keep clocks from being set while recording (PTP or chrony, slewing), and calibrate either part alone",
            )
    return ClockOffset(fit.offset, drift, middle, correlation, fit.std) if correlation >= TRUSTED else None


def _speed(grid: Array, stamps: Array, position: Array) -> Array:
    """Speed [m/s] on the grid, NaN where there are no readings nearby."""
    keep = np.r_[True, np.diff(stamps) > 0.0]
    stamps, position = stamps[keep], position[keep]
    speed = np.linalg.norm(_rate(grid, stamps, position), axis=1)
    after = np.clip(np.searchsorted(stamps, grid), 1, len(stamps) - 1)
    silent = (stamps[after] - stamps[after - 1] > _SILENT) | (grid < stamps[0]) | (grid > stamps[-1])
    # a speed beside a gap mixes both sides of it
    silent = np.convolve(silent, np.ones(3), mode="same") > 0
    return np.where(silent, np.nan, speed)


def _rate(grid: Array, stamps: Array, values: Array) -> Array:
    """Derivative (G, k) [1/s] on the grid of values (m, k) at sorted stamps (m,)."""
    return np.gradient(np.stack([np.interp(grid, stamps, column) for column in values.T], axis=1), STEP, axis=0)


def _without_leaps(speed: Array) -> Array:
    """The speeds, none above some times what is usual in motion: one glitch on each side would correlate at any lag."""
    usual = float(np.median(speed[speed > _MOVING]))
    return np.minimum(speed, _LEAP * usual)


def _lag(seen: Array, moved: Array, centre: int, reach: int) -> tuple[float, float] | None:
    """(lag in grid steps, correlation) at the highest correlation within reach of the centre."""
    lags = np.arange(centre - reach, centre + reach + 1)
    correlation = np.array([_correlation(seen, moved, int(k)) for k in lags])
    if not np.isfinite(correlation).any():
        return None
    best = int(np.nanargmax(correlation))
    peak = float(correlation[best])
    if 0 < best < len(lags) - 1:
        left, right = correlation[best - 1], correlation[best + 1]
        bend = left - 2.0 * peak + right
        if np.isfinite(bend) and bend < 0.0:
            return float(lags[best] + 0.5 * (left - right) / bend), peak
    return float(lags[best]), peak


def _correlation(seen: Array, moved: Array, lag: int) -> float:
    """Correlation of seen(t + lag) with moved(t) where both are known; NaN where too little is."""
    if 2 * abs(lag) > len(seen):  # of a piece that is so short, what overlaps agrees by chance
        return float("nan")
    a = seen[max(lag, 0) : len(seen) + min(lag, 0)]
    b = moved[max(-lag, 0) : len(moved) - max(lag, 0)]
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < _MIN:
        return float("nan")
    a, b = a[known] - a[known].mean(), b[known] - b[known].mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else float("nan")


def _jump(seen: Array, moved: Array) -> tuple[int, float, float] | None:
    """Where a clock may jump, and the lags before and after that [grid steps], by those of pieces; or None."""
    count = min(len(seen) * STEP / _PIECE, 20.0)
    if count < _MIN_PIECES:
        return None
    pieces = np.array_split(np.arange(len(seen)), int(count))
    found = [_lag(seen[p], moved[p], 0, round(_LONGEST_JUMP / STEP)) for p in pieces]
    known = [(p, result[0]) for p, result in zip(pieces, found, strict=True) if result and result[1] > TRUSTED]
    lags = np.array([lag for _, lag in known])
    if len(known) < _MIN_PIECES or float(np.ptp(lags)) * STEP < _MIN_JUMP:
        return None
    cut = int(np.argmax(np.abs(np.diff(lags)))) + 1
    levels = np.median(lags[:cut]), np.median(lags[cut:])
    if abs(levels[1] - levels[0]) * STEP < _MIN_JUMP:
        return None
    return round(0.5 * (known[cut - 1][0][-1] + known[cut][0][0])), float(levels[0]), float(levels[1])


def _drift(seen: Array, moved: Array, lag: float) -> float:
    """Drift [s/s] by the lags of pieces of the recording, 0 where they do not agree on one."""
    pieces = np.array_split(np.arange(len(seen)), int(np.clip(len(seen) * STEP / 30.0, 3, 20)))
    found = [(p.mean() * STEP, _lag(seen[p], moved[p], round(lag), round(0.3 / STEP))) for p in pieces]
    known = [(at, result[0] * STEP) for at, result in found if result is not None and result[1] > TRUSTED]
    if len(known) < _MIN_FOR_DRIFT:
        return 0.0
    at, offset = np.array(known).T
    design = np.stack([at - at.mean(), np.ones_like(at)], axis=1)
    coefficients = np.linalg.lstsq(design, offset, rcond=None)[0]
    residual = offset - design @ coefficients
    std = float(np.sqrt(residual @ residual / (len(at) - 2) / (design[:, 0] @ design[:, 0])))
    slope = float(coefficients[0])
    return slope if abs(slope) > _SURELY * std and abs(slope) * float(np.ptp(at)) > _SURELY * APPLIED else 0.0


# --- Stamps of arrival: of readings that a driver hands over together, or each after a delay of its own
#
# An instrument measures at a steady rate, which its readings' arrival still shows. Bursts are no instrument's rate and
# are spread at once. Delays of a part of a period may as well be the true times of a timer that is woken late: that
# stamps would suit a steady rate is said, and the arm's motion decides.

BURST = 1e-3  # s between readings that are handed over together; no instrument measures so often
LONGEST_PAUSE = 1.0  # s between bursts; longer are pauses between stations
_STEADY, _MOST = 1.2, 90.0  # steps between readings, within which most bursts end after their last, %
_FEWEST_IN_BURSTS, SMALLEST_BURST = 10, 3  # readings, in all and in one; two are one that was written twice
_EARLY, _MAX = 30.0, 2000  # price of a second early, of one late: 3 % are early; arrivals that are asked
_FEWEST, _FIRST = 200, 32  # readings that show a rate, and those that it is read from first
# turns of the last reading against the first, by which rates are tried; the same at last
_TURNS, _FINER = np.linspace(-1.0, 1.0, 21), 0.1
_BY_CHANCE = 30.0  # of N R², R the mean direction of N phases: chance has so much once in e^30
_WORTH = 1e-3  # s; delays that vary by less move no tool by more than 1 mm at 1 m/s
_QUIET, _CELLS = 0.2, 40  # share of a period in which fewest arrive, before those that are hardly late; its cells


def without_bursts(track: ReadingTrack, name: str, notes: list[str]) -> ReadingTrack:
    """The track with its stamps spread, where readings were handed over in bursts and stamped when they arrived.

    They get the times of a steady rate where the ends of all bursts agree with one; else the last of a burst keeps its
    stamp, and those before it share the time since the burst before. What that leaves is a delay, fitted as any other.
    """
    t = track.stamps
    if len(t) < _FEWEST_IN_BURSTS or (np.diff(t) < 0.0).any():
        return track
    step = np.diff(t)
    ends = np.r_[np.flatnonzero(step > BURST), len(t) - 1]
    count = np.diff(np.r_[-1, ends])
    pause = np.diff(t[ends], prepend=np.nan)
    usual = float(np.nanmedian(pause)) if len(ends) > 2 else np.inf
    inside = step[step <= BURST]
    if np.median(count) < SMALLEST_BURST or usual > LONGEST_PAUSE or np.median(inside) in (0.0, np.inf):
        return track
    notes.append(
        f"{name}: {len(t)} readings came in bursts of {np.median(count):.0f}, {1e3 * float(np.median(inside)):.2g} ms "
        f"after each other, every {usual:.3g} s, with the stamps of their arrival: they were spread evenly."
    )
    number = np.arange(len(t))
    first, rate = _earliest(ends, t[ends])
    if np.percentile(t[ends] - first - rate * ends, _MOST) <= _STEADY * rate:
        return replace(track, stamps=np.asarray(first + rate * number))
    pause = np.where(pause < 1.5 * usual, pause, usual)
    before = np.repeat(ends, count) - np.arange(len(t))  # readings of the burst that follow each
    return replace(track, stamps=np.repeat(t[ends], count) - before * np.repeat(pause / count, count))


def _earliest(number: np.ndarray, arrived: Array) -> tuple[float, float]:
    """The line (first, step) of which numbered arrivals (m,) [s] are late by least in sum, and hardly any early: of
    delays that are mostly short no line is likelier.
    """
    from scipy.optimize import linprog  # few recordings need it, and looking into a bag is to be quick
    from scipy.sparse import eye_array, hstack

    some = spread_rows(len(number), _MAX)
    n, since = len(some), arrived[some] - arrived[0]
    parts: Any = [np.stack([np.ones(n), number[some]], axis=1), eye_array(n), -eye_array(n)]
    cost = np.r_[0.0, 0.0, np.ones(n), np.full(n, _EARLY)]
    bounds = [(None, None)] * 2 + [(0.0, None)] * (2 * n)
    found: Any = linprog(cost, A_eq=hstack(parts, format="csr"), b_eq=since, bounds=bounds)
    first, step = found.x[:2]
    return float(arrived[0] + first), float(step)


def at_steady_rate(track: ReadingTrack) -> tuple[ReadingTrack, str]:
    """The track with stamps of a steady rate that its readings may have been taken at, some lost perhaps, and a
    sentence; the track itself where stamps show no rate, or hardly differ from it.
    """
    since = track.stamps - track.stamps[:1]
    steps = np.diff(since)
    if len(since) < _FEWEST or (steps < 0.0).any() or not (step := float(np.median(steps))) > 0.0:
        return track, ""
    count, reach = min(_FIRST, len(since)), 1.0
    while reach:  # of twice as many readings each time, the rate is known twice as well
        part = since[:count]
        tried = step / (1.0 + reach * _TURNS * step / max(float(part[-1]), step))
        mean = np.exp(2j * np.pi * part / tried[:, None]).mean(axis=1)
        step = float(tried[np.argmax(np.abs(mean))])
        reach = 1.0 if count < len(since) else _FINER if reach > _FINER else 0.0
        count = min(2 * count, len(since))
    if len(since) * np.abs(mean).max() ** 2 < _BY_CHANCE:
        return track, ""
    arrivals = np.bincount((since / step % 1.0 * _CELLS).astype(int) % _CELLS, minlength=_CELLS)
    quiet = np.convolve(np.r_[arrivals, arrivals], np.ones(width := int(_QUIET * _CELLS)), "valid")[:_CELLS]
    begin = (float(np.argmin(quiet)) + 0.5 * width) / _CELLS  # a reading that seems early would take all before along
    number = np.floor(since / step - begin)
    order = np.arange(len(since))
    # none overtakes another: of those that are late by a period and more the next ones tell it
    number = order + np.minimum.accumulate((number - order)[::-1])[::-1]
    if float(np.std(since - step * number)) < _WORTH:
        return track, ""
    first, step = _earliest(number, since)
    late = since - first - step * number
    varies = float(np.std(late))
    if varies < _WORTH:
        return track, ""
    said = (
        f"stamps vary by {1e3 * varies:.1f} ms (RMS) about a steady rate of {1.0 / step:.4g} Hz, as those of arrival do"
    )
    return replace(track, stamps=track.stamps[0] + first + step * number + float(np.median(late))), said
