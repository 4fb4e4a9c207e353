"""The square-root information form of a linear least-squares estimate, updated row by row.

What is known of x is kept as an upper triangular R and a vector z with ``R x = z + noise of unit variance``: R is, but
for the signs of its rows, the Cholesky factor of the information matrix, so nothing is squared and an estimate stays
positive definite however long it runs (Bierman 1977, *Factorization Methods for Discrete Sequential Estimation*). New
rows are taken in by one orthogonal triangularisation, which gives what a batch solution of all rows would.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, solve_triangular

from modcal_core.geometry.so3 import Array

_PANEL = 8  # columns that are eliminated together


@dataclass(frozen=True)
class Information:
    """What is known of x (P,): ``R x = z``. R: (P, P), upper triangular. z: (P,)."""

    R: Array
    z: Array

    @classmethod
    def of_prior(cls, mean: Array, covariance: Array) -> Information:
        """What a mean (P,) and a covariance (P, P) say."""
        L = np.linalg.cholesky(covariance)
        R = triangular(solve_triangular(L, np.eye(len(mean)), lower=True))
        return cls(R, R @ mean)

    def with_rows(self, A: Array, b: Array) -> Information:
        """The same with rows ``A x = b + noise of unit variance`` added, A (k, P), b (k,)."""
        P = len(self.z)
        top, rows = np.zeros((P + 1, P + 1), order="F"), np.empty((len(A), P + 1), order="F")
        top[:P, :P], top[:P, P] = self.R, self.z
        rows[:, :P], rows[:, P] = A, b
        # made for rows beneath a triangle: its zeros are not gone through
        top = lapack.dtpqrt(0, min(_PANEL, P + 1), top, rows, overwrite_a=1, overwrite_b=1)[0]
        return Information(top[:P, :P], top[:P, P])

    def grown(self, G: Array, variance: Array) -> Information:
        """The same after x has wandered by ``G w``, w (m,) being noise of these variances (m,), G (P, m).

        The noise is added as unknowns of its own, known to be about zero, and eliminated again.
        """
        moving = np.asarray(variance) > 0.0
        m, P = int(moving.sum()), len(self.z)
        if not m:
            return self
        stacked = np.zeros((m + P, m + P + 1), order="F")
        stacked[:m, :m] = np.diag(1.0 / np.sqrt(np.asarray(variance)[moving]))
        stacked[m:, :m] = -self.R @ G[:, moving]
        stacked[m:, m : m + P], stacked[m:, m + P] = self.R, self.z
        rest = triangular(stacked)[m : m + P, m:]
        return Information(rest[:, :P], rest[:, P])

    def variance_of(self, J: Array) -> Array | None:
        """Covariance of ``J x``, (k, k), for J (k, P); None while nothing at all is known of some of x."""
        half, singular = lapack.dtrtrs(self.R, J.T, trans=1)
        return None if singular else half.T @ half

    @property
    def mean(self) -> Array:
        """The estimate of x, (P,)."""
        return np.asarray(lapack.dtrtrs(self.R, self.z)[0])

    @property
    def covariance(self) -> Array:
        """Covariance of the estimate, (P, P)."""
        inverse = self.root
        return inverse @ inverse.T

    @property
    def root(self) -> Array:
        """A square root S of the covariance, ``S Sᵀ``, (P, P)."""
        return np.asarray(solve_triangular(self.R, np.eye(len(self.z)), check_finite=False))


def triangular(rows: Array) -> Array:
    """The upper triangle that an orthogonal transformation makes of rows (m, n); (min(m, n), n)."""
    return np.asarray(np.linalg.qr(rows, mode="r"))
