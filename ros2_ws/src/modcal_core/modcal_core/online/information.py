"""The square-root information form of a linear least-squares estimate, updated row by row.

What is known of x is kept as an upper triangular R and a vector z with ``R x = z + noise of unit variance``: R is, but
for the signs of its rows, the Cholesky factor of the information matrix, so nothing is squared and an estimate stays
positive definite however long it runs (Bierman 1977, *Factorization Methods for Discrete Sequential Estimation*). New
rows are taken in by one orthogonal triangularisation, which gives what a batch solution of all rows would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack, solve_triangular

from modcal_core.geometry.so3 import Array

_PANEL = 8  # columns that are eliminated together


@dataclass(frozen=True)
class Information:
    """What is known of x (P,): ``R x = z``.

    triangle: (P + 1, P + 1), upper triangular, in Fortran's order: R, z beside it, and in the corner below z what the
    rows that were added last could not be made to agree with the rest. definite: something is known of all of x.
    """

    triangle: Array
    definite: bool

    @classmethod
    def of(cls, R: Array, z: Array) -> Information:
        """``R x = z``, R (P, P) being upper triangular."""
        P = len(z)
        triangle = np.zeros((P + 1, P + 1), order="F")
        triangle[:P, :P], triangle[:P, P] = R, z
        return cls(triangle, _definite(R))

    @classmethod
    def of_prior(cls, mean: Array, covariance: Array) -> Information:
        """What a mean (P,) and a covariance (P, P) say."""
        L = np.linalg.cholesky(covariance)
        R = triangular(solve_triangular(L, np.eye(len(mean)), lower=True))
        return cls.of(R, R @ mean)

    @property
    def R(self) -> Array:
        """(P, P), upper triangular."""
        return self.triangle[:-1, :-1]

    @property
    def z(self) -> Array:
        """What ``R x`` is, (P,)."""
        return self.triangle[:-1, -1]

    def with_rows(self, rows: Array) -> Information:
        """The same with rows ``A x = b + noise of unit variance`` added, which are given as [A b], (k, P + 1)."""
        triangle = self.triangle.copy(order="F")
        triangle[-1, -1] = 0.0
        # made for rows beneath a triangle: its zeros are not gone through
        triangle = lapack.dtpqrt(0, min(_PANEL, len(triangle)), triangle, rows, overwrite_a=1)[0]
        return Information(triangle, self.definite or _definite(triangle[:-1, :-1]))

    @property
    def innovation(self) -> float:
        """How far the rows that were added last lay from what had been expected of them, squared: ``rᵀ S⁻¹ r``.

        r is their residual before and S its covariance. A sum of squares grows by this where its least is found again,
        so it stands in the corner, and nothing has to be solved for it.
        """
        return float(self.triangle[-1, -1]) ** 2

    def grown(self, G: Array, variance: Array) -> Information:
        """The same after x has drifted by ``G w``, w (m,) being noise of these variances (m,), G (P, m).

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
        return replace(Information.of(rest[:, :P], rest[:, P]), definite=self.definite)

    @property
    def mean(self) -> Array:
        """The estimate of x, (P,)."""
        # the last row is beneath what is solved, and stays: without it the triangle would have to be copied
        return np.asarray(lapack.dtrtrs(self.triangle[:, :-1], self.z)[0])

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


def _definite(R: Array) -> bool:
    """Whether every column of R (P, P) has something of its own, beyond what is left by rounding."""
    return bool((np.abs(np.diagonal(R)) > len(R) * np.finfo(float).eps * np.linalg.norm(R, axis=0)).all())
