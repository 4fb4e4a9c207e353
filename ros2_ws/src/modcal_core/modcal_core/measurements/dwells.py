"""Dwells: when an arm stood still, what its readings come to there, and from which side it came.

There is one detector. A stream asks it about the last seconds of joint states as soon as a stand has ended.

Of a raster, every n-th row may have one joint in the same place each time. The rows i with the smallest fractional
parts of i φ, φ the golden ratio, are as even as every n-th row (three-distance theorem) and have no period (Weyl).

Of a standstill that was recorded by itself a tenth is left for settling, or what the readings of all of them tell: the
arm has settled from where a tenth of the standstill, on average, lies about the mean of what follows as far as the
scatter lets it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.path import PLAY, UNKNOWN, came_by, directions, went_on
from modcal_core.measurements.recording import ReadingTrack

# --- Some rows of many, spread evenly over them, that no raster of postures meets

_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # of all numbers the one that fractions approach most slowly


def spread_rows(count: int, most: int) -> np.ndarray:
    """Ascending numbers out of 0 … count − 1, spread over them: all of them, or ``most`` where there are more."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.argsort(np.arange(count) * _GOLDEN % 1.0, kind="stable")[:most])


NOISE_FACTOR = 6.0  # standard deviations of encoder noise that are standstill: range of a window of noise and some room
# Median size of the second difference of Gaussian noise, in units of its deviation: 0.6745 times √(1 + 4 + 1)
SECOND_DIFFERENCE = 0.6745 * np.sqrt(6.0)
LATE_STEPS = 5.0  # usual steps between joint states, by which one may be late beyond the gap that rules allow
SHORTEST = 0.15  # s; a joint that turns back stands within half a milliradian for less, at any usual acceleration
_SETTLING = 0.1  # of a standstill that was recorded by itself, at most, that is not used: it was chosen to be recorded
_MANY = 10  # standstills from which a recording goes from station to station; fewer are pauses of a motion
_SHARE = 0.1  # of the recorded time that these stand; below, most of what was read was read in motion
_OUTLYING = 8.0  # times the half-width of the closest half of a dwell's readings: far outside any noise
_ASKED = 64  # readings of a dwell that the middle is sought among


@dataclass(frozen=True)
class StationRules:
    """How stations are cut. window: [s] over which the arm must not move. still: [rad or m] that counts as no motion.
    settle: [s] after stopping that are not used. least: [s] of standing still that make a dwell, after settling.
    gap: [s] without joint states that a motion may not be interpolated over. most: samples of one instrument in motion;
    a longer recording is thinned evenly.
    """

    window: float = 0.2
    still: float = 5e-4
    settle: float = 0.25
    least: float = 0.3
    gap: float = 0.1
    most: int = 50_000


@dataclass(frozen=True)
class _Stand:
    """Rows first … last in which nothing moved, between gaps or motion. opens, closes: whether a gap is next to it."""

    first: int
    last: int
    opens: bool
    closes: bool


def find_dwells(t: Array, q: Array, rules: StationRules, fitted: bool = True) -> Array:
    """Start and end [s] of the times the arm stood still, (d, 2), settling time already taken off.

    t: stamps, sorted, (m,). q: positions, (m, n). Where nothing is recorded between standstills, each is a dwell,
    however short. fitted: shorten the rules' times where standstills are mostly shorter than they ask for.
    """
    return settling_dwells(t, q, rules, fitted)[:, 1:]


def settling_dwells(t: Array, q: Array, rules: StationRules, fitted: bool = True) -> Array:
    """As :func:`find_dwells`, (d, 3), and before start and end when each began with what is left for settling [s],
    which is earlier only where a standstill was recorded by itself.
    """
    stands = _stands(t, q, rules)
    if fitted and stands:
        # next to a motion half a window is not detected as standing
        moves = np.array([2 - stand.opens - stand.closes for stand in stands])
        times = np.array([t[stand.last] - t[stand.first] for stand in stands]) + 0.5 * rules.window * moves
        step = np.diff(t)
        recorded = float(step[step < rules.gap + LATE_STEPS * float(np.median(step))].sum())
        rules = fitted_rules(rules, times, recorded)
    out = []
    for stand in stands:
        start, end = float(t[stand.first]), float(t[stand.last])
        settle, least, alone = rules.settle - 0.5 * rules.window, rules.least, False
        if stand.opens:
            settle = max(settle, 0.0)
        if stand.opens and stand.closes and end - start >= SHORTEST:
            # a part is for settling, the rest is the station; nothing tells that the arm moved just behind the last row
            end += 0.5 * float(np.median(np.diff(t)))
            settle, least = min(settle, _SETTLING * (end - start)), min(least, 0.5 * (end - start))
            alone = True
        if end - start - settle >= least - 1e-9:
            out.append((start if alone else start + settle, start + settle, end))
    return np.array(out).reshape(-1, 3)


