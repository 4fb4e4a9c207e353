"""What a live view draws of a calibration, as plain arrays in the base link: misses, joint axes, ellipsoids.

What an arm gets wrong is too small to be seen at its size, so everything that is *off* is drawn larger by one factor,
and everything that is *where it is* is drawn at its place: an arrow begins where the model expects the tool, a
calibrated axis stands off its nominal one, an ellipsoid sits about the predicted tool.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Model, NoiseModel, errors, outlying
from modcal_core.correction.commander import finite
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Samples, SignalTrack
from modcal_core.robots import Chain, frames

DEVIATIONS = 3.0  # of the ellipsoids


@dataclass(frozen=True)
class Residuals:
    """Where a model expects the tool, and by how much it was seen elsewhere, both (N, 3) in the base link [m].

    rejected: whether a fit would leave the reading out, (N,).
    """

    expected: Array
    residual: Array
    rejected: np.ndarray

    def __len__(self) -> int:
        return len(self.expected)

    @property
    def size(self) -> Array:
        """Length of each residual, (N,) [m]."""
        return np.asarray(np.linalg.norm(self.residual, axis=1))


def known_to(model: Model, samples: Samples) -> Samples:
    """The samples in frames that a model knows, with the model's numbers for them."""
    index = {name: f for f, name in enumerate(model.frames)}
    numbers = np.array([index.get(name, -1) for name in samples.frames], dtype=int)[samples.frame]
    kept = samples.select(numbers >= 0)
    return replace(kept, frames=model.frames, frame=numbers[numbers >= 0])


def residuals(model: Model, samples: Samples, noise: NoiseModel) -> Residuals:
    """How far readings lie from where a model, with its effects, expects them.

    samples: poses and points in the model's frames. noise: how readings scatter about the calibrated model. Rows that
    do not come out finite are left out.
    """
    e = errors(model, samples)
    T_base_frame = se3.inverse(model.T_frame_base)[samples.frame]
    expected = se3.apply(T_base_frame, samples.reading - e.position)
    miss = (T_base_frame[:, :3, :3] @ e.position[..., None])[..., 0]
    finite = np.isfinite(expected).all(axis=1) & np.isfinite(miss).all(axis=1)
    return Residuals(expected[finite], miss[finite], outlying(model, noise, samples)[finite])


def arm_state_of(sample: Samples, signals: tuple[SignalTrack, ...] = ()) -> ArmState:
    """The moment at which one sample (a row) was taken, with what was received of everything else."""
    row = sample.q[0], sample.velocity[0], sample.approach[0], sample.effort[0]
    return ArmState(float(sample.stamps[0]), *row, signals, sample.path[0])


def joint_axes(chain: Chain, q: Array) -> tuple[Array, Array]:
    """A point on each joint's axis [m], and its unit direction, (n, 3) each in the base link, at positions q (n,)."""
    f = frames(chain, q[None])
    return f.p[:-1, :, 0], f.axes[:-1, 2, :, 0]


def enlarged_axes(nominal: Chain, calibrated: Chain, q: Array, scale: float) -> tuple[Array, Array]:
    """The axes of a calibrated arm, as :func:`joint_axes`, standing off the nominal ones ``scale`` times as far.

    However large the scale, a direction turns by less than a right angle.
    """
    (p, d), (p_true, d_true) = joint_axes(nominal, q), joint_axes(calibrated, q)
    off = scale * (d_true - d)
    off -= np.sum(off * d, axis=1, keepdims=True) * d
    direction = d + off
    return p + scale * (p_true - p), direction / np.linalg.norm(direction, axis=1, keepdims=True)


def ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and half axes (3,) [m] of the surface DEVIATIONS from the centre.

    covariance: (3, 3) [m²]; the rotation's columns are its principal directions.
    """
    variances, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(directions) < 0.0:
        directions[:, 0] *= -1.0
    return directions, DEVIATIONS * np.sqrt(np.maximum(variances, 0.0))


def tool_ellipsoid(correction: Correction, at: ArmState) -> tuple[Array, Array]:
    """Pose (4, 4) in the base link, and half axes (3,) [m], of the ellipsoid about the predicted tool.

    Raises MissingDriver where an effect depends on what is not known at this moment, BadCommand where it comes out
    other than finite.
    """
    correction.require(at)
    position, covariance = correction.pose(at.q, at, "tool")[:3, 3], correction.covariance(at.q, at, "tool")[:3, :3]
    finite(position, covariance)
    R, half = ellipsoid(covariance)
    return se3.transform(R, position), half
