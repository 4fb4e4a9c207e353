"""Whether the best joint type is good enough: what it leaves, against noise and what furniture and tracking leave.

Probabilities compare joint types with each other and say nothing of what none of them describes. So what the best one
leaves is compared with four times the usual play and sway of ``furniture``, beside the track's own noise. Nine tenths
of the samples count, for markers are lost at the end of a swing; where more than a quarter lies grossly off, these are
no outliers.

What real doors and drawers leave (play, a hand that settles, a camera's bias) is rough: a smooth bend along the path
leaves a tenth of its squares at least. Of what a linkage, a cam or a curved rail leaves, a bend takes all. While the
handle still moves, less is left, and it is asked what a bend leaves: noise, in which neighbours have nothing in common.

A long hinge and a drawer that bows fit the same samples. They predict other things for the part that they were not
fitted to; and where a plainer joint leaves no more than handles and cameras usually do, no curve is proved.

While the handle moves, the part to be predicted grows with the path: the model from three fifths of it must predict all
that came since. On a short path a model of another type says nothing against the new one: a door begins as a slide.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modcal_core.articulation.fit import JointFit, fit
from modcal_core.articulation.furniture import DISTORTION, PLAY, SWAY
from modcal_core.articulation.joint_motion import ArticulationModel, Kind
from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.prediction_check import POSITIONS
from modcal_core.articulation.track import Track, travelled, white
from modcal_core.geometry import Array

NONE: Kind = "none"  # of what moves as no joint type does
MUCH = 4.0  # times the usual play or sway
_NOISE = 3.0  # deviations of white noise beside it
_COUNTED = 0.9  # of the samples, those that fit best
OUTLIERS = 0.25  # share of samples beyond the limits that outliers may have
_SMOOTH = 5  # samples of a median along the path
_NOTHING = 1e-9  # m, rad: far below what anything measures


@dataclass(frozen=True)
class Misfit:
    """What a joint leaves. position [m], rotation [rad, nan without]: RMS of the best nine tenths of samples.

    off: share of samples that leave too much. between: from where to where along the path it fails [m], None where it
    does nowhere. white: noise of one sample on an axis, (m, rad).
    """

    position: float
    rotation: float
    off: float
    between: tuple[float, float] | None
    white: tuple[float, float]

    @property
    def fails(self) -> bool:
        """Whether the track is not described by this kind of joint."""
        return too_much(self.position, self.rotation, self.white) or self.off > OUTLIERS

    @property
    def said(self) -> str:
        """Reason as text: what remains, what would be too much, and where."""
        shift, turn = limits(self.white)
        left, much = f"{1e3 * self.position:.0f} mm", f"{1e3 * shift:.0f} mm"
        if self.rotation > turn:
            left += f" and {np.degrees(self.rotation):.0f}°"
            much += f" and {np.degrees(turn):.0f}°"
        where = ""
        if self.between is not None:
            where = f", most between {1e2 * self.between[0]:.0f} and {1e2 * self.between[1]:.0f} cm of the path"
        if not too_much(self.position, self.rotation, self.white):
            return f"leaves {100.0 * self.off:.0f} % of the samples far off{where}"
        return f"leaves {left} where {much} would be much{where}"


def limits(noise: tuple[float, float]) -> tuple[float, float]:
    """What would be too much to leave (m, rad), beside white noise of one sample (m, rad)."""
    usual = float(np.exp(PLAY[0])), float(np.exp(SWAY[0]))
    shift, turn = (float(np.hypot(MUCH * u, _NOISE * n)) for u, n in zip(usual, noise, strict=True))
    return shift, turn


def too_much(position: float, rotation: float, noise: tuple[float, float]) -> bool:
    """Whether a joint type that leaves so much [m, rad; nan where nothing was seen] is none."""
    shift, turn = limits(noise)
    return position > shift or rotation > turn


def usual(position: float, rotation: float, noise: tuple[float, float]) -> bool:
    """Whether what is left [m, rad] is no more than the usual play and the usual distortion of what measures."""
    shift, turn = (
        float(np.hypot(np.hypot(np.exp(play[0]), d), _NOISE * n))
        for play, d, n in zip((PLAY, SWAY), DISTORTION, noise, strict=True)
    )
    return position <= shift and not rotation > turn


def misfit(found: JointFit, track: Track, noise: tuple[float, float]) -> Misfit:
    """What a fit leaves of a track that has no outliers and no rests. noise: white, of one sample [m, rad]."""
    e = found.motion.residuals(track, found.motion.configurations(track, scales(found)))
    shift = np.linalg.norm(e[:, :3], axis=1)
    turn = np.linalg.norm(e[:, 3:], axis=1) if e.shape[1] == 6 else None
    much = limits(noise)
    beyond = shift > much[0] if turn is None else (shift > much[0]) | (turn > much[1])
    smooth = _median(shift) > much[0]
    if turn is not None:
        smooth |= _median(turn) > much[1]
    way = travelled(track)[smooth]
    return Misfit(
        rms(shift),
        np.nan if turn is None else rms(turn),
        float(beyond.mean()),
        (float(way.min()), float(way.max())) if len(way) else None,
        noise,
    )


def scales(found: JointFit) -> tuple[float, float]:
    """Scatter of one sample [m, rad], 1 rad without rotations; never 0."""
    turn = found.sigma_rotation if np.isfinite(found.sigma_rotation) else 1.0
    return max(found.sigma_position, _NOTHING), max(turn, _NOTHING)


def rms(sizes: Array) -> float:
    """RMS of the smallest nine tenths of sizes (n,)."""
    best = np.sort(sizes)[: max(1, int(np.ceil(_COUNTED * len(sizes))))]
    return float(np.sqrt(np.mean(best**2)))


def _median(sizes: Array) -> Array:
    half = _SMOOTH // 2
    return np.array([np.median(sizes[max(0, i - half) : i + half + 1]) for i in range(len(sizes))])


_TRACK_DEGREE = 5  # of the bend of a whole track, a polynomial: two waves, longer than what is alike in a hand's width
_PARAMETERS = 6  # of a circle in space
# m: what the joint must leave beside noise for a bend to be considered, half the usual play, as for two motions
WORTH = 0.5 * float(np.exp(PLAY[0]))
_SURELY = 4.0  # deviations by which what is left must be more than noise
VANISHES = 0.04  # of its squares may stay: less than half of what the smoothest of 47 real tracks keeps
CAP = 0.03  # m: samples farther off are outliers


def bend_explains(track: Track, left: Array, along: Array) -> str:
    """Why a smooth bend explains what is left (n, 3) [m] along configurations (n,), as text; empty where none does."""
    near = np.linalg.norm(left, axis=1) < CAP
    e, a = left[near], along[near]
    n, coefficients = len(e), 2 * (_TRACK_DEGREE + 1)  # of the two directions across the path
    if 2 * n <= 2 * (_PARAMETERS + coefficients) or not float(np.ptp(a)) > 0.0:
        return ""
    waves = np.polynomial.legendre.legvander(2.0 * (a - a.min()) / float(np.ptp(a)) - 1.0, _TRACK_DEGREE)
    rest = _beside(waves, e)
    noise = white(track.positions) ** 2
    one = float((e * e).sum()) / (2 * n - _PARAMETERS) - noise
    two = float((rest * rest).sum()) / (2 * n - _PARAMETERS - coefficients) - noise
    worth = WORTH**2 / 2.0
    if one <= max(worth, _SURELY * noise / np.sqrt(n)) or two > VANISHES * one:
        return ""
    return (
        f"a smooth bend leaves {1e3 * np.sqrt(2.0 * max(two, 0.0)):.1f} mm beside noise where it leaves "
        f"{1e3 * np.sqrt(2.0 * one):.1f} mm"
    )


MAX = 64  # stretches: of a metre some 2 cm each
_STRETCH = 4e-3  # m, at first; less would be play
_LONGER = 4.0  # deviations of noise on an axis that a stretch is long, where that is more


class Stretches:
    """A path as the means of k short stretches, neighbours pooled when there are too many. path: its length [m]."""

    def __init__(self) -> None:
        self.path, self.k = 0.0, 0
        self._sums, self._counts, self._ways = np.zeros((MAX, 3)), np.zeros(MAX), np.zeros(MAX)
        self._length = _STRETCH
        self._begin: Array | None = None  # of the stretch that is under way

    def come(self, p: Array, noise: float) -> None:
        """Take a position (3,) [m]. noise: of one position, on an axis [m]."""
        if self._begin is None:
            self._begin, self.k = p, 1
        far = math.dist(p, self._begin)
        if far >= max(self._length, _LONGER * noise):
            self._begin = p
            self.path += far
            if self.k == MAX:
                self._pool()
            self._ways[self.k] = self.path
            self.k += 1
        self._sums[self.k - 1] += p
        self._counts[self.k - 1] += 1.0

    def _pool(self) -> None:
        half = MAX // 2
        for each in (self._sums, self._counts):
            each[:half] = each[0::2] + each[1::2]
            each[half:] = 0.0
        self._ways[:half] = self._ways[0::2]
        self.k, self._length = half, 2.0 * self._length

    @property
    def counts(self) -> Array:
        """How many positions are in each (k,)."""
        return self._counts[: self.k]

    @property
    def points(self) -> Array:
        """Their means (k, 3) [m]."""
        return self._sums[: self.k] / self.counts[:, None]

    def beyond(self, way: float) -> Array:
        """Means (m, 3) of those that begin after so much of the path [m]."""
        first = int(np.searchsorted(self._ways[: self.k], way, side="left"))
        return self._sums[first : self.k] / self._counts[first : self.k, None]


_DEGREE = 4  # of the bend of a path that grows
_FITTED = 2  # of the degrees that a joint's own parameters change: no bend is what these leave
_MIN = 4 * (_DEGREE + 1)  # stretches that are asked
ASKED_EVERY = 0.02  # m of path
_ALIKE = 3.0  # deviations by which neighbours are more alike than in noise, before
_NOT_ALIKE = 1.0  # and beside the bend


def is_bend(stretches: Stretches, motion: AxisMotion) -> bool:
    """Whether a smooth bend is what a motion leaves of a path."""
    track = Track.trusted(stretches.points)
    a = motion.configurations(track, POSITIONS)
    return bend_left(motion.residuals(track, a)[:, :3], a)


def bend_left(left: Array, along: Array) -> bool:
    """Whether residuals (n, 3) [m] of stretches in their order, at configurations (n,), are a smooth bend and noise."""
    near = (left * left).sum(axis=1) < CAP**2
    e, a = left[near], along[near]
    span = float(np.ptp(a)) if len(a) else 0.0
    if len(e) < _MIN or span <= 0.0:
        return False
    waves = np.polynomial.legendre.legvander(2.0 * (a - a.min()) / span - 1.0, _DEGREE)
    before, after = (_beside(waves[:, : degree + 1], e) for degree in (_FITTED, _DEGREE))
    deviation = 1.0 / math.sqrt(2.0 * len(e))  # of the likeness of noise, in two directions across the path
    if _alike(before) > _ALIKE * deviation and _alike(after) < _NOT_ALIKE * deviation:
        return True
    one, two = float((before * before).sum()), float((after * after).sum())
    return one > len(e) * WORTH**2 and two < VANISHES * one


def _beside(waves: Array, e: Array) -> Array:
    return np.asarray(e - waves @ np.linalg.lstsq(waves, e, rcond=None)[0])


def _alike(e: Array) -> float:
    """Correlation of neighbouring rows of (n, 3): 1 for equal ones, 0 for noise (von Neumann's ratio)."""
    steps, sizes = np.diff(e, axis=0), e * e
    both = float(sizes[1:].sum() + sizes[:-1].sum())
    return 1.0 - float((steps * steps).sum()) / both if both > 0.0 else 0.0


_NEAR = 0.7  # of the path, to which a joint is fitted to predict the rest
_MIN_FITTED, _MIN_ASKED = 8, 3  # samples
MAY_MISS = 0.03  # of the path that was travelled
_MISSES = 4e-3  # m: twice the usual play, which no prediction does without
_BETTER, _BY = 1.5, 1e-3  # times and m by which another joint type predicts plainly better


def prediction_doubt(
    track: Track,
    kind: Kind,
    rivals: list[Kind],
    fits: Mapping[Kind, JointFit],
    models: Mapping[Kind, ArticulationModel],
    left: Misfit,
) -> str:
    """Why this kind is not to be relied on, as text; empty where it predicts. left: what it leaves of all of the path.

    It and its rivals, fitted to 70 % of the path from either end, are asked for the rest.
    """
    motion, path = fits[kind].motion, float(travelled(track)[-1])
    much = float(np.hypot(max(_MISSES, MAY_MISS * path), _NOISE * left.white[0]))
    if left.position > much:
        return f"it leaves {1e3 * left.position:.0f} mm of a path of {1e2 * path:.0f} cm"
    # a path in space: a thread has no such play, and most smooth paths are about a screw's
    if not (motion.flat or usual(left.position, left.rotation, left.white)):
        return f"it leaves {1e3 * left.position:.0f} mm, more than a {kind} usually does"
    a = motion.configurations(track, (1.0, 1e9))
    low, high = np.quantile(a, [0.01, 0.99])
    along = (a - low) / max(float(high - low), 1e-12)
    own, *others = (_missed(track, along, fits[one], models[one]) for one in (kind, *rivals))
    if not own:
        return "samples are too few to fit a part of the path and predict the rest"
    if min(own) > much:
        return f"fitted to 70 % of the path it misses the rest by {1e3 * min(own):.0f} mm"
    for one, other in zip(rivals, others, strict=True):
        if all(a > max(_BETTER * b, b + _BY) for a, b in zip(own, other, strict=True)):
            return f"{one} predicts better ({1e3 * max(other):.1f} against {1e3 * max(own):.1f} mm)"
    for one, other in zip(rivals, others, strict=True):
        if fits[one].motion.size < motion.size:
            m = misfit(fits[one], track, left.white)
            if usual(m.position, m.rotation, m.white):  # a plainer joint, as good as furniture is
                said = f"{one} leaves no more than handles and cameras usually do"
                return said if min(other) <= MUCH * np.exp(PLAY[0]) else ""
    return ""


def _missed(track: Track, along: Array, found: JointFit, model: ArticulationModel) -> list[float]:
    """By how much [m] a joint, fitted to 70 % of the path from the near and from the far end, misses the rest."""
    off = []
    for near in (along < _NEAR, along > 1.0 - _NEAR):
        if near.sum() >= _MIN_FITTED and (~near).sum() >= _MIN_ASKED:
            seen = fit(track.part(near), model, start=found.motion).motion
            R = None if track.rotations is None else track.rotations[~near]
            asked = Track.trusted(track.positions[~near], R)
            e = seen.residuals(asked, seen.configurations(asked, (1.0, 1e9)))
            off.append(rms(np.linalg.norm(e[:, :3], axis=1)))
    return off


_KNOWN = 0.6  # of the path: a model from there has as much again to say, less a third
_KEPT_EVERY = 0.01  # m of path between models that are kept, at first
_MAX = 64  # of them: on a metre one each 2 cm
_WHOLE = 0.3  # m of path from which the type must have been right as well
_FEWEST = 3  # stretches that are asked


class ShareCheck:
    """fails: whether the model from three fifths of the path misses the rest, as of the last question."""

    def __init__(self, stretches: Stretches, tolerance_m: float) -> None:
        """stretches: the path so far, kept by others."""
        self.fails = False
        self._stretches, self._tolerance = stretches, tolerance_m
        self._kept: list[tuple[float, AxisMotion | None]] = []
        self._every, self._asked = _KEPT_EVERY, 0.0

    def come(self, motion: AxisMotion | None, noise: float) -> None:
        """Take the motion that is selected now. noise: of one position, on an axis [m]."""
        path = self._stretches.path
        if not self._kept or path - self._kept[-1][0] >= self._every:
            if len(self._kept) == _MAX:
                self._kept, self._every = self._kept[::2], 2.0 * self._every
            self._kept.append((path, motion))
        if path - self._asked >= ASKED_EVERY:
            self._asked = path
            self._ask(path, motion, noise)

    def _ask(self, path: float, now: AxisMotion | None, noise: float) -> None:
        way, motion = next((kept for kept in reversed(self._kept) if kept[0] <= _KNOWN * path), (0.0, None))
        points = self._stretches.beyond(way)
        if motion is None or len(points) < _FEWEST:
            return
        if path < _WHOLE and now is not None and now.kind != motion.kind:
            self.fails = False
            return
        rest = Track.trusted(points)
        off = rms(np.linalg.norm(motion.residuals(rest, motion.configurations(rest, POSITIONS))[:, :3], axis=1))
        self.fails = off > math.hypot(max(self._tolerance, MAY_MISS * path), _NOISE * noise)