def fitted_rules(rules: StationRules, times: Array, recorded: float) -> StationRules:
    """The rules with shorter times where most standstills, of these times (d,) [s], are too short for them; those
    shorter than SHORTEST do not count. recorded: seconds.
    """
    stood = times[times >= SHORTEST]
    asked = rules.settle + rules.least + 0.5 * rules.window
    if len(stood) < _MANY or stood.sum() < _SHARE * recorded or (stood >= asked).mean() >= 0.5:
        return rules
    usual = float(np.percentile(stood, 25.0))  # three in four are at least so long
    share = max(usual - 0.5 * rules.window, 0.0) / (rules.settle + rules.least)
    # a little less than what is left of the usual one, for the grid of joint states
    return replace(rules, settle=min(1.0, share) * rules.settle, least=0.8 * min(1.0, share) * rules.least)


def _stands(t: Array, q: Array, rules: StationRules) -> list[_Stand]:
    if len(t) < 3:
        return []
    steps = np.diff(t)
    step = float(np.median(steps))
    if not 0.0 < step <= rules.window:
        return []
    width = max(3, round(rules.window / step) | 1)
    apart = steps >= rules.gap + LATE_STEPS * step
    spread = _spread(q, width, apart)
    # second differences of a moving arm are small, those of encoder noise are not
    noise = np.median(np.abs(np.diff(q, 2, axis=0)), axis=0) / SECOND_DIFFERENCE
    still = (spread <= np.maximum(rules.still, NOISE_FACTOR * noise)).all(axis=1)
    begins = still & np.r_[True, ~still[:-1] | apart]
    ends = still & np.r_[~still[1:] | apart, True]
    beside = np.r_[True, apart, True]  # a gap, or an end of the recording, before each row
    return [
        _Stand(a, b, bool(beside[a]), bool(beside[b + 1]))
        for a, b in zip(np.flatnonzero(begins).tolist(), np.flatnonzero(ends).tolist(), strict=True)
    ]


