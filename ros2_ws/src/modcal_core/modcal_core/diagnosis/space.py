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
from modcal_core.diagnosis.spectra import Key, KnownSums
from modcal_core.effects import Drivers, Effect
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

ROUNDING = 1e-12  # of the square of a column, added to what is inverted
_NOTHING = 1e-8  # square of a direction that the samples show nothing of: single precision loses more of a column
_MANY = 200_000  # numbers of directions; of fewer, double precision costs nothing worth saving
_FARTHEST = 8.0  # times the median size: noise of any usual tail stays inside, and no sample may rule alone


def _contracted(columns: Mapping[Key, Array], matrix: np.ndarray) -> dict[Key, Array]:
    """Sums over the components of each sample, (N, k), of columns (6, N) times a matrix (N, rows, k)."""
    units = np.stack([column[: matrix.shape[1]] for column in columns.values()]).astype(matrix.dtype, copy=False)
    out = np.ascontiguousarray(units.transpose(2, 0, 1)) @ matrix
    return {key: out[:, i] for i, key in enumerate(columns)}


@dataclass(frozen=True)
class SignTrials:
    """The residual with the signs of each trial, what is fitted projected out, (rows, N, trials).

    total: squares left, (trials,). known: contractions with columns, (N, trials). sums: of those.
    """

    left: np.ndarray
    total: Array
    known: dict[Key, Array] = field(default_factory=dict)
    sums: KnownSums = field(default_factory=KnownSums)

    def seen_by(self, columns: Mapping[Key, Array]) -> dict[Key, Array]:
        """Contractions, sample by sample, of columns (6, N) with the trials, (N, trials) each."""
        return _contracted(columns, self.left.transpose(1, 0, 2))


@dataclass(frozen=True)
class Directions:
    """Orthonormal directions that a projector has, or has no longer. Q: (rows, N, P). sign: 1 or −1.

    against: contractions of columns with them, (N, P). grams: of banks, by their number, the products with each other
    of what lies along them, (C, m, m). sums: of contractions.
    """

    Q: Array
    sign: float = 1.0
    against: dict[Key, Array] = field(default_factory=dict)
    grams: dict[int, Array] = field(default_factory=dict)
    sums: KnownSums = field(default_factory=KnownSums)

    def along(self, residual: Array) -> tuple[Array, float]:
        """What of a residual (rows, N) lies along them, with their sign, and its square."""
        flat = self.Q.reshape(residual.size, self.Q.shape[2])
        seen = residual.ravel() @ flat
        return (flat @ (self.sign * seen)).reshape(residual.shape), self.sign * float(seen @ seen)

    def contract(self, columns: Mapping[Key, Array]) -> dict[Key, Array]:
        """Contractions of columns (6, N) with the directions, sample by sample, (N, P) each.

        Of many they are in single precision: what lies along them is known to a millionth of a column's square, and
        of that less than 0.0025 is never asked for.
        """
        return _contracted(columns, self.Q.transpose(1, 0, 2) if self.Q.size < _MANY else self.lean)

    @cached_property
    def lean(self) -> np.ndarray:
        """They in single precision, sample by sample, (N, rows, P)."""
        return np.ascontiguousarray(self.Q.transpose(1, 0, 2), dtype=np.float32)


@dataclass(frozen=True)
class Weighed:
    """What C candidates of m columns each are in the rows of a fit. inverse: of the products of their columns, the
    fitted projected out, (C, m, m). sizes: numbers of new directions, (C,).
    """

    inverse: Array
    sizes: np.ndarray

    @cached_property
    def even(self) -> bool:
        """Whether all have as many new directions."""
        return bool((self.sizes == self.sizes[:1]).all())


@dataclass(frozen=True)
class DirectionFactor:
    """How the directions of a space come from P columns at unit size: ``Q = (L⁻¹ J[seen])[kept]``.

    seen: columns of which there is something, (S,): a curve's that reach to no sample are nothing. L: triangle (S, S).
    kept: of the directions those that are more than rounding, (D,).
    """

    columns: int
    seen: np.ndarray
    L: Array
    kept: np.ndarray

    def along(self, columns: Sequence[int]) -> Array:
        """Which orthonormal sums of the directions, (D, a), go with some of the columns."""
        unit = np.eye(len(self.L))[:, np.isin(self.seen, columns)]
        F = np.linalg.qr(scipy.linalg.solve_triangular(self.L, unit, lower=True, check_finite=False))[0]
        return np.asarray(F[self.kept])


