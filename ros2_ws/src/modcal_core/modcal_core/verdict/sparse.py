"""Least squares on the few of very many columns that go best with a residual.

The columns are motions of the tool times numbers, one a sample: thousands of them, of a few dozen motions. A product
with all of them is one of the numbers with what the motions are contracted to, six times less than with columns that
are written out. Only those that are chosen are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import Array
from modcal_core.verdict.features import Waves
from modcal_core.verdict.ridge import Baseline, Layout, Trials, single

_ALIKE = 0.1  # ridge in units of a column's square; columns that are nearly the same share what they explain
_COUNTS = (2, 8)  # columns at a time


@dataclass(frozen=True)
class SparseRegressor:
    """Least squares on the few of many columns of unit length that go best with the other folds, a number of them at a
    time (sure independence screening; Fan & Lv 2008).

    The columns are motions times numbers, without what the parameters predict of them. which: of all products of a
    motion and its numbers, (D,). predicted: by the parameters, along their directions, (D, K). size: what is left of
    their lengths, (D,). along: products of motions times numbers with the directions over the folds other than each,
    (FOLDS, D, K).
    """

    name: str
    baseline: Baseline
    waves: Waves
    which: np.ndarray
    predicted: Array
    size: Array
    along: Array

    @classmethod
    def of(cls, name: str, waves: Waves, baseline: Baseline, least_new: float) -> SparseRegressor | None:
        """name: of the columns, as text. least_new: share of a column's length that the parameters must leave.

        None where they leave nothing.
        """
        waves = Waves(tuple(map(single, waves.motions)), tuple(map(single, waves.numbers)))
        squares = waves.squares()
        own = _products(waves, baseline.layout, baseline.directions.T)
        seen = own.sum(axis=0)
        predicted = seen * baseline.predicted
        left = np.sqrt(np.maximum(squares - np.sum((2.0 * seen - predicted) * predicted, axis=1), 0.0))
        enough = left > least_new * np.sqrt(squares)
        which = np.flatnonzero(enough & (squares > 1e-18 * squares.max(initial=1e-300)))
        if not len(which):
            return None
        if len(which) < len(seen):
            own, seen, predicted, left = own[:, which], seen[which], predicted[which], left[which]
        np.subtract(seen, own, out=own)
        return cls(name, baseline, waves, which, predicted, left, own)

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each number of columns."""
        R, m = trials.left.shape
        products = self.trained(trials)
        most = min(max(_COUNTS), len(self.size))
        best = [_largest(np.abs(own), most) for own in products]
        chosen, place = np.unique(np.stack(best), return_inverse=True)
        rows = self.written(chosen)
        out = [np.empty_like(trials.left) for _ in _COUNTS]
        for (a, b), own, top, at in zip(
            self.baseline.layout.spans, products, best, place.reshape(len(best), most, m), strict=True
        ):
            X = rows[at.T.ravel()].reshape(m, most, R)
            here = X[:, :, a:b]
            gram = X @ X.transpose(0, 2, 1) - here @ here.transpose(0, 2, 1)  # over the other folds
            target = np.take_along_axis(own, top, 0).T
            for prediction, count in zip(out, _COUNTS, strict=True):
                n = min(count, most)
                held = gram[:, :n, :n] + _ALIKE * np.eye(n, dtype=gram.dtype)
                solution = np.linalg.solve(held, target[:, :n, None])
                prediction[a:b] = (solution.transpose(0, 2, 1) @ here[:, :n])[:, 0].T
        return out

    def trained(self, trials: Trials) -> Array:
        """Products with what each fold's regressors are trained on, (FOLDS, D, m)."""
        own = _products(self.waves, self.baseline.layout, trials.residual)
        own = own if len(self.which) == own.shape[1] else own[:, self.which]
        moved = trials.moved
        others = trials.seen.sum(axis=0) - trials.seen - (moved - self.baseline.shared @ moved)
        folds, K, m = others.shape
        known = self.predicted @ others.transpose(1, 0, 2).reshape(K, folds * m)
        out = np.subtract(own.sum(axis=0), own, out=own)
        out -= self.along @ moved
        out -= known.reshape(len(known), folds, m).transpose(1, 0, 2)
        out /= self.size[:, None]
        return np.asarray(out)

    def written(self, some: np.ndarray) -> Array:
        """Some of the columns, (k, R)."""
        out = self.baseline.layout.flat(self.waves.written(self.which[some]))
        return np.asarray((out - self.predicted[some] @ self.baseline.directions) / self.size[some, None])


def _largest(size: Array, most: int) -> np.ndarray:
    """Rows of the largest of each column of sizes (D, m), the largest first, (most, m)."""
    less = np.negative(size.T, order="C")  # each column in one piece, which is twice as quick to search
    top = np.argpartition(less, most - 1, axis=1)[:, :most]
    return np.asarray(np.take_along_axis(top, np.argsort(np.take_along_axis(less, top, 1), axis=1), 1).T)


def _products(waves: Waves, layout: Layout, x: Array) -> Array:
    """Products of all columns with x (R, m) over each fold, (FOLDS, D, m)."""
    m = x.shape[1]
    grid = np.zeros((len(waves.numbers[0][0]), 6, m), x.dtype)
    grid[layout.sample, layout.component] = x
    out = []
    for motions, numbers in zip(waves.motions, waves.numbers, strict=True):
        seen = (motions.transpose(2, 0, 1) @ grid).reshape(len(grid), len(motions) * m)
        each = np.stack([numbers[:, a:b] @ seen[a:b] for a, b in layout.samples])
        each = each.reshape(len(each), len(numbers), len(motions), m).transpose(0, 2, 1, 3)
        out.append(each.reshape(len(each), len(motions) * len(numbers), m))
    return np.concatenate(out, axis=1)
