"""Ridge regression judged out of fold: every part of a vector is predicted from the others.

The parameters are solved for in double precision, and regressors on unit columns in single: ridges hold them to a
condition of some thousands, so predictions are right to a ten-thousandth of the noise that judges them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, cast

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from modcal_core.geometry import Array

FOLDS = 5  # of cross-validation; the usual number (Breiman & Spector 1992)
_EXPECTED = (0.05, 0.5)  # shares of the residual that a group may be expected to explain: sets the ridge


def single(x: Array) -> Array:
    """The same numbers in single precision."""
    return cast(Array, x.astype(np.float32))


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
    """m residuals (R, m) with what K parameters predict taken away.

    left: what parameters fitted to all of it leave, (R, m): to be predicted. seen: products of each fold with the
    orthonormal directions that the parameters move it along, (FOLDS, K, m). moved: along these directions, by the
    parameters that are fitted to the other folds, (FOLDS, K, m). What they leave of the others is what regressors for
    this fold are trained on, so white noise of a fold shows nowhere in it, not even through the parameters.
    """

    residual: Array
    left: Array
    seen: Array
    moved: Array


class Baseline:
    """The parameters as regressors with unit variance, prepared for every fold.

    directions: orthonormal ones that they move a residual along, (K, R). shared: products of these over each fold,
    (FOLDS, K, K), which add up to the identity. predicted: what of each direction the parameters predict when fitted to
    all of it, (K,). All for columns in single precision.
    """

    def __init__(self, U: Array, layout: Layout) -> None:
        """U: (K, R), of which there may be none."""
        value, vector = np.linalg.eigh(U @ U.T)
        keep = value > 1e-12 * value.max(initial=1e-300)
        value = value[keep]
        self.layout, self._root, self._predicted = layout, np.sqrt(value), value / (1.0 + value)
        self._directions = (vector[:, keep] / self._root).T @ U
        shared = np.stack([part @ part.T for part in (self._directions[:, a:b] for a, b in layout.spans)])
        both = np.outer(self._root, self._root)
        self._factors = [np.linalg.cholesky(np.diag(1.0 + value) - both * own) for own in shared]
        self.directions, self.shared, self.predicted = map(single, (self._directions, shared, self._predicted))

    def without(self, x: Array) -> Array:
        """Columns (D, R) less what the parameters predict of them."""
        Q = self.directions
        return np.asarray(x - ((x @ Q.T) * self.predicted) @ Q) if len(Q) else x

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
        return Trials(single(r), single(left), single(seen), single(np.stack(moved)))


class Regressor(Protocol):
    """Anything that predicts each fold of a residual from the others."""

    @property
    def name(self) -> str:
        """What from, as text."""

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each way to set the regressor."""


@dataclass(frozen=True)
class Ridge:
    """Ridge regression on columns (D, R) of unit length, in single precision, for every fold and several ridges.

    With as many columns as D, none of them special, and a share s of R unit variances expected to be explained, each
    coefficient has a variance of s R / D, and the ridge is its inverse. along: products with the parameters' directions
    over the folds other than each, (FOLDS, D, K).
    """

    name: str
    columns: Array
    layout: Layout
    along: Array
    factors: list[list[tuple[Array, bool]]]

    @classmethod
    def of(cls, name: str, columns: Array, baseline: Baseline) -> Ridge:
        """name: of the columns, as text."""
        D, R = columns.shape
        spans, Q = baseline.layout.spans, baseline.directions
        parts = [columns[:, a:b] for a, b in spans]
        grams = [part @ part.T for part in parts]
        whole = np.sum(grams, axis=0)
        ridges = [D / (share * R) for share in _EXPECTED]
        factors = [[_factored(whole - gram, ridge) for gram in grams] for ridge in ridges]
        own = np.stack([part @ Q[:, a:b].T for part, (a, b) in zip(parts, spans, strict=True)])
        return cls(name, columns, baseline.layout, own.sum(axis=0) - own, factors)

    def predictions(self, trials: Trials) -> list[Array]:
        """Predictions (R, m) of what is left in the trials, one for each size of ridge."""
        own = np.stack([self.columns[:, a:b] @ trials.residual[a:b] for a, b in self.layout.spans])
        products = np.subtract(own.sum(axis=0), own, out=own)
        products -= self.along @ trials.moved
        out = []
        for factors in self.factors:
            prediction = np.empty_like(trials.left)
            for (a, b), target, factor in zip(self.layout.spans, products, factors, strict=True):
                prediction[a:b] = self.columns[:, a:b].T @ cho_solve(factor, target, check_finite=False)
            out.append(prediction)
        return out


def _factored(gram: Array, ridge: float) -> tuple[Array, bool]:
    """Cholesky factor of a symmetric matrix (D, D) with a ridge on its diagonal; the matrix is overwritten."""
    gram.flat[:: len(gram) + 1] += ridge
    return cast(tuple[Array, bool], cho_factor(gram.T, overwrite_a=True, check_finite=False))  # of columns: no copy