def _spread(q: Array, width: int, apart: np.ndarray) -> Array:
    """Largest less smallest position within half a window before and after, (m, n), gaps not looked across."""
    if not apart.any():
        return running_max(q, width) + running_max(-q, width)
    row = np.arange(len(q)) + (width // 2) * np.r_[0, np.cumsum(apart)]
    spaced = np.full((row[-1] + 1, q.shape[1]), -np.inf)
    spaced[row] = q
    high = running_max(spaced, width)[row]
    spaced[row] = -q
    return np.asarray(high + running_max(spaced, width)[row])


def running_max(x: Array, width: int) -> Array:
    """The largest of each column within half a window before and after, (m, n); width is odd."""
    out, size = np.pad(x, ((width // 2,) * 2, (0, 0)), constant_values=-np.inf), 1
    while size < width:  # of windows twice as wide each time
        step = min(size, width - size)
        out, size = np.maximum(out[:-step], out[step:]), size + step
    return out


def inliers(position: Array) -> np.ndarray:
    """Readings of one dwell that are no glitches: within 8 robust deviations of their middle, at least half of them.

    The middle is sought about the reading that most others are near: where something was moved half way through, the
    median lies between both places, where nothing ever was.
    """
    n, least = len(position), (len(position) + 1) // 2
    some = position[spread_rows(n, _ASKED)]
    apart = np.sort(np.linalg.norm(some[:, None] - some[None], axis=2), axis=1)
    first = some[int(np.argmin(apart[:, (len(some) - 1) // 2]))]
    near = np.argsort(np.linalg.norm(position - first, axis=1), kind="stable")[:least]
    off = np.linalg.norm(position - np.median(position[near], axis=0), axis=1)
    limit = _OUTLYING * max(float(np.partition(off, least - 1)[least - 1]), 1e-6)
    return off <= limit


def deviation_of_mean(residual: Array, dimensions: int = 3) -> float:
    """Standard deviation per axis of the mean of residuals (k, 3), which vary along so many axes; NaN below 4 of them.

    Neighbouring readings of a tracker are correlated (filters, vibration), so the k of them count as
    ``k (1 − ρ) / (1 + ρ)`` with ρ their correlation at lag one.
    """
    k = len(residual)
    if k < 4:
        return float("nan")
    variance = float(np.sum(residual**2)) / (dimensions * (k - 1))
    if variance == 0.0:
        return 0.0
    rho = float(np.sum(residual[1:] * residual[:-1]) / np.sum(residual**2))
    effective = max(1.0, k * (1.0 - min(max(rho, 0.0), 0.99)) / (1.0 + min(max(rho, 0.0), 0.99)))
    return float(np.sqrt(variance / effective))


# --- Dwells of a whole recording; of standstills that were recorded by themselves, from when on the arm had settled

_TENTH, _MAX = 0.1, 0.5  # of a standstill: compared with what follows; left out at most
_FEWEST = 10  # standstills that say whether the arm had settled; as many as make a recording one of stations
_SIGMAS = 3.0  # of the mean square of so many differences, beyond which the arm is taken to settle still
_SCATTER = 3  # readings behind a tenth, from which their scatter is known


def dwells_of(t: Array, q: Array, tracks: Sequence[ReadingTrack], rules: StationRules) -> Array:
    """Start and end [s] of the times the arm stood still, (d, 2), for readings of these tracks.

    t: stamps of joint states, sorted, (m,). q: positions, (m, n).
    """
    found = settling_dwells(t, q, rules)
    alone = found[:, 0] < found[:, 1]
    begin, length = found[alone, 0], found[alone, 2] - found[alone, 0]
    if len(begin) >= _FEWEST:
        tracks = [track for track in tracks if track.kind in kinds() and len(track.stamps)]
        for share in np.arange(0.0, _MAX + 0.5 * _TENTH, _TENTH):
            bounds = np.stack([begin + share * length, begin + (share + _TENTH) * length, found[alone, 2]], axis=1)
            said = [_settled(track, bounds) for track in tracks]
            if True in said and False not in said:
                found[alone, 1] = bounds[:, 0]
                break
    return found[:, 1:]


def _settled(track: ReadingTrack, bounds: Array) -> bool | None:
    """Whether readings between the first two of bounds (d, 3) are like those behind; None where there are none."""
    track = track.in_order()
    parts = np.searchsorted(track.stamps, bounds).tolist()
    if all(first == start for first, start, _ in parts):
        return None
    width = min(3, track.values.shape[1])
    apart, expected, count = 0.0, 0.0, 0
    for first, start, end in parts:
        m, k = start - first, end - start
        if m == 0 or k < _SCATTER:
            continue
        values = track.values[first:end, :width]
        right = inliers(values)
        early, late = values[:m][right[:m]], values[m:][right[m:]]
        if len(early) == 0 or len(late) < _SCATTER:
            continue
        variance = float(np.sum((late - late.mean(axis=0)) ** 2)) / (len(late) - 1)
        apart += float(np.sum((early.mean(axis=0) - late.mean(axis=0)) ** 2))
        expected += variance * (1.0 / len(early) + 1.0 / len(late))
        count += width
    return bool(count >= _FEWEST * width and apart <= expected * (1.0 + _SIGMAS * np.sqrt(2.0 / max(count, 1))))


# --- Which way each joint last went: backlash and friction depend on it, long after the joint has stopped


@dataclass
class Approach:
    """Remembers which way each joint of an arm last went, and its path. Fed with every posture, in order of time.

    path: how far joints are ahead of followers with play, (n, 2, widths); see :mod:`modcal_core.measurements.path`.
    """

    direction: Array = field(default_factory=lambda: np.empty(0))
    path: Array = field(default_factory=lambda: np.empty((0, 0, 0)))
    _near: Array = field(default_factory=lambda: np.empty((0, 2)))  # the same of followers whose play is PLAY
    _last: Array = field(default_factory=lambda: np.empty(0))

    def update(self, q: Array) -> Array:
        """The directions (n,), −1, 0 (unknown) or 1, now that the joints are at q (n,)."""
        if self._last.shape != q.shape:
            self._last, self._near = q, np.tile([-PLAY, PLAY], (len(q), 1))
            self.path = np.tile(UNKNOWN, (len(q), 1, 1))
        self._near = np.clip(self._near + (q - self._last)[:, None], -PLAY, PLAY)
        self.path, self._last, self.direction = self.path_at(q), q.copy(), came_by(self._near)
        return self.direction

    def path_at(self, q: Array) -> Array:
        """The path (n, 2, widths) once the joints have gone straight to q (n,) from where they were last."""
        return went_on(self.path, q - self._last)


# --- Postures that were left and come back to from another side: what shows how well an arm repeats

MIN_RETURNS = 6  # to as many distinct postures; a spread of 18 degrees of freedom is known to about a sixth
SAME = 1e-3  # rad or m; controllers come back to some 1e-4, and a model corrects for what is left
LEFT = 2e-2  # rad or m; what a joint must move in between, far beyond backlash and settling


def returns(q: Array, approach: Array | None = None) -> list[np.ndarray]:
    """For each posture that was come back to the rows of its visits, in order of time.

    q: postures in order of time (N, n) [rad, m]; neighbours that are alike are one visit. approach: the direction each
    joint last moved in, −1, 0 or 1, (N, n). Where it is unknown, it is taken from where the arm stood before: arms go
    from one station to the next. A visit counts when a joint was more than LEFT away since the one before it, and when
    at least one joint arrives the other way than at the first one that counts.
    """
    if len(q) < 3:
        return []
    stood = np.r_[False, np.abs(np.diff(q, axis=0)).max(axis=1) <= SAME]
    first = np.flatnonzero(~stood)
    visited = q[first]
    side = _sides(np.zeros_like(visited) if approach is None else approach[first], visited)
    out = []
    for visits in _alike(visited):
        known = [v for v in visits if side[v].any()]
        used = known[:1]
        for visit in known[1:]:
            away = np.abs(visited[used[-1] : visit] - visited[visit]).max() > LEFT
            if away and (side[visit] * side[used[0]] < 0).any():
                used.append(visit)
        if len(used) > 1:
            out.append(first[used])
    return out


def posture_numbers(q: Array) -> np.ndarray:
    """For each row of q (N, n) the row where its posture stood first, (N,)."""
    out = np.arange(len(q))
    for rows in _alike(q):
        out[rows] = rows[0]
    return out


def _alike(q: Array) -> list[list[int]]:
    """Rows of q (N, n) of the same posture, for each that stands there more than once, in order."""
    # On a line in no special direction postures that are alike are neighbours, and hardly any others; the first joints
    # tell nearly all of these apart
    along = 0.5 + 0.5 * (_GOLDEN * np.arange(1, q.shape[1] + 1) % 1.0)
    x = q @ along
    order = np.argsort(x, kind="stable")
    x, joints = x[order], np.ascontiguousarray(q[order].T)
    limit = SAME * float(np.sum(along))
    pairs = []
    for ahead in range(1, len(q)):
        close = np.flatnonzero(x[ahead:] - x[:-ahead] <= limit)
        if not len(close):
            break
        for joint in joints:
            close = close[np.abs(joint[close] - joint[close + ahead]) <= SAME]
        if len(close):
            pairs.append(np.sort(np.stack([order[close], order[close + ahead]], axis=1), axis=1))
    groups: dict[int, list[int]] = {}
    leader: dict[int, int] = {}
    for a, b in sorted(map(tuple, np.concatenate(pairs).tolist() if pairs else [])):
        head = leader.get(a, a)
        if b not in leader and (head == a or np.abs(q[head] - q[b]).max() <= SAME):
            leader[b] = head
            groups.setdefault(head, [head]).append(b)
    return [sorted(rows) for rows in groups.values()]


def _sides(approach: Array, q: Array) -> Array:
    """Which way each joint arrives, −1, 0 or 1, (N, n): as recorded, else as it comes from the visit before."""
    known = (approach != 0.0).any(axis=1)
    return np.asarray(np.where(known[:, None], approach, directions(np.diff(q, axis=0, prepend=q[:1]))))
