"""The curvature of a fit's cost, factored: steps and the covariance come from one factor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from modcal_core.geometry.so3 import Array

_RIDGES = (0.0, 1e-12, 1e-10, 1e-8)  # of the scaled curvature, where it is singular to rounding


def inverse_of_triangle(lower: Array) -> Array:
    """The inverse of a lower triangle (P, P), zeros above its diagonal. What lower has there is not read."""
    return np.tril(scipy.linalg.lapack.dtrtri(lower, lower=1)[0])


@dataclass(frozen=True)
class Curvature:
    """JᵀWJ with the prior, (P, P), at unit diagonal: ``diag(scale) H diag(scale) = L Lᵀ``, damped as a step asks.

    lower: L, (P, P); None where it is singular to rounding, and steps are the least that serve. scaled: what it is of.
    """

    scale: Array
    scaled: Array
    lower: Array | None

    @classmethod
    def of(cls, H: Array, damping: float = 0.0) -> Curvature:
        """Factor of H (P, P), with damping added to its scaled diagonal."""
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        scaled = H * scale
        scaled *= scale[:, None]
        for ridge in _RIDGES:
            damped = scaled.T.copy(order="F")
            damped.flat[:: len(H) + 1] += damping + ridge
            lower, singular = scipy.linalg.lapack.dpotrf(damped, lower=1, clean=0, overwrite_a=1)
            if not singular:
                return cls(scale, scaled, lower)
        return cls(scale, scaled, None)

    def solve(self, g: Array) -> Array:
        """``H⁻¹ g``, damped, of g (P,)."""
        right = self.scale * g
        if self.lower is None:
            return np.asarray(self.scale * np.linalg.lstsq(self.scaled, right, rcond=1e-12)[0], dtype=float)
        return np.asarray(self.scale * scipy.linalg.lapack.dpotrs(self.lower, right, lower=1)[0])

    def inverse(self) -> Array:
        """``H⁻¹``, (P, P)."""
        if self.lower is None:
            inverse = np.linalg.lstsq(self.scaled, np.eye(len(self.scaled)), rcond=1e-12)[0]
            return np.asarray(inverse * np.outer(self.scale, self.scale), dtype=float)
        half = inverse_of_triangle(self.lower) * self.scale
        return half.T @ half

    def variances(self) -> Array:
        """The diagonal of ``H⁻¹``, (P,)."""
        if self.lower is None:
            return np.diag(self.inverse())
        half = inverse_of_triangle(self.lower)
        return np.asarray(np.einsum("ij,ij->j", half, half) * self.scale**2)
