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
        """(D, 6, N) as (R, D), or (6, N) as (R,)."""
        return np.ascontiguousarray(np.moveaxis(x, (-1, -2), (0, 1))[self.sample, self.component])


@dataclass(frozen=True)
class Trials:
    """m residuals (R, m) with what the parameters U (R, K) predict taken away.

    left: what parameters fitted to all of it leave, (R, m): to be predicted. train: for every fold what parameters
    fitted to the others leave of them, zero in the fold itself, (R, FOLDS, m). White noise of a fold shows nowhere in
    what the regressors for it are trained on, not even through the parameters.
    """

    left: Array
    train: Array


class Baseline:
    """The parameters as regressors with unit variance, prepared for every fold."""

    def __init__(self, U: Array, layout: Layout) -> None:
        """U: (R, K), of which there may be none."""
        self._U, self._layout = U, layout
        grams = [U[a:b].T @ U[a:b] for a, b in layout.spans]
        whole = np.sum(grams, axis=0) + np.eye(U.shape[1])
        self._whole = np.linalg.cholesky(whole)
        self._factors = [np.linalg.cholesky(whole - g) for g in grams]

    def trials(self, r: Array) -> Trials:
        """The trials of residuals (R, m)."""
        spans = self._layout.spans
        products = [self._U[a:b].T @ r[a:b] for a, b in spans]
        whole = np.sum(products, axis=0)
        train = np.empty((len(r), len(spans), r.shape[1]))
        for k, ((a, b), own, factor) in enumerate(zip(spans, products, self._factors, strict=True)):
            train[:, k] = r - self._U @ cho_solve((factor, True), whole - own, check_finite=False)
            train[a:b, k] = 0.0
        return Trials(r - self._U @ cho_solve((self._whole, True), whole, check_finite=False), train)


class Regressor(Protocol):
    """Anything that predicts each fold of a residual from the others."""

    @property
    def name(self) -> str:
        """What from, for a person."""

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each way to set the regressor."""


@dataclass(frozen=True)
class Ridge:
    """Ridge regression on columns (R, D) of unit length, prepared for every fold and for ridges of several sizes.

    With as many columns as D, none of them special, and a share s of R unit variances expected to be explained, each
    coefficient has a variance of s R / D, and the ridge is its inverse.
    """

    name: str
    columns: Array
    layout: Layout
    factors: list[list[tuple[Array, bool]]]

    @classmethod
    def of(cls, name: str, columns: Array, layout: Layout) -> Ridge:
        """name: of the columns, for a person."""
        R, D = columns.shape
        parts = [columns[a:b] for a, b in layout.spans]
        grams = [part.T @ part for part in parts]
        whole = np.sum(grams, axis=0)
        ridges = [D / (share * R) for share in _EXPECTED]
        factors = [[cho_factor(whole - g + ridge * np.eye(D), check_finite=False) for g in grams] for ridge in ridges]
        return cls(name, columns, layout, factors)

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each size of ridge."""
        R, folds, m = trials.train.shape
        products = (self.columns.T @ trials.train.reshape(R, -1)).reshape(-1, folds, m)
        out = []
        for factors in self.factors:
            prediction = np.empty_like(trials.left)
            for k, ((a, b), factor) in enumerate(zip(self.layout.spans, factors, strict=True)):
                prediction[a:b] = self.columns[a:b] @ cho_solve(factor, products[:, k], check_finite=False)
            out.append(prediction)
        return out


@dataclass(frozen=True)
class Few:
    """Least squares on the few of many columns (R, D) of unit length that go best with the other folds, a number of
    them at a time (sure independence screening; Fan & Lv 2008).
    """

    name: str
    columns: Array
    layout: Layout
    counts: tuple[int, ...] = (2, 8)

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each number of columns."""
        R, folds, m = trials.train.shape
        products = (self.columns.T @ trials.train.reshape(R, -1)).reshape(-1, folds, m)
        out = [np.empty_like(trials.left) for _ in self.counts]
        most = min(max(self.counts), self.columns.shape[1])
        trained = np.ones(R, bool)
        for k, (a, b) in enumerate(self.layout.spans):
            size = np.abs(products[:, k])
            top = np.argpartition(-size, most - 1, axis=0)[:most]
            top = np.take_along_axis(top, np.argsort(-np.take_along_axis(size, top, 0), axis=0), 0)  # (most, m)
            X = self.columns[:, top.T.ravel()].reshape(R, m, most).transpose(1, 0, 2)
            trained[a:b] = False
            train = X[:, trained]
            trained[a:b] = True
            gram = train.transpose(0, 2, 1) @ train
            target = np.take_along_axis(products[:, k], top, 0).T
            for prediction, count in zip(out, self.counts, strict=True):
                n = min(count, most)
                held = gram[:, :n, :n] + _ALIKE * np.eye(n)
                solution = np.linalg.solve(held, target[:, :n, None])
                prediction[a:b] = (X[:, a:b, :n] @ solution)[:, :, 0].T
        return out
