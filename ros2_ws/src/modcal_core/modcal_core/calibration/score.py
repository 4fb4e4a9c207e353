"""How far a model misses: sizes of position and orientation errors on given samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.linearisation import RowView
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import REJECT_Z, Groups, NoiseModel, standard_score
from modcal_core.geometry import Array, so3
from modcal_core.measurements import Samples

FINEST = 2e-6  # m and rad; no instrument resolves less, so nothing is called wrong by less


@dataclass(frozen=True)
class ErrorSize:
    """Mean, root mean square, 95th percentile and largest of error norms, in the unit of the norms."""

    mean: float
    rms: float
    p95: float
    max: float

    @classmethod
    def of(cls, norms: Array) -> ErrorSize | None:
        """Sizes of these norms (N,), or None when there are none."""
        if not len(norms):
            return None
        rms = float(np.sqrt(np.mean(norms**2)))
        return cls(float(norms.mean()), rms, float(np.percentile(norms, 95)), float(norms.max()))


@dataclass(frozen=True)
class Errors:
    """Errors of samples: position (N, 3) [m] in each reading's frame, rotation (M, 3) [rad] of the M pose samples.

    Of a reading that is no position it is the miss at the tool along what the reading shows, from the root. lever:
    metres at the tool per unit of the reading, (N,); None where all are positions.
    """

    position: Array
    rotation: Array
    lever: Array | None = None

    @property
    def position_norm(self) -> Array:
        """Distances [m], (N,)."""
        return np.linalg.norm(self.position, axis=1)

    @property
    def reading_norm(self) -> Array:
        """Sizes in the unit that each reading's noise is in, (N,)."""
        return self.position_norm if self.lever is None else self.position_norm / self.lever

    @property
    def rotation_norm(self) -> Array:
        """Angles [rad], (M,)."""
        return np.linalg.norm(self.rotation, axis=1)

    def size_mm(self) -> ErrorSize | None:
        """Sizes of the position errors [mm]."""
        return ErrorSize.of(1e3 * self.position_norm)

    def size_deg(self) -> ErrorSize | None:
        """Sizes of the orientation errors [deg]; None where nothing had an orientation."""
        return ErrorSize.of(np.degrees(self.rotation_norm))


def errors(model: Model, samples: Samples) -> Errors:
    """Measured minus predicted, for every sample."""
    T = model.predict_samples(samples)
    pose = samples.is_pose
    rotation = so3.log(samples.R[pose] @ np.swapaxes(T[pose, :3, :3], -1, -2))
    gap, lever = samples.reading - T[:, :3, 3], None
    if model.instruments:
        sights = RowView.of(model, samples, model.drivers(samples)).sights
        if sights is not None:
            lever = sights.lever
            gap[sights.rows] = (sights.residual * lever[sights.rows]).T
    return Errors(gap, rotation, lever)


def usual_miss(model: Model, samples: Samples) -> float:
    """Median distance [m] by which a model misses samples."""
    return float(np.median(errors(model, samples).position_norm))


def outlying(model: Model, noise: NoiseModel, samples: Samples) -> np.ndarray:
    """True for samples so far outside this noise that a fit would have rejected them, (N,)."""
    size = squared_residuals(errors(model, samples), samples, noise, FINEST)
    return standard_score(size, Groups.of(samples, bool(model.instruments)).dimensions) > REJECT_Z


def typical_scatter(samples: Samples) -> tuple[float, float]:
    """Median deviation of the readings' positions [m, or the kind's unit] and orientations [rad]; 0 where unknown."""
    known = (samples.sigma_position, samples.sigma_rotation[samples.is_pose])
    position, rotation = (float(np.median(s[np.isfinite(s)])) if np.isfinite(s).any() else 0.0 for s in known)
    return position, rotation


def squared_residuals(e: Errors, samples: Samples, noise: NoiseModel, finest: float = 0.0) -> Array:
    """Squares of each sample's error, (N,), in variances: of this noise, no less than the finest, and of the reading's
    own scatter.
    """
    known_p = np.nan_to_num(samples.sigma_position)
    total = e.reading_norm**2 / (np.maximum(noise.of(samples), finest) ** 2 + known_p**2)
    pose = samples.is_pose
    if pose.any():
        known_r = np.nan_to_num(samples.sigma_rotation[pose])
        total[pose] += e.rotation_norm**2 / (max(noise.rotation, finest) ** 2 + known_r**2)
    return total
