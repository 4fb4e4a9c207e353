"""What knowing a parameter is worth, before and after the measurements that are planned.

The errors of an arm before calibration are taken as independent with standard deviations Δg: C = diag(Δg²) is their
covariance. The measurements leave C' = (C⁻¹ + Jᵀ W J)⁻¹. Over the postures where accuracy counts, with derivatives G,
the mean square of the position error is V = mean tr(G C Gᵀ), and of it

    V_k = mean ‖G C e_k‖² / C_kk

goes away when parameter k comes to be known exactly: that is its gain. Before, it is the parameter's share; afterwards
it counts only what the measurements have left, so a parameter that is seen only together with another one has no gain
left when the two also act together. *Matters and is not seen* is said where a parameter had a share worth naming and
more than half of it is still there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array

NAMED = 0.01  # share of the mean square error from which on a parameter matters
_LEFT = 0.5  # share of a gain that, if left over, calls a parameter not seen


@dataclass(frozen=True)
class Gain:
    """mean_square: V [m²]. of_each: V_k [m²], (P,), what goes away when only parameter k is known exactly."""

    mean_square: float
    of_each: Array

    @property
    def rms(self) -> float:
        """RMS position error [m]."""
        return float(np.sqrt(self.mean_square))

    @property
    def share(self) -> Array:
        """Shares of the mean square error, (P,)."""
        return self.of_each / max(self.mean_square, 1e-300)

    @property
    def rms_gain(self) -> Array:
        """By how much the RMS error [m] falls when the parameter comes to be known, (P,)."""
        return self.rms - np.sqrt(np.maximum(self.mean_square - self.of_each, 0.0))


def gains(G: Array, covariance: Array) -> Gain:
    """The gain from knowing each parameter, for derivatives G (N, 3, P) of positions and a covariance (P, P)."""
    GC = G @ covariance
    of_each = np.mean(np.sum(GC**2, axis=1), axis=0) / np.maximum(np.diag(covariance), 1e-300)
    return Gain(float(np.mean(np.sum(GC * G, axis=(1, 2)))), of_each)


def left_by(J: Array, std: Array, sizes: Array) -> Array:
    """Covariance (P, P) that readings leave. J: derivatives of all readings, (R, P). std: of each, (R,). sizes: Δg."""
    scaled = J * sizes / std[:, None]
    information = np.eye(len(sizes)) + scaled.T @ scaled
    return np.linalg.inv(information) * np.outer(sizes, sizes)


@dataclass(frozen=True)
class JointGain:
    """Gains before and after measurements. seen: 1 − (deviation after / before)², (P,): 0 nothing is learned, 1 all."""

    before: Gain
    after: Gain
    seen: Array

    @property
    def unseen(self) -> np.ndarray:
        """True for parameters that matter and that the measurements leave open, (P,)."""
        left = self.after.of_each / np.maximum(self.before.of_each, 1e-300)
        return (self.before.share >= NAMED) & (left > _LEFT)


def joint_use(G: Array, sizes: Array, J: Array, std: Array) -> JointGain:
    """Sensitivity and observability together: derivatives G (N, 3, P) where it counts, J (R, P) of what is measured.

    std: of each reading [m or rad], (R,). sizes: Δg (P,) [m, rad].
    """
    before = np.diag(sizes**2)
    after = left_by(J, std, sizes)
    seen = 1.0 - np.diag(after) / np.maximum(sizes**2, 1e-300)
    return JointGain(gains(G, before), gains(G, after), np.where(sizes > 0.0, seen, 0.0))
