"""Least squares judged out of fold: every part of a rest is predicted from the others.

Columns that belong together are held by a ridge; of very many, of which a few may matter, those that go best with the
other folds are taken (sure independence screening; Fan & Lv 2008). What fitted parameters could make of columns and
rest is taken out of both, and fitted to each fold's others once more.

The parameters are solved for in double precision, and regressors on unit columns in single: ridges hold them to a
condition of some thousands, so predictions are right to a ten-thousandth of the noise that judges them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from modcal_core.geometry import Array

FOLDS = 5  # of cross-validation; the usual number (Breiman & Spector 1992)
_EXPECTED = (0.05, 0.5)  # shares of the residual that a group may be expected to explain: sets the ridge
_MIN_NEW = 0.02  # length that must be left of a column without what the parameters could make of it
_ALIKE = 0.1  # ridge in units of a column's square; columns that are nearly the same share what they explain
_COUNTS = (2, 8)  # of very many columns at a time


@dataclass(frozen=True)
class Layout:
    """How components of samples (6, N) lie in one vector (R,), fold after fold, sample after sample.

    order: of the samples, (N,). sample (in this order), component: of each of the R. spans: first and end of each fold
    in it.
    """

    order: np.ndarray
    sample: np.ndarray
    component: np.ndarray
    spans: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, fold: np.ndarray, seen: np.ndarray) -> Layout:
        """fold: of each sample, (N,). seen: which components there are, (6, N)."""
        order = np.argsort(fold, kind="stable")
        sample, component = np.nonzero(seen[:, order].T)
        ends = np.searchsorted(fold[order], np.arange(FOLDS + 1))
        folds = np.searchsorted(sample, ends).tolist()
        return cls(order, sample, component, tuple(pairwise(folds)))

    def flat(self, x: Array) -> Array:
        """(D, 6, N) as (D, R), or (6, N) as (R,)."""
        return np.ascontiguousarray(x[..., self.component, self.order[self.sample]])

    def grid(self, x: Array) -> Array:
        """(R,) as (6, N), zero where there is no such component."""
        out = np.zeros((6, len(self.order)))
        out[self.component, self.order[self.sample]] = x
        return out


@dataclass(frozen=True)
class Trials:
    """m residuals (R, m) with what K parameters predict taken away.

    left: what parameters fitted to all of it leave, (R, m): to be predicted. moved: along the orthonormal directions
    that the parameters move it along, by those that are fitted to the other folds, (FOLDS, K, m). What these leave of
    the others is what regressors for this fold are trained on, so white noise of a fold shows nowhere in it, not even
    through the parameters.
    """

    residual: Array
    left: Array
    moved: Array


class Baseline:
    """The parameters as regressors with unit variance, prepared for every fold.

    directions: orthonormal ones that they move a residual along, (K, R). predicted: what of each direction the
    parameters predict when fitted to all of it, (K,). Both for columns in single precision.
    """

    def __init__(self, value: Array, directions: Array, layout: Layout) -> None:
        """value (K,), directions (K, 6, N): of the parameters, of which there may be none (:func:`principal`)."""
        self.layout, self._root, self._predicted = layout, np.sqrt(value), value / (1.0 + value)
        self._directions = layout.flat(directions)
        shared = np.stack([part @ part.T for part in (self._directions[:, a:b] for a, b in layout.spans)])
        both = np.outer(self._root, self._root)
        self._factors = [np.linalg.cholesky(np.diag(1.0 + value) - both * own) for own in shared]
        self.directions, self.predicted = map(_single, (self._directions, self._predicted))

    def new(self, columns: Array) -> Array:
        """Columns (D, 6, N) less what the parameters predict of them, of unit length, (d, R): those that are new."""
        x = self.layout.flat(_single(columns))
        before, Q = np.sqrt(np.einsum("dr,dr->d", x, x)), self.directions
        x = x - ((x @ Q.T) * self.predicted) @ Q if len(Q) else x
        size = np.sqrt(np.einsum("dr,dr->d", x, x))
        keep = (size > _MIN_NEW * before) & (before > 1e-9 * before.max(initial=1e-300))
        return np.asarray(x[keep] / size[keep, None])

    def trials(self, r: Array) -> Trials:
        """The trials of residuals (R, m)."""
        Q = self._directions
        seen = np.stack([Q[:, a:b] @ r[a:b] for a, b in self.layout.spans])
        whole, root = seen.sum(axis=0), self._root[:, None]
        moved = [
            root * cho_solve((factor, True), root * (whole - own), check_finite=False)
            for own, factor in zip(seen, self._factors, strict=True)
        ]
        left = r - Q.T @ (self._predicted[:, None] * whole)
        return Trials(_single(r), _single(left), _single(np.stack(moved)))


def principal(U: Array) -> tuple[Array, Array]:
    """Squared sizes (k,) and orthonormal directions (k, 6, N) that parameters U (K, 6, N) move a residual along.

    U is zero where there is no such component.
    """
    flat = U.reshape(-1, U.shape[1] * U.shape[2])
    value, vector = np.linalg.eigh(flat @ flat.T)
    keep = value > 1e-12 * value.max(initial=1e-300)
    directions = (vector[:, keep] / np.sqrt(value[keep])).T @ flat
    return value[keep], directions.reshape(-1, *U.shape[1:])


class _Columns:
    """Columns (D, R) of unit length, in single precision, and what each fold's regressors are trained on."""

    def __init__(self, columns: Array, baseline: Baseline) -> None:
        self.columns, self.spans, Q = columns, baseline.layout.spans, baseline.directions
        own = np.stack([columns[:, a:b] @ Q[:, a:b].T for a, b in self.spans])
        self._along = own.sum(axis=0) - own  # with the parameters' directions over the other folds, (FOLDS, D, K)

    def products(self, trials: Trials) -> Array:
        """Products of the columns with what is left of the other folds, (FOLDS, D, m)."""
        own = np.stack([self.columns[:, a:b] @ trials.residual[a:b] for a, b in self.spans])
        return np.asarray(own.sum(axis=0) - own - self._along @ trials.moved)


