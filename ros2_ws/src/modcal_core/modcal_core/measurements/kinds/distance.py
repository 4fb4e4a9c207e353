"""Range to an anchor: a draw wire, a ball bar, an interferometer's length.

The reading is ``d = |p − a| + z`` with p the target on the tool, a the anchor (the origin of the frame that
``frame_id`` names) and z the zero of the scale, which nobody knows. With u the unit vector from anchor to target,
∂d/∂p = uᵀ and ∂d/∂z = 1. A ball bar of fixed length is the same with a reading that never changes.

Place: squared, ``2 p·a − 2 d z + (z² − |a|²) = |p|² − d²`` is linear in a, z and a constant (trilateration); what
rounding of noise leaves of it is polished by least squares on the readings themselves.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array, se3
from modcal_core.measurements.kinds.kind import ORIGIN, Constant, Length, Scene, Sight, millimetres
from modcal_core.measurements.recording import RANGE, ReadingTrack

_MOST = 50  # steps of a trilateration; one that takes more runs away
_CHANGE = 4.0  # times the reach, by which ranges may change: the arm's diameter, and a tool as long as the arm
_MAX_OF = (1.0, 99.0)  # %; single readings are left out, not complained of


class DistanceKind(Length):
    """Distance from a fixed anchor to the target, with the scale's zero unknown."""

    name = RANGE
    topic = "tracker/range"
    lacks = "a target"
    frame = ORIGIN
    constants = (Constant("zero", "m", 0.05),)
    least = 5

    def see(self, scene: Scene, values: Array, reading: Array) -> Sight:
        """Residuals along the line from the anchor to the target."""
        gap = scene.target - scene.T_root_frame[:3, 3:]
        length = np.sqrt(np.einsum("im,im->m", gap, gap))
        u = gap / np.maximum(length, 1e-9)
        return Sight(
            (reading[:, 0] - length - values[0]) * u,
            u[:, None] * u[None],
            scene.target,
            u[None],
            reading[:, 0] * u,
            np.ones(len(length)),
        )

    def length(self, scene: Scene, values: Array) -> Array:
        """Distances, from where the scale begins."""
        return np.asarray(np.linalg.norm(scene.target - scene.T_root_frame[:3, 3:], axis=0) + values[0])

    def place(self, T_base_tool: Array, reading: Array, known: Array | None = None) -> tuple[Array, Array]:
        """By trilateration."""
        from scipy.optimize import least_squares  # slow to import, and not for looking into a bag

        p, d = T_base_tool[:, :3, 3], reading[:, 0]
        if known is not None:
            anchor = se3.inverse(known)[:3, 3]
            return known, np.array([np.mean(d - np.linalg.norm(p - anchor, axis=1))])
        centre = p.mean(axis=0)
        q, e = p - centre, d - d.mean()
        design = np.column_stack([2.0 * q, -2.0 * e, np.ones(len(q))])
        a = np.linalg.lstsq(design, np.sum(q**2, axis=1) - d**2, rcond=1e-9)[0][:3]
        z = float(np.mean(d - np.linalg.norm(q - a, axis=1)))

        def miss(x: Array) -> Array:
            return np.asarray(np.linalg.norm(q - x[:3], axis=1) + x[3] - d)

        def slopes(x: Array) -> Array:
            away = x[:3] - q
            return np.c_[away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9), np.ones(len(q))]

        x = least_squares(miss, np.r_[a, z], slopes, loss="soft_l1", max_nfev=_MOST).x
        return se3.transform(p=-(x[:3] + centre)), x[3:]

    def implausible(self, values: Array, reach: float) -> np.ndarray:
        """Ranges of nothing, and what no arm could have moved."""
        off = np.abs(values - np.median(values)) if len(values) > 1 and reach else np.zeros((len(values), 1))
        return np.asarray(super().implausible(values, reach) | (off[:, 0] > _CHANGE * reach))

    def complaint(self, track: ReadingTrack, reach: float) -> tuple[str, str] | None:
        """Zeros, negative readings, millimetres."""
        d = track.values[:, 0]
        # the tool may stick out as far as the arm reaches
        changing = millimetres("ranges change by", float(np.ptp(np.percentile(d, _MAX_OF))), _CHANGE * reach)
        return (changing if (d > 0.0).all() else None) or super().complaint(track, reach)
