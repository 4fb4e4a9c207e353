"""What no named cause explains, learned in small: curves of all joints at once, each held as small as it is likely.

A search takes an effect in or leaves it out, and fits freely what it takes in. Where stations are few both cost: what
does not show is left out, and a curve of fifty values follows the noise. So when the search has ended, its curves, and
small ones of every joint beside them, are given the sizes that make the samples most likely
(:mod:`modcal_core.calibration.covariance`): the mean of a Gaussian process with as many kernels as there are
curves. They stay only where that surely predicts samples better that it has not seen, sizes included, by
cross-validation. What they consist of names no cause.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import (
    FITTED,
    AnyDistance,
    Curvature,
    Fit,
    GroupSizes,
    Model,
    block_length,
    distance_rows,
    identify,
    likely_sizes,
    linearise,
    outlying,
    priors,
    row_weights,
    units_of_stations,
)
from modcal_core.diagnosis.pruning import DRAWN_IN, MIN_GAIN
from modcal_core.effects import EXPECTED_ANGLE, Effect
from modcal_core.effects.families import residual
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import is_serial_arm

_MAX = 1500  # samples, for time; more are thinned, since sizes are known well from so many
_BEGIN = 1e-4  # rad or m: the size at which the search for sizes begins; where it ends hardly depends on it
_TOLD = 1.0  # numbers that the samples must tell of a small curve: of less it says nothing worth keeping
_TOLD_OF_ONE = 0.75  # the same of a single number, which is then two deviations from nothing
_FOLDS = 5  # of cross-validation; the usual number (Breiman & Spector 1992)
_LOOKED = 1  # number of the fold after which it ends where nothing is gained so far
_SURE = 2.0  # standard errors by which it must predict better: one chance in forty for nothing
_FEWEST = 20  # stretches of stations that are kept together; a standard error of fewer says little


def with_residual_curves(
    fit: Fit,
    train: Samples,
    others: Samples,
    distances: Sequence[AnyDistance] = (),
    block: int | None = None,
) -> Fit:
    """The fit to *train* with its curves, and small ones of every joint behind its effects, as large as they are
    likely; the same fit where that does not surely predict better.

    others: samples that may help to decide, and score nothing. block: stations that are kept together; None decides.
    In motion the fit stays as it is: readings close in time err alike there, of which a likelihood makes too much.
    """
    if not is_serial_arm(fit.model.chain) or train.moving.any():
        return fit
    samples = train.join(others) if len(others) else train
    samples = samples.select(~outlying(fit.model, fit.noise, samples))
    samples = samples.select(spread_rows(len(samples), _MAX))
    unit = _units(samples, block)
    effects = _held(fit.model, samples)
    if unit.max(initial=0) + 1 < _FEWEST or all(e.held is None for e in effects):
        return fit
    equations = _Equations.of(fit, effects, samples, distances)
    found = len(fit.model.effects)
    sizes, told = equations.sizes_of_effects(equations.likely())
    kept = [i for i, e in enumerate(effects) if sizes[i] > 0.0 and (i < found or told[i] >= _least(e))]
    if not kept or not _surely_better(equations, unit):
        return fit
    freely = [e if i not in kept else e.held_to(sizes[i]) for i, e in enumerate(fit.model.effects)]
    small = [effects[i].held_to(sizes[i]) for i in kept if i >= found]
    start = fit.start.with_effects((*freely, *small))
    return identify(start, train, fit.parameters, distances, tolerance=FITTED, begin=fit.values)


def _held(model: Model, samples: Samples) -> tuple[Effect, ...]:
    """Effects of the model, curves among them with their prior sizes, followed by small curves."""
    found = (e.held_to(_usual(e)) if e.shape.kind == "spline" else e for e in model.effects)
    known = {e.key[1:] for e in model.effects if not e.shape.is_free}
    small = (e for e in residual.curves(model.drivers(samples)) if e.shape.is_free or e.key[1:] not in known)
    return (*found, *(e.held_to(_BEGIN) for e in small))


def _usual(effect: Effect) -> float:
    return max(float(np.sqrt(np.mean(effect.amplitudes**2))), 1e-9)


def _least(effect: Effect) -> float:
    return min(_TOLD, _TOLD_OF_ONE * len(effect.amplitudes))


def _units(samples: Samples, block: int | None) -> np.ndarray:
    """For each sample the number of the stretch of stations that stay together, (N,)."""
    stations, unit = units_of_stations(samples)
    return np.asarray(unit[np.searchsorted(stations, samples.station)] // (block or block_length(samples)))


@dataclass(frozen=True)
class _Equations:
    """Residuals r (R,) about where values are expected, and what moves them, J (K, R), in standard deviations. sample:
    of each row. H, g, square: JJᵀ, Jr and rᵀr, of known distances too. prior: (K,), of held values what it was before.
    groups: values of each effect that is held, by its number. begin: their sizes. plain: how many values there were
    before small curves.
    """

    J: Array
    r: Array
    sample: np.ndarray
    H: Array
    g: Array
    square: float
    prior: Array
    groups: dict[int, np.ndarray]
    begin: tuple[float, ...]
    plain: int

    @classmethod
    def of(
        cls, fit: Fit, effects: tuple[Effect, ...], samples: Samples, distances: Sequence[AnyDistance]
    ) -> _Equations:
        """Normal equations of a fit with these effects, at samples that are not rejected."""
        start, N = fit.start.with_effects(effects), len(samples)
        values = np.concatenate([fit.values, *(e.values for e in effects)])
        around = start.drivers(samples)
        at = linearise(start, fit.parameters, values, samples, drivers=around)
        root = np.sqrt(row_weights(np.ones(N), fit.noise, samples))
        free = tuple(fit.model.effects) + effects[len(fit.model.effects) :]
        centre, prior = priors(free, fit.parameters, around)
        away = values - centre
        J, r = at.J * root, (at.residual + away @ at.J) * root
        H, g, square = J @ J.T, J @ r, float(r @ r)
        if distances:
            rows = distance_rows(start, fit.parameters, values, distances)
            missed = rows.residual + away @ rows.J
            H, g = H + (rows.J / rows.std**2) @ rows.J.T, g + (rows.J / rows.std**2) @ missed
            square += float(np.sum((missed / rows.std) ** 2))
        pose = np.flatnonzero(samples.is_pose)
        groups: dict[int, np.ndarray] = {}
        first = len(fit.parameters)
        for i, effect in enumerate(effects):
            if effect.held is not None:
                groups[i] = np.arange(first, first + len(effect.amplitudes))
            first += len(effect.values)
        plain = len(fit.parameters) + sum(len(e.values) for e in fit.model.effects)
        sample = np.concatenate([np.tile(np.arange(N), 3), np.tile(pose, 3)])
        begin = tuple(e.held for e in effects if e.held is not None)
        return cls(J, r, sample, H, g, square, prior, groups, begin, plain)

    def likely(self, without: np.ndarray | None = None) -> GroupSizes:
        """The most likely sizes and values. without: rows that are left out."""
        rows = np.zeros(len(self.r), bool) if without is None else without
        J, r = self.J[:, rows], self.r[rows]
        sums = self.H - J @ J.T, self.g - J @ r, self.square - float(r @ r)
        return likely_sizes(*sums, float((~rows).sum()), self.prior, list(self.groups.values()), self.begin)

    def plainly(self, without: np.ndarray) -> Array:
        """Values as they were before small curves, fitted to all but these rows, (plain,)."""
        k = self.plain
        J, r = self.J[:k, without], self.r[without]
        H = self.H[:k, :k] - J @ J.T + np.diag(self.prior[:k] ** -2.0)
        return np.asarray(Curvature.of(H).solve(self.g[:k] - J @ r))

    def sizes_of_effects(self, likely: GroupSizes) -> tuple[dict[int, float], dict[int, float]]:
        """Prior sizes of the held effects and the number of values that the data determine, by effect; other sizes are
        0.
        """
        sizes = np.minimum(likely.sizes, EXPECTED_ANGLE).tolist()
        return defaultdict(float, zip(self.groups, sizes, strict=True)), dict(
            zip(self.groups, likely.told, strict=True)
        )


def _surely_better(equations: _Equations, unit: np.ndarray) -> bool:
    """Whether held curves miss samples that they were not fitted to by less than the fit as it was, by what an effect
    must gain and surely. unit: of each sample, (N,), which are left out together.

    Sizes are found without what is left out from the beginning: from where all samples lead, which is near, too much of
    what is left out stays in them (of a real WAM arm the gain is a fifth larger so, and taken for sure).
    """
    fold = np.random.default_rng(0).permutation(np.arange(unit.max() + 1) % _FOLDS)[unit]
    before, after = np.zeros(len(unit)), np.zeros(len(unit))
    for k in range(_FOLDS):
        out = fold[equations.sample] == k
        J, r, rows = equations.J[:, out], equations.r[out], equations.sample[out]
        for square, values in ((before, equations.plainly(out)), (after, equations.likely(out).values)):
            square += np.bincount(rows, (r - values @ J[: len(values)]) ** 2, len(unit))
        if k >= _LOOKED and not _gains(before, after, unit, fold <= k)[0] > 0.0:  # for time: it is of no use
            return False
    gain, error, worth = _gains(before, after, unit, fold < _FOLDS)
    return gain > max(worth, _SURE * error)


def _gains(before: Array, after: Array, unit: np.ndarray, seen: np.ndarray) -> tuple[float, float, float]:
    """What squares of samples (N,) gain, the standard error of that, and what they must, of those that were seen."""
    limit = DRAWN_IN * float(np.median(before[seen])) + 1e-300
    before, after = np.minimum(before[seen], limit), np.minimum(after[seen], limit)
    count = np.bincount(unit[seen])
    means = np.bincount(unit[seen], before - after)[count > 0] / count[count > 0]
    error = float(np.std(means, ddof=1)) / np.sqrt(len(means))
    return float(means.mean()), error, MIN_GAIN * float(before.mean())
