"""What a regressor that knows no physics predicts of what is left, judged on samples that it was not trained on.

The residual r of the final model is written in units of its noise, and what the parameters' own error explains is taken
out first: with C their covariance and U its square root seen at the readings, cov(r) = I + UᵀU on a good arm, and
S^(-½) r is white. Where the parameters were fitted to these very samples nothing is known beforehand, U is large, and
S^(-½) becomes the projection that leaves their columns out. Groups of features (see :mod:`features`) are treated the
same way, so none of them can predict what the parameters would.

Each group is fitted by ridge regression on four fifths of the stations (of blocks of time, where neighbours in time are
neighbours in posture) and predicts the rest. The best group counts. How far its gain may be trusted is found by giving
the out-of-fold residuals of whole stations (blocks) random signs, adding the prediction back, and doing everything
again, the choice of the group included (wild bootstrap; Wu 1986, Liu 1988).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.chances import gumbel_of
from modcal_core.calibration.split import block_length
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.case import Case, derivatives
from modcal_core.verdict.features import groups
from modcal_core.verdict.ridge import FOLDS, Few, Layout, Regressor, Ridge
from modcal_core.verdict.verdict import Share

_MOST = 700  # samples; a longer recording is thinned evenly
_LEAST_STATIONS = 15  # three in each fold; with fewer nothing can be said
_FLIPS = 64
_FARTHEST = 5.0  # times the median size; no sample may rule alone
_FREE = 1e3  # deviations of the noise by which parameters may be off that were fitted to these very samples
_DOUBT = 2.0  # times; a kept covariance assumes white noise, which an arm that does not repeat has not


@dataclass(frozen=True)
class Predictable:
    """Shares of the squared error that are predictable: both together (in variances), position, orientation.

    source: what predicts it best, for a person.
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
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MOST)).astype(int))]
    samples = case.samples.select(rows)
    if samples.stations < _LEAST_STATIONS or case.known is None:
        return Predictable()
    fold, unit = _folds(samples, block_length(case.samples), case.samples)
    order = np.argsort(fold, kind="stable")
    samples, unit = samples.select(order), unit[order]
    ends = np.searchsorted(fold[order], np.arange(FOLDS + 1))

    weight = _weights(case, samples)
    residual, J = derivatives(case.model, case.known.parameters, samples)
    residual = _drawn_in(residual * weight)
    whiten = _Whitening(J * weight, case)
    r = whiten(residual[None])[0]
    layout = Layout.of(ends, weight > 0.0)
    r = layout.flat(r)
    tests: list[Regressor] = []
    for group in groups(case.model, samples, weight):
        columns = layout.flat(whiten(group.columns))
        size = np.linalg.norm(columns, axis=0)
        columns = columns[:, size > 1e-6 * size.max(initial=1e-300)]
        if columns.shape[1]:
            columns /= np.linalg.norm(columns, axis=0)
            tests.append(Few(group.name, columns, layout) if group.few else Ridge.of(group.name, columns, layout))
    return _weighed(tests, r, layout, unit)


def _weighed(tests: list[Regressor], r: Array, layout: Layout, unit: np.ndarray) -> Predictable:
    """The shares of a residual r (R,), by the best of these regressors."""
    predictions = [(test.name, p[:, 0]) for test in tests for p in test.predictions(r[:, None])]
    gains = [float(r @ r - np.sum((r - p) ** 2)) for _, p in predictions]
    best = int(np.argmax(gains))
    source, prediction = predictions[best]
    left = r - prediction
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (unit.max() + 1, _FLIPS))
    worlds = prediction[:, None] + left[:, None] * signs[unit][layout.sample]
    totals = np.einsum("rf,rf->f", worlds, worlds)
    top = np.full(_FLIPS, -np.inf)
    kept = np.zeros_like(worlds)
    for test in tests:
        for p in test.predictions(worlds):
            gain = totals - np.sum((worlds - p) ** 2, axis=0)
            better = gain > top
            top = np.where(better, gain, top)
            kept[:, better] = p[:, better]

    def share(rows: np.ndarray) -> Share | None:
        if not rows.any():
            return None
        one = _share(r[rows], prediction[rows])
        many = np.array([_share(worlds[rows, k], kept[rows, k]) for k in range(_FLIPS)])
        return _interval(one, many)

    position = layout.component < 3
    return Predictable(share(np.ones(len(r), bool)), share(position), share(~position), source)


