"""The floor F²: what no model can predict, because the arm does not repeat it or the instrument adds it.

It is known in two ways. Either the recording contains returns: postures that were left and come back to from another
side. The residuals of two visits differ by what does not repeat and by the instrument, and by nothing else; residuals
are compared, not readings, so that postures need not agree to the last digit. Or repeatability and the instrument's
accuracy are both stated. The scatter of readings within one dwell is no floor: the arm does not move there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from modcal_core.calibration import FINEST, REJECT_Z, Errors, Stated, known_sigma, quantile_chi2, standard_score
from modcal_core.geometry import Array
from modcal_core.measurements import MIN_RETURNS, SAME, Samples, others_at, returns
from modcal_core.measurements.kinds import is_direct
from modcal_core.verdict.verdict import Interval, Repeatability

_JUMP = 30.0  # times; six Gaussian differences along one line leave such a gap among their sizes once in some 700
_MORE_THAN_STATED = 1.44  # times the square, as for the error itself
# that an arm may not repeat, RMS; data sheets have RP of 0.3 to 2e-4, which is twice the RMS (ISO 9283)
_OF_REACH = 2e-4
# of the reach; of the best arms data sheets have RP of 1.4e-5, which trackers do not read, but to some 10 µm
_LEAST_OF_REACH = 7.5e-6
MIN_ASKED = 9  # returns; of fewer, random signs cannot be told from others with the chance below
_CHANCE, _TRIES = 0.005, 999  # of each of two questions
_MAX_REFUSED = 0.25  # share of postures that may be plainly wrong; beyond, they are no longer exceptions


@dataclass(frozen=True)
class Floor:
    """F² and its parts [mm² or deg²], RMS over space squared.

    instrument: 0 where it is contained in the repeatability, as with returns. returns: how many were used. freedom:
    degrees of freedom that it is known by, 0 where it was stated. refused: by how much returns differ, at most, that
    were left out of it [mm or deg]; 0 where none was.
    """

    square: float
    repeatability: Repeatability
    instrument: float
    returns: int = 0
    freedom: float = 0.0
    refused: float = 0.0

    @property
    def rms(self) -> float:
        """F [mm or deg]."""
        return float(np.sqrt(self.square))

    @property
    def interval(self) -> Interval:
        """95 % interval of F² by χ²; a stated one has no width."""
        if not self.freedom:
            return self.square, self.square
        low, high = (self.freedom / quantile_chi2(p, self.freedom) for p in (0.975, 0.025))
        return low * self.square, high * self.square


@dataclass(frozen=True)
class Floors:
    """Floors of position [mm²] and of orientation [deg²]; None where not known.

    returns: how many postures were come back to, known or not. contradictions: a sentence for each thing that returns
    contradict: what was stated, or each other. unknown: why returns show no floor, as text. seen: by how much returns
    differ, in position and in orientation, whether that is a floor or not.
    """

    position: Floor | None = None
    rotation: Floor | None = None
    returns: int = 0
    contradictions: tuple[str, ...] = ()
    unknown: str = ""
    seen: tuple[Floor | None, Floor | None] = (None, None)


def floors(
    residuals: Errors, samples: Samples, wrong: np.ndarray, stated: Stated | None, reach: float = np.inf
) -> Floors:
    """The floors of these samples, from returns where there are enough and they are exchangeable, else as stated.

    residuals: errors of the final model at all samples. wrong: samples (N,) that were rejected, and show no floor.
    reach: of the arm [m], whose class tells what it repeats to at most.
    """
    stated = stated or Stated()
    visits = returns_of(samples, wrong) if is_direct(samples.kinds) else ()
    # a visit that was rejected shows no floor, and one of six leaves the others as they are
    spared = len(visits) == MIN_RETURNS - 1 and len(returns_of(samples)) >= MIN_RETURNS
    least = MIN_RETURNS - int(spared)
    residual = 1e3 * residuals.position
    position = _of_returns(residual, visits, stated.instrument_mm, least)
    told = _stated(stated.rms_mm, stated.instrument_mm)
    unknown = _no_floor(position, residual, visits, samples, stated, reach)
    against = (*_jumps(residual, visits, "mm"), *_beyond(position, told, "mm"))
    rotation = turned = None
    if samples.is_pose.any():
        angles = np.full((len(samples), 3), np.nan)
        angles[samples.is_pose] = np.degrees(residuals.rotation)
        posed = tuple(rows[samples.is_pose[rows]] for rows in visits)
        posed = tuple(rows for rows in posed if len(rows) > 1)
        rotation = _of_returns(angles, posed, stated.instrument_deg, least)
        turned = _stated(stated.repeatability_deg, stated.instrument_deg)
        against = (*against, *_jumps(angles, posed, "°"), *_beyond(rotation, turned, "°"))
    seen = position, rotation
    if unknown:
        position = rotation = None
    return Floors(position or told, rotation or turned, len(visits), against, unknown, seen)


def _no_floor(
    floor: Floor | None, residual: Array, visits: tuple[np.ndarray, ...], samples: Samples, stated: Stated, reach: float
) -> str:
    """Why these returns show no floor, as text: more or less than arms repeat to, or than chance alone."""
    if floor is None:
        return ""
    if floor.rms < 1e3 * FINEST:
        return "Postures that were visited again read the same to the last digit, which no instrument does."
    least = 1e3 * _LEAST_OF_REACH * reach
    if floor.rms < least < np.inf and stated.instrument_mm is None:
        return (
            f"Postures that were visited again differ by {floor.rms:.2g} mm RMS, less than an arm of this size and its "
            f"instrument are known to ({least:.2g} mm): returns show no floor unless the instrument's accuracy is "
            "stated."
        )
    known = known_sigma(samples.sigma_position)
    instrument = stated.instrument_mm or 1e3 * float(np.sqrt(3.0 * np.median(known**2)))
    limit = 1e3 * _OF_REACH * reach
    if stated.rms_mm is None and floor.square > limit**2 + instrument**2:
        return (
            f"Postures that were visited again differ by {floor.rms:.3g} mm RMS, more than an arm of this size and its "
            f"instrument are known to ({np.hypot(limit, instrument):.2g} mm): returns show no floor unless the arm's "
            "repeatability, or the instrument's accuracy, is stated."
        )
    what = depends_on(residual, visits, samples)
    if what:
        return f"What returns differ by depends on {what}: it is more than what does not repeat, and shows no floor."
    return ""


def depends_on(residual: Array, visits: tuple[np.ndarray, ...], samples: Samples) -> str:
    """What differences of returns depend on, as text; empty where that is nothing, or where they are too few to tell.

    Visits that are exchangeable differ by d and by −d alike, whatever lies between them, and by as much everywhere
    and at any time. The first is compared with random signs of the differences, the second with a random order of them.
    """
    a, b = (np.concatenate([rows[part] for rows in visits]) for part in (slice(None, -1), slice(1, None)))
    if len(a) < MIN_ASKED:
        return ""
    d = residual[b] - residual[a]
    rng = np.random.default_rng(0)
    lag = samples.stamps[b] - samples.stamps[a]
    side = samples.approach[b] - samples.approach[a]
    names = samples.names or tuple(f"joint {j + 1}" for j in range(side.shape[1]))
    along = {"the time between them": lag, "their order": np.ones(len(a))}
    along |= {f"the side that {name} came from": side[:, j] for j, name in enumerate(names) if side[:, j].any()}
    columns = np.stack(list(along.values()))
    columns /= np.linalg.norm(columns, axis=1, keepdims=True)
    signs = rng.choice([-1.0, 1.0], (_TRIES, len(a)))
    moved = np.einsum("kp,tp,pc->tkc", columns, np.r_[np.ones((1, len(a))), signs], d)
    height = (moved**2).sum(axis=2)
    if (height[1:].max(axis=1) >= height[0].max()).mean() < _CHANCE:
        return list(along)[int(np.argmax(height[0]))]
    size = np.log(np.maximum((d**2).sum(axis=1), 1e-12))
    over = {"the time between them": lag, "when they were made": samples.stamps[a] + samples.stamps[b]}
    over |= {f"the position of {name}": samples.q[a, j] for j, name in enumerate(names)}
    over |= {f"the frame {f}": samples.frame[a] == k for k, f in enumerate(samples.frames)}
    some = {name: _ranks(x) for name, x in over.items() if np.ptp(x.astype(float)) > 0.0}
    drawn = np.stack([_ranks(size), *(rng.permutation(_ranks(size)) for _ in range(_TRIES))])
    height = np.abs(drawn @ np.stack(list(some.values())).T)
    return list(some)[int(np.argmax(height[0]))] if (height[1:].max(axis=1) >= height[0].max()).mean() < _CHANCE else ""


def _ranks(x: Array) -> Array:
    """Ranks (N,) about their mean, of length one; equal values have equal ones."""
    _, order = np.unique(x, return_inverse=True)
    centred = order - order.mean()
    return np.asarray(centred / np.linalg.norm(centred))


def _scatter(residual: Array, visits: tuple[np.ndarray, ...]) -> tuple[Array, Array]:
    """Sums of squares about the mean of each posture's visits, and their numbers of differences."""
    scatter = np.array([np.sum((residual[rows] - residual[rows].mean(axis=0)) ** 2) for rows in visits])
    return scatter, np.array([len(rows) - 1.0 for rows in visits])


