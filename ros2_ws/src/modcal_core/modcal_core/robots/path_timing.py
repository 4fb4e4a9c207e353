"""The fastest way along a path, between limits that are linear in its acceleration and its squared speed.

With x = ṡ² and u = s̈ = ½ dx/ds, whatever bounds torques or accelerations along a path reads, at each place s,

    lower(s) ≤ a(s) u + b(s) x ≤ upper(s),      0 ≤ x ≤ most(s).

On a grid with u constant between two places, x_{k+1} = x_k + 2 Δ_k u_k. Backwards from the end, the set of speeds from
which the end can still be reached is an interval [0, K_k]; forwards from the beginning, the greatest acceleration that
stays within these sets is best at every place (Pham and Pham, A new approach to time-optimal path parameterization
based on reachability analysis, IEEE Transactions on Robotics 34(3), 2018); where a row loses its u between two places,
to within what the grid itself is off. The limits are asked for at both ends of every interval, so that between places
they are overstepped to second order in Δ only.

K_k is the largest x for which some u obeys all rows. u is eliminated by pairing each row that bounds it from below with
each that bounds it from above (Fourier and Motzkin), which leaves bounds on x alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.errors import Overloaded
from modcal_core.geometry.so3 import Array

_NONE = 1e-12  # of the largest in its row: a coefficient that counts as zero
_SLACK = 1e-9  # of the greatest x, by which rounding may miss the sets on the way forward


@dataclass(frozen=True)
class PathRows:
    """Limits at N + 1 places of a path: lower ≤ a u + b x ≤ upper, all (N + 1, m), and x ≤ most, (N + 1,)."""

    a: Array
    b: Array
    lower: Array
    upper: Array
    most: Array


@dataclass(frozen=True)
class Timing:
    """When a path is where. s: places (N + 1,). x: squared speeds there. t: times [s], from 0."""

    s: Array
    x: Array
    t: Array

    @property
    def duration(self) -> float:
        """Seconds from rest to rest."""
        return float(self.t[-1])

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """s, ṡ, s̈ (m,) at times t (m,) [s], clipped to the path's own."""
        t = np.clip(np.asarray(t, dtype=float), 0.0, self.duration)
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.s) - 2)
        u = 0.5 * np.diff(self.x) / np.diff(self.s)
        speed, since = np.sqrt(self.x[k]), t - self.t[k]
        return self.s[k] + speed * since + 0.5 * u[k] * since**2, speed + u[k] * since, u[k]


def fastest(s: Array, rows: PathRows) -> Timing:
    """The fastest timing from rest to rest at places s (N + 1,) within these limits.

    Raises Overloaded where the limits do not let the path be gone at all.
    """
    step = np.diff(s)
    reachable = np.zeros(len(s))
    for k in range(len(step) - 1, -1, -1):
        p, r, h = _interval(rows, k, 2.0 * step[k], reachable[k + 1])
        reachable[k] = min(_largest_x(p, r, h), rows.most[k])
        if not reachable[k] > 0.0:
            raise Overloaded(
                f"path at {s[k] / s[-1]:.1%} of its length",
                "no speed within the limits reaches its end",
                "reduce the payload, or use a path that the drives can hold everywhere",
            )
    x = np.zeros(len(s))
    for k in range(len(step)):
        p, r, h = _interval(rows, k, 2.0 * step[k], reachable[k + 1])
        x[k + 1] = np.clip(x[k] + 2.0 * step[k] * _largest_u(p, h - r * x[k]), 0.0, reachable[k + 1])
        if x[k + 1] <= _SLACK * reachable.max() and k + 1 < len(step):
            raise Overloaded(
                f"path at {s[k + 1] / s[-1]:.1%} of its length", "the limits bring it to a stop", "use another path"
            )
    speed = np.sqrt(x)
    return Timing(s, x, np.r_[0.0, np.cumsum(2.0 * step / (speed[1:] + speed[:-1]))])


def _interval(rows: PathRows, k: int, twice: float, reachable: float) -> tuple[Array, Array, Array]:
    """p u + r x ≤ h, (m,) each, of the interval behind place k, x being that at its beginning. twice: 2 Δ_k."""
    a = np.concatenate([rows.a[k], rows.a[k + 1] + twice * rows.b[k + 1]])
    b = np.concatenate([rows.b[k], rows.b[k + 1]])
    upper, lower = (np.concatenate([side[k], side[k + 1]]) for side in (rows.upper, rows.lower))
    p = np.concatenate([a, -a, [twice, -twice]])
    r = np.concatenate([b, -b, [1.0, -1.0]])
    h = np.concatenate([upper, -lower, [reachable, 0.0]])
    # where nothing moves a row says nothing; where it holds only rounding, neither
    keep = np.isfinite(h)
    return p[keep], r[keep], h[keep]


def _largest_x(p: Array, r: Array, h: Array) -> float:
    """The largest x of p u + r x ≤ h, where x = 0 has a solution; infinite where nothing bounds it."""
    size = np.maximum(np.abs(p), np.abs(r))
    above, below = p > _NONE * size, p < -_NONE * size
    flat = ~above & ~below & (r > 0.0)
    # u ≤ (h − r x) / p from above, ≥ from below: together a bound on x
    slope_a, end_a = r[above] / p[above], h[above] / p[above]
    slope_b, end_b = r[below] / p[below], h[below] / p[below]
    slope = slope_a[:, None] - slope_b[None, :]
    room = end_a[:, None] - end_b[None, :]
    if (room < 0.0).any():
        return 0.0
    rises = slope > 0.0
    bounds = np.concatenate([room[rises] / slope[rises], h[flat] / r[flat]])
    return float(bounds.min(initial=np.inf))


def _largest_u(p: Array, h: Array) -> float:
    """The largest u of p u ≤ h."""
    above = p > 0.0
    return float((h[above] / p[above]).min())
