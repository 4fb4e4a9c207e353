"""What a regressor that knows no physics predicts of what is left, judged on samples that it was not trained on.

The residual of the final model is written in units of its noise. Groups of features (see :mod:`features`) are fitted
to four fifths of the stations (of blocks of time, where neighbours in time are neighbours in posture) and predict the
rest. The best group counts.

What the parameters' own error makes predictable does not count. Where they were fitted to these very samples, they are
fitted once more to all folds but the one that is predicted, and what they could predict is taken out of all features.
Where the model is frozen, it is left in, and compared with what an error of the size of their covariance would gain.

What noise alone gains is found by giving what is left of whole stations (blocks) random signs, adding a drawn error of
the parameters where the model is frozen, and doing everything again, the choice of the group included (wild bootstrap;
Wu 1986, Liu 1988). How sure the gain itself is, is found by drawing stations again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import block_length, gumbel_of, units_of_stations
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.verdict.by_instrument import by_instrument
from modcal_core.verdict.case import Case, derivatives, weights
from modcal_core.verdict.features import groups, on_the_way, single_waves
from modcal_core.verdict.ridge import FOLDS, Baseline, Layout, Regressor, Ridge, single
from modcal_core.verdict.sparse import SparseRegressor
from modcal_core.verdict.verdict import Share

_MAX = 500  # samples; a longer recording is thinned evenly
MIN_STATIONS = 15  # three in each fold; with fewer nothing can be said
_FLIPS = 64  # trials of noise, to which a Gumbel law is fitted
_DRAWS = 400  # bootstrap samples
_FARTHEST = 5.0  # times the median size; no sample may rule alone
_FREE = 1e3  # deviations of the noise by which parameters may be off that were fitted to these very samples
_MIN_NEW = 0.02  # length that must be left of a column without what the parameters could make of it
_DOUBT = 2.0  # times; a kept covariance assumes white noise, which an arm that does not repeat has not


@dataclass(frozen=True)
class Predictable:
    """Shares of the squared error that are predictable: both together (in variances), position, orientation.

    source: what predicts it best, as text.
    """

    both: Share | None = None
    position: Share | None = None
    rotation: Share | None = None
    source: str = ""


def predictable(case: Case) -> Predictable:
    """The predictable shares of a case; none where too few stations are left.

    A fitted model is judged on all samples that were not rejected, for leaving its parameters out makes them alike; a
    frozen one on those that are scored.
    """
    rows = np.flatnonzero(~case.wrong) if case.fitted else case.held_out
    rows = rows[spread_rows(len(rows), _MAX)]
    samples = case.samples.select(rows)
    if samples.stations < MIN_STATIONS:
        return Predictable()
    fold, unit = _folds(samples, block_length(case.samples), case.samples)
    order = np.argsort(fold, kind="stable")
    samples, unit = samples.select(order), unit[order]
    ends = np.searchsorted(fold[order], np.arange(FOLDS + 1))

    weight = weights(case.noise, samples)
    residual, J = derivatives(case.model, case.known.parameters, samples)
    layout = Layout.of(ends, weight > 0.0)
    r = layout.flat(_drawn_in(residual * weight))
    U = _parameters(J * weight, case)
    free = U[U.any(axis=(1, 2))] if case.fitted else U[:0]  # a curve's functions that reach to no sample are nothing
    baseline = Baseline(layout.flat(free), layout)
    own = layout.flat(U[:0] if case.fitted else U)
    tests: list[Regressor] = []
    changed = on_the_way(case.model, samples, weight, J * weight)
    apart = by_instrument(case.model, samples, weight, J * weight)
    for group in (*groups(case.model, samples, weight), changed, *apart):
        columns = layout.flat(single(group.columns))
        before = np.sqrt(np.einsum("dr,dr->d", columns, columns))
        columns = baseline.without(columns)
        size = np.sqrt(np.einsum("dr,dr->d", columns, columns))
        keep = size > _MIN_NEW * before
        if keep.any():
            columns = (columns if keep.all() else columns[keep]) / size[keep, None]
            tests.append(Ridge.of(group.name, columns, baseline))
    for name, waves in single_waves(case.model, samples, weight):
        few = SparseRegressor.of(name, waves, baseline, _MIN_NEW)
        tests += [few] if few is not None else []
    return _weighed(tests, baseline, r, own, layout, unit)


def _weighed(
    tests: list[Regressor], baseline: Baseline, residual: Array, own: Array, layout: Layout, unit: np.ndarray
) -> Predictable:
    """The shares of a residual (R,), by the best of these regressors. own: regressors (K, R) of unit variance that are
    part of what noise does. unit: of each sample what its noise shares with others, (N,).
    """
    trials = baseline.trials(residual[:, None])
    r = trials.left[:, 0]
    predictions = [(test.name, p[:, 0]) for test in tests for p in test.predictions(trials)]
    gains = [float(r @ r - np.sum((r - p) ** 2)) for _, p in predictions]
    best = int(np.argmax(gains))
    source, prediction = predictions[best]
    rng = np.random.default_rng(0)
    signs = rng.choice([-1.0, 1.0], (unit.max() + 1, _FLIPS))
    error = own.T @ rng.normal(size=(len(own), _FLIPS))
    noise = baseline.trials((r - prediction)[:, None] * signs[unit][layout.sample] + error)
    totals = np.einsum("rf,rf->f", noise.left, noise.left)
    top = np.full(_FLIPS, -np.inf)
    kept = np.zeros_like(noise.left)
    for test in tests:
        for p in test.predictions(noise):
            gain = totals - np.sum((noise.left - p) ** 2, axis=0)
            better = gain > top
            top = np.where(better, gain, top)
            kept[:, better] = p[:, better]
    which = unit[layout.sample]
    position = layout.component < 3

    def share(rows: np.ndarray) -> Share | None:
        if not rows.any():
            return None
        by_noise = np.sum(noise.left[rows] ** 2, axis=0) - np.sum((noise.left - kept)[rows] ** 2, axis=0)
        return _share(r[rows], prediction[rows], which[rows], by_noise)

    return Predictable(share(np.ones(len(r), bool)), share(position), share(~position), source)


def _share(r: Array, prediction: Array, unit: np.ndarray, by_noise: Array) -> Share:
    """The share of r (R,) that was predicted, beyond what noise usually gains.

    unit: what to draw again, (R,). by_noise: gains in squares by noise alone.
    """
    _, of = np.unique(unit, return_inverse=True)
    total = np.bincount(of, r**2)
    gain = total - np.bincount(of, (r - prediction) ** 2)
    draws = np.random.default_rng(0).integers(len(total), size=(_DRAWS, len(total)))
    whole = max(float(total.sum()), 1e-300)
    location, scale = gumbel_of(by_noise)
    usual = max(float(np.median(by_noise)), 0.0)
    noisy = [location - scale * float(np.log(-np.log(p))) for p in (0.975, 0.99)]
    drawn = gain[draws].sum(axis=1)
    drawn = (drawn - usual) / np.maximum(total[draws].sum(axis=1), 1e-300)
    share = (float(gain.sum()) - usual) / whole
    low = min(float(np.percentile(drawn, 2.5)), (float(gain.sum()) - noisy[0]) / whole)
    lower99 = min(float(np.percentile(drawn, 1.0)), (float(gain.sum()) - noisy[1]) / whole)
    ends = np.clip([share, low, np.percentile(drawn, 97.5), lower99], 0.0, 1.0).tolist()
    return Share(ends[0], (ends[1], max(ends[2], ends[0])), ends[3])


def _parameters(J: Array, case: Case) -> Array:
    """Regressors (K, 6, N) of unit variance: the parameters by a square root of their covariance.

    J: their derivatives (K, 6, N) in units of the noise.
    """
    flat = J.reshape(len(J), -1)
    if case.fitted:
        held = np.array([1.0 / p.prior_std for p in case.known.parameters])
        held = np.r_[held, np.zeros(len(J) - len(held))]  # what the readings hardly show explains nothing
        size = np.sqrt(np.einsum("kr,kr->k", flat, flat) + held**2)
        return _FREE * J / np.maximum(size, 1e-300)[:, None, None]
    value, vector = np.linalg.eigh(case.known.covariance)
    return np.asarray((np.sqrt(_DOUBT * np.maximum(value, 0.0))[:, None] * (vector.T @ flat)).reshape(J.shape))


def _drawn_in(residual: Array) -> Array:
    """The residual (6, N) with samples beyond several times the usual size brought in to there."""
    size = np.linalg.norm(residual, axis=0)
    limit = _FARTHEST * float(np.median(size))
    return np.asarray(residual * np.minimum(1.0, limit / np.maximum(size, 1e-300)))


def _folds(samples: Samples, length: int, whole: Samples) -> tuple[np.ndarray, np.ndarray]:
    """For each sample its fold and the unit whose noise is independent of the others': a station, or a block of time.

    length: stations in a block, in the recording that these samples were taken from.
    """
    stations, rank = units_of_stations(whole)
    block = rank[np.searchsorted(stations, samples.station)] // length
    _, unit = np.unique(block, return_inverse=True)
    count = unit.max() + 1
    deal = np.random.default_rng(0).permutation(count) % FOLDS
    return deal[unit], unit
