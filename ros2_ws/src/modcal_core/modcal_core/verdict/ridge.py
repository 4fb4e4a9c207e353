"""Ridge regression judged out of fold: every part of a vector is predicted from the others."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from modcal_core.geometry.so3 import Array

FOLDS = 5
_ALIKE = 0.1  # ridge in units of a column's square; columns that are nearly the same share what they explain
_EXPECTED = (0.05, 0.5)  # shares of the residual that a group may be expected to explain: sets the ridge


@dataclass(frozen=True)
class Layout:
    """How components of samples (6, N), sorted by fold, lie in one vector (R,), sample after sample.

    sample, component: of each of the R. spans: first and end of each fold in it.
    """

    sample: np.ndarray
    component: np.ndarray
    spans: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, ends: np.ndarray, seen: np.ndarray) -> Layout:
        """ends: first sample of each fold, and N. seen: which components there are, (6, N)."""
        sample, component = np.nonzero(seen.T)
        folds = np.searchsorted(sample, ends).tolist()
        return cls(sample, component, tuple(pairwise(folds)))

    def flat(self, x: Array) -> Array:
        """(D, 6, N) as (D, R), or (6, N) as (R,)."""
        at = self.component * x.shape[-1] + self.sample
        return np.ascontiguousarray(x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])[..., at])


@dataclass(frozen=True)
class Trials:
    """m residuals (R, m) with what the parameters U (K, R) predict taken away.

    left: what parameters fitted to all of it leave, (R, m): to be predicted. values: for every fold the parameters
    fitted to the others, (FOLDS, K, m). What they leave of the others is what regressors for this fold are trained on,
    so white noise of a fold shows nowhere in it, not even through the parameters.
    """

    residual: Array
    left: Array
    values: Array


class Baseline:
    """The parameters as regressors with unit variance, prepared for every fold."""

    def __init__(self, U: Array, layout: Layout) -> None:
        """U: (K, R), of which there may be none."""
        self._U, self.layout = U, layout
        grams = [U[:, a:b] @ U[:, a:b].T for a, b in layout.spans]
        whole = np.sum(grams, axis=0) + np.eye(len(U))
        self._whole = np.linalg.cholesky(whole)
        self._factors = [np.linalg.cholesky(whole - g) for g in grams]

    def trials(self, r: Array) -> Trials:
        """The trials of residuals (R, m)."""
        products = [self._U[:, a:b] @ r[a:b] for a, b in self.layout.spans]
        whole = np.sum(products, axis=0)
        values = [
            cho_solve((factor, True), whole - own, check_finite=False)
            for own, factor in zip(products, self._factors, strict=True)
        ]
        left = r - self._U.T @ cho_solve((self._whole, True), whole, check_finite=False)
        return Trials(r, left, np.stack(values))

    def trained(self, columns: Array) -> Trained:
        """How columns (D, R) are trained."""
        own = np.stack([columns[:, a:b] @ self._U[:, a:b].T for a, b in self.layout.spans])
        return Trained(columns, self.layout.spans, own.sum(axis=0) - own)


@dataclass(frozen=True)
class Trained:
    """Columns (D, R) that are trained on what the parameters leave of the other folds.

    spans: first and end of each fold. against: products with the parameters over the other folds, (FOLDS, D, K).
    """

    columns: Array
    spans: tuple[tuple[int, int], ...]
    against: Array

    def products(self, trials: Trials) -> Array:
        """Products with what each fold's regressors are trained on, (FOLDS, D, m)."""
        own = np.stack([self.columns[:, a:b] @ trials.residual[a:b] for a, b in self.spans])
        return np.asarray(own.sum(axis=0) - own - self.against @ trials.values)


class Regressor(Protocol):
    """Anything that predicts each fold of a residual from the others."""

    @property
    def name(self) -> str:
        """What from, for a person."""

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each way to set the regressor."""


@dataclass(frozen=True)
class Ridge:
    """Ridge regression on columns (D, R) of unit length, prepared for every fold and for ridges of several sizes.

    With as many columns as D, none of them special, and a share s of R unit variances expected to be explained, each
    coefficient has a variance of s R / D, and the ridge is its inverse.
    """

    name: str
    trained: Trained
    factors: list[list[tuple[Array, bool]]]

    @classmethod
    def of(cls, name: str, columns: Array, baseline: Baseline) -> Ridge:
        """name: of the columns, for a person."""
        D, R = columns.shape
        parts = [columns[:, a:b] for a, b in baseline.layout.spans]
        grams = [part @ part.T for part in parts]
        whole = np.sum(grams, axis=0)
        ridges = [D / (share * R) for share in _EXPECTED]
        factors = [[cho_factor(whole - g + ridge * np.eye(D), check_finite=False) for g in grams] for ridge in ridges]
        return cls(name, baseline.trained(columns), factors)

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each size of ridge."""
        products, columns = self.trained.products(trials), self.trained.columns
        out = []
        for factors in self.factors:
            prediction = np.empty_like(trials.left)
            for (a, b), own, factor in zip(self.trained.spans, products, factors, strict=True):
                prediction[a:b] = columns[:, a:b].T @ cho_solve(factor, own, check_finite=False)
            out.append(prediction)
        return out


@dataclass(frozen=True)
class Few:
    """Least squares on the few of many columns (D, R) of unit length that go best with the other folds, a number of
    them at a time (sure independence screening; Fan & Lv 2008).
    """

    name: str
    trained: Trained
    counts: tuple[int, ...] = (2, 8)

    @classmethod
    def of(cls, name: str, columns: Array, baseline: Baseline) -> Few:
        """name: of the columns, for a person."""
        return cls(name, baseline.trained(columns))

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each number of columns."""
        R, m = trials.left.shape
        columns = self.trained.columns
        out = [np.empty_like(trials.left) for _ in self.counts]
        most = min(max(self.counts), len(columns))
        for (a, b), products in zip(self.trained.spans, self.trained.products(trials), strict=True):
            size = np.abs(products)
            top = np.argpartition(-size, most - 1, axis=0)[:most]
            top = np.take_along_axis(top, np.argsort(-np.take_along_axis(size, top, 0), axis=0), 0)  # (most, m)
            X = columns[top.T.ravel()].reshape(m, most, R)
            here = X[:, :, a:b]
            gram = X @ X.transpose(0, 2, 1) - here @ here.transpose(0, 2, 1)  # over the other folds
            target = np.take_along_axis(products, top, 0).T
            for prediction, count in zip(out, self.counts, strict=True):
                n = min(count, most)
                held = gram[:, :n, :n] + _ALIKE * np.eye(n)
                solution = np.linalg.solve(held, target[:, :n, None])
                prediction[a:b] = (solution.transpose(0, 2, 1) @ here[:, :n])[:, 0].T
        return out
