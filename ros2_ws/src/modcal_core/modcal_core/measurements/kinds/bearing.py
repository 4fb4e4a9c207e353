"""Bearings: the direction in which a theodolite sees the target, as a unit vector in its own frame.

With p the target seen from the station and D its distance, the prediction is u = p / D. The residual is the turn
between the measured and the predicted direction, written as the vector across u of that length [rad];
∂u/∂p = (1 − u uᵀ) / D. One metre more for every length, stations included, changes no direction.

Place: ``b × (R p + t) = 0`` is linear in the twelve numbers of (R, t); its null vector, turned the right way round and
made a rotation, is where least squares on the directions begins (direct linear transform).
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements.kinds.kind import UNIT, Kind, Scene, Sight, lengths, not_unit
from modcal_core.measurements.recording import BEARING, POINT, ReadingTrack


class Bearing(Kind):
    """Direction from a station of unknown pose to the target."""

    name = BEARING
    topic = "tracker/bearing"
    message = "geometry_msgs/msg/Vector3Stamped"
    width = 3
    dimensions = 2
    unit = "rad"
    counts_as = POINT  # the scale is left to what is expected of the arm
    least = 6

    def see(self, scene: Scene, values: Array, reading: Array) -> Sight:
        """Residuals across the line of sight [rad]."""
        gap = scene.target - scene.T_root_frame[:3, 3:]
        distance = np.maximum(np.sqrt(np.einsum("im,im->m", gap, gap)), 1e-9)
        u = gap / distance
        b = scene.T_root_frame[:3, :3] @ reading.T
        b = b / np.linalg.norm(b, axis=0)
        along = np.einsum("im,im->m", u, b)
        across = b - along * u
        sine = np.sqrt(np.einsum("im,im->m", across, across))
        angle = np.arctan2(sine, along)
        residual = across * (angle / np.maximum(sine, 1e-300))
        through = (np.eye(3)[:, :, None] - u[:, None] * u[None]) / distance
        return Sight(residual, through, scene.target, np.zeros((0, *u.shape)), np.zeros_like(u), distance)

    def predict(self, scene: Scene, values: Array) -> Array:
        """Unit vectors in the station's frame."""
        gap = scene.T_root_frame[:3, :3].T @ (scene.target - scene.T_root_frame[:3, 3:])
        return np.asarray((gap / np.linalg.norm(gap, axis=0)).T)

    def place(self, T_base_tool: Array, reading: Array, known: Array | None = None) -> tuple[Array, Array]:
        """By direct linear transform."""
        from scipy.optimize import least_squares  # slow to import, and not for looking into a bag

        if known is not None:
            return known, np.empty(0)
        p = T_base_tool[:, :3, 3]
        b = reading / np.linalg.norm(reading, axis=1, keepdims=True)
        centre, size = p.mean(axis=0), float(np.sqrt(np.mean((p - p.mean(axis=0)) ** 2))) or 1.0
        h = np.c_[(p - centre) / size, np.ones(len(p))]
        rows = np.einsum("nij,nk->nijk", so3.hat(b), h).reshape(3 * len(p), 12)
        M = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4)
        M = M * np.sign(np.sum(b * (h @ M.T)))
        R = so3.nearest_rotation(M[:, :3])
        t = size * M[:, 3] / max(float(np.trace(R.T @ M[:, :3])) / 3.0, 1e-12)

        def miss(x: Array) -> Array:
            seen = (p - centre) @ (so3.exp(x[:3]) @ R).T + x[3:]
            return np.cross(b, seen / np.linalg.norm(seen, axis=1, keepdims=True)).ravel()

        x = least_squares(miss, np.r_[np.zeros(3), t], x_scale=[1.0] * 3 + [max(float(np.linalg.norm(t)), 0.1)] * 3).x
        R = so3.exp(x[:3]) @ R
        return se3.transform(R, x[3:] - R @ centre), np.empty(0)

    def implausible(self, values: Array, reach: float) -> np.ndarray:
        """Directions that are no unit vectors."""
        return np.asarray(~(np.abs(lengths(values) - 1.0) <= UNIT))

    def complaint(self, track: ReadingTrack, reach: float) -> tuple[str, str] | None:
        """Directions that are no unit vectors."""
        return not_unit("bearing", track.values, track.stamps, "publish unit vectors")
