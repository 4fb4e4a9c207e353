"""The residual of a fit and what it could still explain, sample by sample, for candidates to be weighed against.

Each sample has six rows, weighted; what is fitted is projected out of the residual, and out of whatever is asked of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular

from modcal_core.calibration.identify import Fit
from modcal_core.calibration.linearise import RowView, linearise
from modcal_core.calibration.noise import Groups
from modcal_core.diagnosis.banks import Key, Spectra
from modcal_core.effects.drivers import Drivers
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

_FARTHEST = 8.0  # times the median size: noise of any usual tail stays inside, and no sample may rule alone


@dataclass(frozen=True)
class SignTrials:
    """The residual with the signs of each trial, what is fitted projected out, (rows, N, trials).

    total: squares left, (trials,). known: contractions with columns, (N, trials). spectra: of those.
    """

    left: Array
    total: Array
    known: dict[Key, Array] = field(default_factory=dict)
    spectra: Spectra = field(default_factory=Spectra)

    def seen_by(self, column: Array) -> Array:
        """Contraction, sample by sample, of a column (6, N) with the trials, (N, trials)."""
        return np.asarray(np.einsum("cN,cNt->Nt", column[: len(self.left)], self.left))


@dataclass(frozen=True)
class Space:
    """Weighted residual and columns, sample by sample: (6, N), rows 3 … 5 zero where there is no orientation.

    Q: orthonormal columns of all that is fitted, (6, N, P). Parameters are held by their priors, as extra rows that ask
    each to stay and are left out here: without them a direction that the readings hardly show would explain anything.
    rows: those that may not be zero.
    """

    view: RowView
    weight: Array
    residual: Array
    Q: Array
    freedom: int
    rows: int = 6
    columns: dict[Key, Array] = field(default_factory=dict)
    against: dict[Key, Array] = field(default_factory=dict)
    spectra: Spectra = field(default_factory=Spectra)

    @classmethod
    def of(cls, fit: Fit, drivers: Drivers) -> Space:
        """Those of a fit at these drivers' samples."""
        samples = drivers.samples
        weight = sample_weights(fit, samples)
        values = np.concatenate([np.zeros(len(fit.parameters)), *(e.values for e in fit.model.effects)])
        now = linearise(fit.model, fit.parameters, values, samples, drivers=drivers)
        view = RowView.of(fit.model, samples, drivers)
        held = np.zeros(len(now.J))  # of a frozen model without effects nothing is fitted
        held[: len(fit.parameters)] = [1.0 / p.prior_std for p in fit.parameters]
        N, P = len(samples), len(now.J)
        rows = 6 if len(view.pose) else 3  # of points alone the other three are zero
        J = np.zeros((P, rows, N))
        J[:, :3] = now.J[:, : 3 * N].reshape(P, 3, N)
        if rows > 3:
            J[:, 3:, view.pose] = now.J[:, 3 * N :].reshape(P, 3, len(view.pose))
        J *= weight[:rows]
        Q = np.zeros((6, N, P))
        Q[:rows] = _orthonormal(J.reshape(P, rows * N), held).reshape(P, rows, N).transpose(1, 2, 0)
        residual = _drawn_in(_by_sample(now.residual, view) * weight)
        # What the training set got wrong of the fitted lies in its own columns: it must not be given signs, or it would
        # join the noise and hide how uneven that is.
        residual = residual - Q @ np.einsum("cNp,cN->p", Q, residual)
        free = round(Groups.of(samples, bool(fit.model.instruments)).rows) - round(float(np.sum(Q[:rows] ** 2)))
        return cls(view, weight, residual, Q, free, rows)

    def column(self, place: int, direction: int) -> Array:
        """Motion of the tool per unit of a direction at a place, weighted, (6, N)."""
        return _by_sample(self.view.unit_column(place, direction), self.view) * self.weight

    def trials(self, signs: Array) -> SignTrials:
        """The residual under signs (trials, N)."""
        Q, residual = self.Q[: self.rows], self.residual[: self.rows]
        seen = signs @ np.einsum("cNp,cN->Np", Q, residual)
        left = residual[:, :, None] * signs.T
        left -= Q @ seen.T
        return SignTrials(left, np.sum(residual**2) - np.sum(seen**2, axis=1))


def sample_weights(fit: Fit, samples: Samples) -> Array:
    """Inverse standard deviations of the readings, (6, N)."""
    position = np.sqrt(fit.noise.of(samples) ** 2 + np.nan_to_num(samples.sigma_position) ** 2)
    rotation = np.sqrt(fit.noise.rotation**2 + np.nan_to_num(samples.sigma_rotation) ** 2)
    return np.concatenate([np.tile(1.0 / position, (3, 1)), np.tile(1.0 / rotation, (3, 1))])


def _orthonormal(J: Array, held: Array) -> Array:
    """Orthonormal rows of J (P, m) with the columns diag(held) beside it, those columns left out again, (P, m)."""
    size = np.maximum(np.sqrt(np.einsum("ij,ij->i", J, J) + held**2), 1e-300)
    J, held = J / size[:, None], held / size
    L = np.linalg.cholesky(J @ J.T + np.diag(held**2 + 1e-12))
    return np.asarray(solve_triangular(L, J, lower=True, check_finite=False))


def _drawn_in(residual: Array) -> Array:
    """The residual (6, N) with samples beyond several times the usual size brought in to there."""
    size = np.linalg.norm(residual, axis=0)
    limit = _FARTHEST * float(np.median(size))
    return residual * np.minimum(1.0, limit / np.maximum(size, 1e-300))


def _by_sample(row: Array, view: RowView) -> Array:
    """A row of a linearisation, (3 N + 3 M,), as (6, N)."""
    N = view.position.shape[1]
    out = np.zeros((6, N))
    out[:3] = row[: 3 * N].reshape(3, N)
    out[3:, view.pose] = row[3 * N :].reshape(3, -1)
    return out