@dataclass(frozen=True)
class Space:
    """Weighted residual and columns, sample by sample: (6, N), rows 3 … 5 zero where there is no orientation.

    Q: orthonormal columns of all that is fitted, (6, N, D). Parameters are held by their priors, as extra rows that ask
    each to stay and are left out here: without them a direction that the readings hardly show would explain anything.
    rows: those that may not be zero. squares: of banks, by their number, the products of their columns with each other.
    whole, changes: of a space beside another the directions of Q, and those that come on top or go (:mod:`anchor`).
    weighed: groups of candidates, by their number. alone: effects, by their identity, with the amplitudes and the share
    of the residual that each has alone.
    """

    view: RowView
    weight: Array
    residual: Array
    Q: Array
    freedom: int
    rows: int = 6
    columns: dict[Key, Array] = field(default_factory=dict)
    squares: dict[int, Array] = field(default_factory=dict)
    whole: Directions | None = None
    changes: tuple[Directions, ...] = ()
    weighed: dict[int, Weighed] = field(default_factory=dict)
    alone: dict[int, tuple[Effect, Array, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, fit: Fit, drivers: Drivers) -> Space:
        """Space of a fit at the samples of these drivers."""
        return cls.with_factor(fit, drivers)[0]

    @classmethod
    def with_factor(cls, fit: Fit, drivers: Drivers) -> tuple[Space, DirectionFactor]:
        """The same, and how its directions come from the columns."""
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
        flat, factor = _orthonormal(J.reshape(len(J), rows * N), held[:fitted])
        D = len(flat)
        Q = np.empty((6, N, D)) if rows == 6 else np.zeros((6, N, D))
        Q[:rows] = flat.reshape(D, rows, N).transpose(1, 2, 0)
        residual = drawn_in(by_sample(now.residual, view) * weight)
        # What the training set got wrong of the fitted lies in its own columns: it must not be given signs, or it would
        # join the noise and hide how uneven that is.
        residual[:rows] -= ((flat @ residual[:rows].ravel()) @ flat).reshape(rows, N)
        free = equations(fit, samples) - round(float(np.vdot(flat, flat)))
        return cls(view, weight, residual, Q, free, rows), factor

    @cached_property
    def parts(self) -> tuple[Directions, ...]:
        """What is projected out: the directions of Q, and changes to them."""
        return (self.whole or Directions(self.Q[: self.rows]), *self.changes)

    @cached_property
    def _along(self) -> list[Array]:
        """Part of each sample's residual along the directions of each part, (N, p)."""
        return [np.einsum("cNp,cN->Np", part.Q, self.residual[: self.rows]) for part in self.parts]

    def column(self, place: int, direction: int) -> Array:
        """Motion of the tool per unit of a direction at a place, weighted, (6, N)."""
        return by_sample(self.view.unit_column(place, direction), self.view) * self.weight

    @cached_property
    def unsigned(self) -> SignTrials:
        """The residual as it is, which every question about it begins with."""
        residual = self.residual[: self.rows]
        along, squares = zip(*(part.along(residual) for part in self.parts), strict=True)
        left = residual - np.sum(along, axis=0)
        return SignTrials(left[:, :, None], np.array([np.sum(residual**2) - sum(squares)]))

    def trials(self, signs: Array) -> SignTrials:
        """The residual under signs (trials, N), in single precision: of noise, whose best is known to a few per cent,
        that is more than enough.
        """
        residual = self.residual[: self.rows].astype(np.float32)
        left = residual.T[:, :, None] * signs.T.astype(np.float32)[:, None]
        total = np.full(len(signs), np.sum(self.residual**2))
        for part, of_samples in zip(self.parts, self._along, strict=True):
            seen = signs @ of_samples
            along = part.lean.reshape(-1, part.lean.shape[2]) @ (part.sign * seen.T).astype(np.float32)
            left -= along.reshape(left.shape)
            total -= part.sign * np.sum(seen**2, axis=1)
        return SignTrials(left.transpose(1, 0, 2), total)


def sample_weights(fit: Fit, samples: Samples) -> Array:
    """Inverse standard deviations of the readings, (6, N)."""
    position = np.sqrt(fit.noise.of(samples) ** 2 + np.nan_to_num(samples.sigma_position) ** 2)
    rotation = np.sqrt(fit.noise.rotation**2 + np.nan_to_num(samples.sigma_rotation) ** 2)
    return np.concatenate([np.tile(1.0 / position, (3, 1)), np.tile(1.0 / rotation, (3, 1))])


def equations(fit: Fit, samples: Samples) -> int:
    """How many equations the samples give."""
    return round(Groups.of(samples, bool(fit.model.instruments)).rows)


def _orthonormal(J: Array, held: Array) -> tuple[Array, DirectionFactor]:
    """Columns, which are the rows of J (P, m), each with what is held of it behind, made orthonormal, (D, m).

    What is held is left out. J is overwritten.
    """
    columns, square = len(J), np.einsum("ij,ij->i", J, J)
    seen = np.flatnonzero(square)
    if len(seen) < len(J):
        J, square, held = J[seen], square[seen], held[seen]
    size = np.sqrt(square + held**2)
    J /= size[:, None]
    L = np.asarray(np.linalg.cholesky(J @ J.T + np.diag((held / size) ** 2 + ROUNDING)), dtype=float)
    if J.size:  # by the triangle's inverse, from the right: half of the time of a solution, and of its digits
        inverse = scipy.linalg.lapack.dtrtri(np.asfortranarray(L), lower=1)[0]
        J = scipy.linalg.blas.dtrmm(1.0, inverse, J.T, side=1, lower=1, trans_a=1, overwrite_b=1).T
    kept = np.einsum("ij,ij->i", J, J) > _NOTHING
    return (J if kept.all() else J[kept]), DirectionFactor(columns, seen, L, np.flatnonzero(kept))


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