class Ridge(_Columns):
    """Ridge regression for every fold and several ridges.

    With as many columns as D, none of them special, and a share s of R variances expected to be explained, each
    coefficient has a variance of s R / D in these, and the ridge is its inverse.
    """

    def __init__(self, columns: Array, baseline: Baseline) -> None:
        super().__init__(columns, baseline)
        D, R = columns.shape
        grams = [part @ part.T for part in (columns[:, a:b] for a, b in self.spans)]
        whole = np.sum(grams, axis=0)
        self._factors = [[_factored(whole - gram, D / (share * R)) for gram in grams] for share in _EXPECTED]

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each size of ridge."""
        products = self.products(trials)
        out = [np.empty_like(trials.left) for _ in _EXPECTED]
        for prediction, factors in zip(out, self._factors, strict=True):
            for (a, b), target, factor in zip(self.spans, products, factors, strict=True):
                prediction[a:b] = self.columns[:, a:b].T @ cho_solve(factor, target, check_finite=False)
        return out


class Sparse(_Columns):
    """Least squares on the few of many columns that go best with the other folds, a number at a time."""

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each number of columns."""
        most = min(max(_COUNTS), len(self.columns))
        out = [np.empty_like(trials.left) for _ in _COUNTS]
        for (a, b), own in zip(self.spans, self.products(trials), strict=True):
            top = _largest(np.abs(own), most)
            X = self.columns[top.T]  # (m, most, R)
            here = X[:, :, a:b]
            gram = X @ X.transpose(0, 2, 1) - here @ here.transpose(0, 2, 1)  # over the other folds
            target = np.take_along_axis(own, top, 0).T
            for prediction, count in zip(out, _COUNTS, strict=True):
                n = min(count, most)
                held = gram[:, :n, :n] + _ALIKE * np.eye(n, dtype=gram.dtype)
                solution = np.linalg.solve(held, target[:, :n, None])
                prediction[a:b] = (solution.transpose(0, 2, 1) @ here[:, :n])[:, 0].T
        return out


Regressor = Ridge | Sparse


def _single(x: Array) -> Array:
    return cast(Array, x.astype(np.float32))


def _factored(gram: Array, ridge: float) -> tuple[Array, bool]:
    """Cholesky factor of a symmetric matrix (D, D) with a ridge on its diagonal; the matrix is overwritten."""
    gram.flat[:: len(gram) + 1] += ridge
    return cast(tuple[Array, bool], cho_factor(gram.T, overwrite_a=True, check_finite=False))  # of columns: no copy


def _largest(size: Array, most: int) -> np.ndarray:
    """Rows of the largest of each column of sizes (D, m), the largest first, (most, m)."""
    less = np.negative(size.T, order="C")  # each column in one piece, which is twice as quick to search
    top = np.argpartition(less, most - 1, axis=1)[:, :most]
    return np.asarray(np.take_along_axis(top, np.argsort(np.take_along_axis(less, top, 1), axis=1), 1).T)