def _share(r: Array, prediction: Array) -> float:
    total = float(r @ r)
    return (total - float(np.sum((r - prediction) ** 2))) / total if total > 0.0 else 0.0


def _interval(one: float, many: Array) -> Share:
    """A share with its intervals, as far from it as the worlds' shares are from their middle."""
    middle = float(np.median(many))
    location, scale = gumbel_of(many)
    upper99 = location - scale * float(np.log(-np.log(0.99)))
    low, high = (float(np.percentile(many, p)) - middle for p in (2.5, 97.5))
    ends = np.clip([one - high, one - low, one - max(upper99 - middle, high)], 0.0, 1.0)
    return Share(float(np.clip(one, 0.0, 1.0)), (float(ends[0]), float(ends[1])), float(ends[2]))


class _Whitening:
    """S^(-½) of what the parameters' error and white noise make together."""

    def __init__(self, J: Array, case: Case) -> None:
        """J: derivatives (K, 6, N) in units of the noise."""
        assert case.known is not None
        flat = J.reshape(len(J), -1)
        if case.fitted:
            size = np.linalg.norm(flat, axis=1, keepdims=True)
            held = np.array([1.0 / p.prior_std for p in case.known.parameters])
            held = np.r_[held, np.zeros(len(J) - len(held))][:, None]
            size = np.sqrt(size**2 + held**2)  # what the readings hardly show explains nothing
            U = _FREE * flat / np.maximum(size, 1e-300)
        else:
            value, vector = np.linalg.eigh(case.known.covariance)
            U = np.sqrt(_DOUBT * np.maximum(value, 0.0))[:, None] * (vector.T @ flat)
        value, vector = np.linalg.eigh(U @ U.T)
        keep = value > 1e-12 * value.max(initial=1e-300)
        self._Q = (vector[:, keep].T @ U) / np.sqrt(value[keep])[:, None]
        self._out = (1.0 - 1.0 / np.sqrt(1.0 + value[keep]))[:, None]

    def __call__(self, x: Array) -> Array:
        """Columns (D, 6, N) with S^(-½) applied."""
        flat = x.reshape(len(x), -1)
        return np.asarray(flat - ((self._out * (self._Q @ flat.T)).T @ self._Q)).reshape(x.shape)


def _weights(case: Case, samples: Samples) -> Array:
    """Inverse deviations of the readings, (6, N); zero where there is no orientation."""
    known_p, known_r = np.nan_to_num(samples.sigma_position), np.nan_to_num(samples.sigma_rotation)
    position = 1.0 / np.sqrt(case.spread.of(samples) ** 2 + known_p**2)
    rotation = np.where(samples.is_pose, 1.0 / np.sqrt(case.spread.rotation**2 + known_r**2), 0.0)
    return np.concatenate([np.tile(position, (3, 1)), np.tile(rotation, (3, 1))])


def _drawn_in(residual: Array) -> Array:
    """The residual (6, N) with samples beyond several times the usual size brought in to there."""
    size = np.linalg.norm(residual, axis=0)
    limit = _FARTHEST * float(np.median(size))
    return np.asarray(residual * np.minimum(1.0, limit / np.maximum(size, 1e-300)))


def _folds(samples: Samples, length: int, whole: Samples) -> tuple[np.ndarray, np.ndarray]:
    """For each sample its fold and the unit whose noise is independent of the others': a station, or a block of time.

    length: stations in a block, in the recording that these samples were taken from.
    """
    stations, first = np.unique(whole.station, return_index=True)
    rank = np.empty(len(stations), int)
    rank[np.argsort(whole.stamps[first], kind="stable")] = np.arange(len(stations))
    block = rank[np.searchsorted(stations, samples.station)] // length
    _, unit = np.unique(block, return_inverse=True)
    count = unit.max() + 1
    deal = np.random.default_rng(0).permutation(count) % FOLDS
    return deal[unit], unit