def _jumps(residual: Array, visits: tuple[np.ndarray, ...], unit: str) -> tuple[str, ...]:
    """A sentence where some returns agree and several others differ by far more: that is no repeatability."""
    if len(visits) < MIN_RETURNS:
        return ()
    scatter, freedom = _scatter(residual, visits)
    size = np.sort(np.sqrt(scatter / freedom))
    first, last = len(size) // 4, len(size) - 2  # one alone is a wrong reading
    ratio = size[first + 1 : last + 1] / np.maximum(size[first:last], 1e-12)
    if ratio.max() < _JUMP:
        return ()
    k = first + int(np.argmax(ratio)) + 1
    return (
        f"Of {len(size)} postures that were visited again, {k} agree to {size[k - 1]:.2g} {unit} and {len(size) - k} "
        f"differ by {size[k]:.2g} to {size[-1]:.2g} {unit}: readings jump, or base, tool or target do.",
    )


def _beyond(seen: Floor | None, stated: Floor | None, unit: str) -> tuple[str, ...]:
    """A sentence where returns show more than was stated."""
    if seen is None or stated is None or seen.interval[0] <= _MORE_THAN_STATED * stated.square:
        return ()
    return (
        f"{stated.rms:.3g} {unit} was stated for the arm and the instrument together, but postures that were visited "
        f"again differ by {seen.rms:.3g} {unit}.",
    )


