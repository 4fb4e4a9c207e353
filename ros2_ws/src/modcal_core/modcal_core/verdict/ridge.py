"""Ridge regression judged out of fold: every part of a vector is predicted from the others."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from modcal_core.geometry.so3 import Array

FOLDS = 5  # of cross-validation; the usual number (Breiman & Spector 1992)
_EXPECTED = (0.05, 0.5)  # shares of the residual that a group may be expected to explain: sets the ridge


@dataclass(frozen=True)
class Layout:
    """How components of samples (6, N), sorted by fold, lie in one vector (R,), sample after sample.

    sample, component: of each of the R. spans: first and end of each fold in it. samples: the same among samples.
    """

    sample: np.ndarray
    component: np.ndarray
    spans: tuple[tuple[int, int], ...]
    samples: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, ends: np.ndarray, seen: np.ndarray) -> Layout:
        """ends: first sample of each fold, and N. seen: which components there are, (6, N)."""
        sample, component = np.nonzero(seen.T)
        folds = np.searchsorted(sample, ends).tolist()
        return cls(sample, component, tuple(pairwise(folds)), tuple(pairwise(ends.tolist())))

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

    def trained(self, columns: Columns) -> Trained:
        """How columns are trained."""
        own = columns.products(self._U.T)
        return Trained(columns, own.sum(axis=0) - own)


class Projection:
    """What is left of columns when a regression on U is taken out of them."""

    def __init__(self, U: Array) -> None:
        """U: regressors (K, R) of unit variance, of which there may be none."""
        value, vector = np.linalg.eigh(U @ U.T)
        keep = value > 1e-12 * value.max(initial=1e-300)
        self.Q = (vector[:, keep] / np.sqrt(value[keep])).T @ U
        self.out = value[keep] / (1.0 + value[keep])

    def __call__(self, x: Array) -> Array:
        """Columns (D, R) less what U predicts of them."""
        return np.asarray(x - ((x @ self.Q.T) * self.out) @ self.Q) if len(self.Q) else x


class Columns(Protocol):
    """D regressors of R rows each."""

    def products(self, x: Array) -> Array:
        """Products with x (R, m) over each fold, (FOLDS, D, m)."""


@dataclass(frozen=True)
class Plain:
    """Columns (D, R) as they are."""

    columns: Array
    layout: Layout

    def products(self, x: Array) -> Array:
        """Products with x (R, m) over each fold, (FOLDS, D, m)."""
        return np.stack([self.columns[:, a:b] @ x[a:b] for a, b in self.layout.spans])


@dataclass(frozen=True)
class Trained:
    """Columns that are trained on what the parameters leave of the other folds.

    against: products with the parameters over the other folds, (FOLDS, D, K).
    """

    columns: Columns
    against: Array

    def products(self, trials: Trials) -> Array:
        """Products with what each fold's regressors are trained on, (FOLDS, D, m)."""
        own = self.columns.products(trials.residual)
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
    columns: Array
    layout: Layout
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
        return cls(name, columns, baseline.layout, baseline.trained(Plain(columns, baseline.layout)), factors)

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each size of ridge."""
        products = self.trained.products(trials)
        out = []
        for factors in self.factors:
            prediction = np.empty_like(trials.left)
            for (a, b), own, factor in zip(self.layout.spans, products, factors, strict=True):
                prediction[a:b] = self.columns[:, a:b].T @ cho_solve(factor, own, check_finite=False)
            out.append(prediction)
        return out
