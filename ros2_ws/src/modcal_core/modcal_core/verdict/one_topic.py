"""Instruments of one number each, asked alone: whether what one of them leaves depends on its own reading.

Ranges and draw wires see one direction, so that joints can be blamed for what a scale, a drum or an eyelet does. Of
each of them the residual along its line is predicted from its own length, and from where it points, at stations that
were not fitted; the same with residuals in a random order says what chance predicts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import RowView, station_numbers
from modcal_core.geometry import Array
from modcal_core.measurements import RANGE, spread_rows
from modcal_core.verdict.case import Case, weights

_MIN = 50  # readings of an instrument
_MAX = 600  # the same at most
_FOLDS = 5  # of cross-validation; the usual number (Breiman & Spector 1992)
_ORDERS = 400  # random ones
_WORTH = 0.15  # share of an instrument's squares
_ABOVE = 0.1  # by which that of the others must be less, lest the arm is what errs
_RIDGE = 1e-3  # of the mean square of the columns
_HATS = 5  # over the range of lengths
_FARTHEST = 5.0  # times the median size; no reading may rule alone


@dataclass(frozen=True)
class OneTopic:
    """frame: of the instrument. on: what its residual depends on. share: of its squares that this predicts."""

    frame: str
    on: str
    share: float
    times: float

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        more = f", which is {self.times:.2g} times that of the others," if self.times > 1.0 else ""
        return (
            f"What '{self.frame}' leaves{more} can be predicted from {self.on} ({self.share:.0%} of its squares), "
            "unlike that of the others: look at that instrument (its scale, its drum, how its line leaves the box, "
            "its mount) before the arm."
        )


def one_topic(case: Case) -> OneTopic | None:
    """The range instrument whose residual depends on its own reading alone, None where there is none."""
    samples = case.samples
    ranged = np.flatnonzero((samples.kind == RANGE) & ~samples.moving)
    frames = [int(f) for f in np.unique(samples.frame[ranged]) if (samples.frame[ranged] == f).sum() >= _MIN]
    if len(frames) < 2:
        return None
    all_of = samples.select(ranged)
    view = RowView.of(case.model, all_of, case.model.drivers(all_of))
    weight = weights(case.noise, all_of)[0]
    expected = view.expected
    length = np.linalg.norm(expected, axis=0)
    way = expected / np.maximum(length, 1e-12)
    residual = np.sum(view.position * way, axis=0) * weight
    number = station_numbers(samples)[ranged]
    rng = np.random.default_rng(0)
    best: list[tuple[float, int, str]] = []
    sizes: dict[int, float] = {}
    for f in frames:
        rows = np.flatnonzero(all_of.frame == f)
        rows = rows[spread_rows(len(rows), _MAX)]
        size = float(np.median(np.abs(residual[rows])))
        r = np.clip(residual[rows], -_FARTHEST * size, _FARTHEST * size)
        sizes[f] = float(np.sqrt(np.mean(r**2)))
        for on, columns in _features(length[rows], way[:, rows]):
            share, chance = _predicted(columns, r, number[rows] % _FOLDS, rng)
            if share > max(_WORTH, chance):
                best.append((share, int(f), on))
            else:
                best.append((0.0, int(f), on))
    by_frame = {f: max((b for b in best if b[1] == f), default=(0.0, f, "")) for f in frames}
    ranked = sorted(by_frame.values(), reverse=True)
    if ranked[0][0] < _WORTH or ranked[0][0] - ranked[1][0] < _ABOVE:
        return None
    share, f, on = ranked[0]
    times = sizes[f] / max(float(np.median([sizes[g] for g in frames if g != f])), 1e-300)
    return OneTopic(samples.frames[f], on, share, times)


def _features(length: Array, way: Array) -> Iterator[tuple[str, Array]]:
    """Functions of an instrument's length, and of its direction, (N, K)."""
    low, high = np.percentile(length, [2.0, 98.0])
    knots = np.linspace(low, high, _HATS)
    x = (length - length.mean()) / max(float(length.std()), 1e-12)
    hats = np.maximum(0.0, 1.0 - np.abs(length[:, None] - knots) / max(knots[1] - knots[0], 1e-12))
    yield "its own length", np.column_stack([np.ones_like(x), x, hats])
    z = (way - way.mean(axis=1, keepdims=True)) / np.maximum(way.std(axis=1, keepdims=True), 1e-12)
    a, b, c = z
    yield "where it points", np.column_stack([np.ones_like(a), a, b, c, a * a, b * b, c * c, a * b, a * c, b * c])


def _predicted(columns: Array, r: Array, fold: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """Share of the squares that is predicted at stations not fitted, and the largest such share by chance."""
    orders = np.column_stack([r, *(rng.permutation(r) for _ in range(_ORDERS))])
    left = np.zeros(orders.shape[1])
    for k in range(_FOLDS):
        out = fold == k
        G, y = columns[~out], orders[~out]
        H = G.T @ G + _RIDGE * np.mean(G**2) * len(G) * np.eye(G.shape[1])
        left += np.sum((orders[out] - columns[out] @ np.linalg.solve(H, G.T @ y)) ** 2, axis=0)
    share = 1.0 - left / max(float(np.sum(r**2)), 1e-300)
    return float(share[0]), float(share[1:].max())
