"""The residual of a fit and what it could still explain, sample by sample, for candidates to be weighed against.

Each sample has six rows, weighted; what is fitted is projected out of the residual, and out of whatever is asked of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.linalg

from modcal_core.calibration import Fit, Groups, RowView, linearise
from modcal_core.diagnosis.spectra import Key
from modcal_core.effects import Drivers
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

_ROUNDING = 1e-12  # of the square of a column, added to what is inverted
_NOTHING = 1e-8  # square of a direction that the samples show nothing of
_FARTHEST = 8.0  # times the median size: noise of any usual tail stays inside, and no sample may rule alone


@dataclass(frozen=True)
class Directions:
    """Orthonormal directions, or a residual. Q: (rows, N, P). against: contractions of columns with them, (N, P)."""

    Q: Array
    against: dict[Key, Array] = field(default_factory=dict)

    def contract(self, columns: Mapping[Key, Array]) -> dict[Key, Array]:
        """Contractions of columns (6, N) with the directions, sample by sample, (N, P) each."""
        units = np.stack([column[: len(self.Q)] for column in columns.values()])
        out = np.ascontiguousarray(units.transpose(2, 0, 1)) @ np.ascontiguousarray(self.Q.transpose(1, 0, 2))
        return {key: out[:, i] for i, key in enumerate(columns)}


@dataclass(frozen=True)
class Space:
    """Weighted residual and columns, sample by sample: (6, N), rows 3 … 5 zero where there is no orientation.

    Q: orthonormal columns of all that is fitted, (6, N, D). Parameters are held by their priors, as extra rows that ask
    each to stay and are left out here: without them a direction that the readings hardly show would explain anything.
    rows: those that may not be zero. grams: what a scanner knows of its candidates beside the fitted.
    """

    view: RowView
    weight: Array
    residual: Array
    Q: Array
    freedom: int
    rows: int = 6
    columns: dict[Key, Array] = field(default_factory=dict)
    grams: list[tuple[Array, Array]] = field(default_factory=list)

    @classmethod
    def of(cls, fit: Fit, drivers: Drivers) -> Space:
        """Space of a fit at the samples of these drivers."""
        samples = drivers.samples
        weight = sample_weights(fit, samples)
        values = np.concatenate([np.zeros(len(fit.parameters)), *(e.values for e in fit.model.effects)])
        now = linearise(fit.model, fit.parameters, values, samples, drivers=drivers)
        view = RowView.of(fit.model, samples, drivers)
        held = np.zeros(len(now.J))  # of a frozen model without effects nothing is fitted
        held[: len(fit.parameters)] = [1.0 / p.prior_std for p in fit.parameters]
        N, rows = len(samples), _rows(view)
        fitted = len(fit.parameters) if fit.frozen else len(now.J)
        J = by_component(now.J[:fitted], view)
        J *= weight[:rows]
        flat = _orthonormal(J.reshape(len(J), rows * N), held[:fitted])
        D = len(flat)
        Q = np.empty((6, N, D)) if rows == 6 else np.zeros((6, N, D))
        Q[:rows] = flat.reshape(D, rows, N).transpose(1, 2, 0)
        residual = drawn_in(by_sample(now.residual, view) * weight)
        for _ in range(2):  # what samples that were not fitted miss of the fitted is no candidate's to explain
            residual[:rows] -= ((flat @ residual[:rows].ravel()) @ flat).reshape(rows, N)
        free = equations(fit, samples) - round(float(np.vdot(flat, flat)))
        return cls(view, weight, residual, Q, free, rows)

    @property
    def fitted(self) -> Directions:
        """The directions of Q."""
        return Directions(self.Q[: self.rows])

    def products(self, rows: Array) -> Array:
        """Products of rows (m, 6 N) with each other, (m, m), what is fitted projected out."""
        along = rows @ self.Q.reshape(self.residual.size, -1)
        return np.asarray(rows @ rows.T - along @ along.T)

    def spanned(self, rows: Sequence[Array]) -> Directions:
        """Directions of rows (m, 6 N), what is fitted projected out."""
        each, Q = np.concatenate([*rows, np.zeros((0, self.residual.size))]), self.Q.reshape(self.residual.size, -1)
        each = each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-300)
        _, size, flat = np.linalg.svd(each - (each @ Q) @ Q.T, full_matrices=False)
        flat = flat[size > np.sqrt(_NOTHING)]
        return Directions(flat.reshape(len(flat), *self.residual.shape)[:, : self.rows].transpose(1, 2, 0))

    def signed(self, signs: Array, beside: Directions) -> Directions:
        """The residual under the signs (trials, N) of samples, what is fitted and more projected out, as directions."""
        left = self.residual[: self.rows, :, None] * signs.T
        flat = left.reshape(-1, len(signs))
        for Q in (self.Q[: self.rows], beside.Q):
            along = Q.reshape(len(flat), -1)
            flat = flat - along @ (along.T @ flat)
        return Directions(flat.reshape(left.shape))

    @cached_property
    def total(self) -> float:
        """Squares of the residual."""
        return float(np.sum(self.residual**2)) + 1e-300

    def column(self, place: int, direction: int) -> Array:
        """Motion of the tool per unit of a direction at a place, weighted, (6, N)."""
        return by_sample(self.view.unit_column(place, direction), self.view) * self.weight


def sample_weights(fit: Fit, samples: Samples) -> Array:
    """Inverse standard deviations of the readings, (6, N)."""
    position = np.sqrt(fit.noise.of(samples) ** 2 + np.nan_to_num(samples.sigma_position) ** 2)
    rotation = np.sqrt(fit.noise.rotation**2 + np.nan_to_num(samples.sigma_rotation) ** 2)
    return np.concatenate([np.tile(1.0 / position, (3, 1)), np.tile(1.0 / rotation, (3, 1))])


def equations(fit: Fit, samples: Samples) -> int:
    """How many equations the samples give."""
    return round(Groups.of(samples, bool(fit.model.instruments)).rows)


def _orthonormal(J: Array, held: Array) -> Array:
    """Columns, which are the rows of J (P, m), each with what is held of it behind, made orthonormal, (D, m).

    What is held is left out. J is overwritten.
    """
    square = np.einsum("ij,ij->i", J, J)
    seen = np.flatnonzero(square)
    if len(seen) < len(J):
        J, square, held = J[seen], square[seen], held[seen]
    size = np.sqrt(square + held**2)
    J /= size[:, None]
    L = np.asarray(np.linalg.cholesky(J @ J.T + np.diag((held / size) ** 2 + _ROUNDING)), dtype=float)
    J = scipy.linalg.solve_triangular(L, J, lower=True, overwrite_b=True, check_finite=False)
    kept = np.einsum("ij,ij->i", J, J) > _NOTHING
    return J if kept.all() else J[kept]


def drawn_in(residual: Array) -> Array:
    """The residual (6, N) with samples beyond several times the usual size brought in to there."""
    size = np.linalg.norm(residual, axis=0)
    limit = _FARTHEST * float(np.median(size))
    return residual * np.minimum(1.0, limit / np.maximum(size, 1e-300))


def _rows(view: RowView) -> int:
    """Rows of a sample: of points alone those of the orientation are zero."""
    return 6 if len(view.pose) else 3


def by_component(J: Array, view: RowView) -> Array:
    """Rows of a linearisation (P, 3 N + 3 M) as (P, 6, N), or (P, 3, N) of points alone; the same memory, if it may."""
    N, P = view.position.shape[1], len(J)
    if len(view.pose) in (0, N):
        return J.reshape(P, _rows(view), N)
    out = np.zeros((P, _rows(view), N))
    out[:, :3] = J[:, : 3 * N].reshape(P, 3, N)
    if len(view.pose):
        out[:, 3:, view.pose] = J[:, 3 * N :].reshape(P, 3, len(view.pose))
    return out


def by_sample(row: Array, view: RowView) -> Array:
    """A row of a linearisation, (3 N + 3 M,), as (6, N)."""
    N = view.position.shape[1]
    out = np.zeros((6, N))
    out[:3] = row[: 3 * N].reshape(3, N)
    out[3:, view.pose] = row[3 * N :].reshape(3, -1)
    return out
