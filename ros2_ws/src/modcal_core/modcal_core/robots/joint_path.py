"""A path through joint positions without a time: how far along each joint stands, and its first two derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array

_SAME = 1e-9  # rad or m between waypoints that are one


@dataclass(frozen=True)
class JointPath:
    """A smooth path q(s), 0 ≤ s ≤ length. spline: with values (n,) [rad, m]."""

    spline: CubicSpline

    @classmethod
    def through(cls, waypoints: ArrayLike) -> JointPath:
        """The natural cubic spline through postures (m, n), s being the length of the straight lines between them.

        Raises BadTable where there are fewer than two, or two that follow each other are one.
        """
        q = np.asarray(waypoints, dtype=float)
        if q.ndim != 2 or len(q) < 2 or not np.isfinite(q).all():
            raise BadTable("joint path", f"has waypoints of shape {q.shape}", "give two or more postures, all finite")
        steps = np.linalg.norm(np.diff(q, axis=0), axis=1)
        if steps.min() < _SAME:
            k = int(np.argmin(steps))
            raise BadTable(f"joint path: waypoints {k + 1} and {k + 2}", "are one posture", "leave one of them out")
        return cls(CubicSpline(np.r_[0.0, np.cumsum(steps)], q, bc_type="natural"))

    @property
    def length(self) -> float:
        """Where the path ends."""
        return float(self.spline.x[-1])

    def at(self, s: ArrayLike) -> tuple[Array, Array, Array]:
        """q, dq/ds, d²q/ds² (N, n) at places s (N,)."""
        s = np.asarray(s, dtype=float)
        return self.spline(s), self.spline(s, 1), self.spline(s, 2)