def returns_of(samples: Samples, wrong: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """For each posture that was come back to the rows of its visits, one a visit, in order of time.

    What counts as one, see :mod:`modcal_core.measurements.dwells`.
    """
    keep = ~samples.moving if wrong is None else ~(samples.moving | wrong)
    others = others_at(samples)
    found: list[np.ndarray] = []
    for f in range(len(samples.frames)):
        rows = np.flatnonzero(keep & (samples.frame == f))
        rows = rows[np.argsort(samples.stamps[rows], kind="stable")]
        if len(rows) > MIN_RETURNS:
            for visits in returns(samples.q[rows], samples.approach[rows]):
                # what else moves may weigh on the arm: only where it stands as before is it the same posture
                same = rows[visits][
                    np.abs(others[rows[visits]] - others[rows[visits[0]]]).max(axis=1, initial=0.0) <= SAME
                ]
                if len(same) > 1:
                    found.append(same)
    return tuple(found)


def _of_returns(
    residual: Array, visits: tuple[np.ndarray, ...], instrument: float | None, least: int = MIN_RETURNS
) -> Floor | None:
    """The floor of residuals (N, 3) [mm or deg] by these visits, None where they are fewer than the least."""
    if len(visits) < least:
        return None
    scatter, freedom = _scatter(residual, visits)
    each = scatter / freedom
    # one wrong reading among them must not set the floor
    usual = float(np.median(each / _median_factor(freedom))) + 1e-30
    good = standard_score(scatter / (usual / 3.0), 3.0 * freedom) <= REJECT_Z
    if good.sum() < MIN_RETURNS or (~good).mean() > _MAX_REFUSED:
        good[:] = True
    square = float(scatter[good].sum() / freedom[good].sum())
    return Floor(
        square,
        Repeatability(float(np.sqrt(max(square - (instrument or 0.0) ** 2, 0.0))), "revisits"),
        min((instrument or 0.0) ** 2, square),
        int(freedom[good].sum()),
        axes_of(scatter[good] / freedom[good], freedom[good]) * float(freedom[good].sum()),
        float(np.sqrt(each[~good].max(initial=0.0))),
    )


def axes_of(each: Array, count: Array) -> float:
    """Degrees of freedom of one of these mean squares (N,), each of a count of differences (N,): from one to two.

    Where one joint is what does not repeat, or where some postures scatter more than others, squares vary more than
    those of three equal axes (Satterthwaite 1946), and few of them hardly show how much more.
    """
    mean = float(np.average(each, weights=count))
    variance = float(np.average(count * (each - mean) ** 2, weights=count))
    return float(np.clip(2.0 * mean**2 / max(variance, 1e-300), 1.0, 2.0)) if mean > 0.0 else 2.0


@lru_cache(maxsize=64)
def _median_of(freedom: int) -> float:
    from scipy.special import gammaincinv

    return float(gammaincinv(1.5 * freedom, 0.5) / (1.5 * freedom))


def _median_factor(freedom: Array) -> Array:
    """Median of a mean square over three axes, in units of its expectation."""
    return np.array([_median_of(int(f)) for f in freedom])


def _stated(repeatability: float | None, instrument: float | None) -> Floor | None:
    if repeatability is None or instrument is None:
        return None
    square = repeatability**2 + instrument**2
    return Floor(square, Repeatability(repeatability, "stated"), instrument**2)


def reading_scatter_mm(samples: Samples) -> float | None:
    """RMS over space [mm] of what readings scatter within a dwell; None where dwells do not show it.

    Nothing is said of readings that are no positions: what is noise differs from one instrument to the next.
    """
    known = samples.sigma_position[np.isfinite(samples.sigma_position)]
    if len(known) < MIN_RETURNS or not is_direct(samples.kinds):
        return None
    return 1e3 * float(np.sqrt(3.0 * np.mean(known**2)))
