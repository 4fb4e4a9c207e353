"""Constraint planes: the tool touches a plane, or a gauge says how high above it the tool is.

The plane is z = 0 of the frame that ``frame_id`` names. The reading is the height h of the target above it, zero when
it touches: ``h = n · (p − c)``, ∂h/∂p = nᵀ. A probe's ball of unknown radius shifts the plane and nothing else.

Place: touched points lie in the plane of least squares, whose normal is the direction of their least spread; heights
that differ decide on which side is up.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements.kinds.kind import PLANE, Length, Scene, Sight, frame_on_plane, plane_of
from modcal_core.measurements.recording import TOUCH

_STEEP = 0.5  # change of heights per metre of the place, one for a plane: less is scatter of touched points


class Touch(Length):
    """Height of the target above a plane of unknown pose, zero where it touches."""

    name = TOUCH
    topic = "tracker/plane"
    noun = "heights"
    frame = PLANE
    least = 6

    def see(self, scene: Scene, values: Array, reading: Array) -> Sight:
        """Residuals along the normal."""
        n, height = scene.T_root_frame[:3, 2], self.length(scene, values)
        m = len(height)
        return Sight(
            n[:, None] * (reading[:, 0] - height),
            np.broadcast_to(np.outer(n, n)[:, :, None], (3, 3, m)),
            scene.target,
            np.zeros((0, 3, m)),
            n[:, None] * reading[:, 0],
            np.ones(m),
        )

    def length(self, scene: Scene, values: Array) -> Array:
        """Heights."""
        n, c = plane_of(scene.T_root_frame)
        return np.asarray(n @ (scene.target - c[:, None]))

    def most(self, reach: float) -> float:
        """Twice the arm's reach, where that is known."""
        return 2.0 * reach or np.inf

    def place(self, T_base_tool: Array, reading: Array, known: Array | None = None) -> tuple[Array, Array]:
        """By the plane of least squares."""
        from scipy.optimize import least_squares  # slow to import, and not for looking into a bag

        if known is not None:
            return known, np.empty(0)
        p, h = T_base_tool[:, :3, 3], reading[:, 0]
        centre = p.mean(axis=0)
        n = np.linalg.svd(p - centre, full_matrices=False)[2][-1]
        up = float(((p - centre) @ n) @ (h - h.mean())) if np.ptp(h) > 1e-9 else -float(n @ centre)
        starts = [n if up >= 0.0 else -n]
        # of a gauge over the whole workspace, how heights change with the place says more than where it spreads least
        steepest = np.linalg.lstsq(p - centre, h - h.mean(), rcond=1e-6)[0]
        if np.linalg.norm(steepest) > _STEEP:
            starts.append(steepest / np.linalg.norm(steepest))
        found = []
        for n in starts:
            across = np.linalg.svd(n[None])[2][1:]

            def normal(x: Array, n: Array = n, across: Array = across) -> Array:
                tilted = n + x[:2] @ across
                return np.asarray(tilted / np.linalg.norm(tilted))

            def miss(x: Array, normal: Callable[[Array], Array] = normal) -> Array:
                return np.asarray((p - centre) @ normal(x) - x[2] - h)

            fit = least_squares(miss, np.r_[0.0, 0.0, -h.mean()])
            found.append((float(fit.cost), normal(fit.x), float(fit.x[2])))
        _, n, offset = min(found, key=lambda one: one[0])
        return frame_on_plane(n, float(n @ centre + offset)), np.empty(0)
