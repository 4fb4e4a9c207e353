"""The fastest motion along a joint path: within the drives' torque at every posture, or within constant bounds.

Along q(s) the drives give τ = (M q') s̈ + (M q'' + C(q, q') q') ṡ² + g + friction, linear in s̈ and ṡ² but for viscous
friction, which goes with ṡ = √x. Lines that err on the safe side replace the root: the tangent at the last solution
where friction takes torque from the drive (its error goes as this is repeated), the chord where it helps to brake.

With x = ṡ² and u = s̈ = ½ dx/ds, whatever bounds torques or accelerations along a path reads, at each place s,

    lower(s) ≤ a(s) u + b(s) x ≤ upper(s),      0 ≤ x ≤ most(s).

On a grid with u constant between two places, x_{k+1} = x_k + 2 Δ_k u_k, so the limits are linear in x alone, and of two
timings that keep them the faster at each place keeps them too, to within what the grid itself is off: the greatest Σ x
is the fastest everywhere (a linear program; Verscheure et al., IEEE Transactions on Automatic Control 54(10), 2009).
Limits are asked for at both ends of every interval: in between they are overstepped to second order in Δ only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from modcal_core.errors import BadTable, Overloaded
from modcal_core.geometry import Array
from modcal_core.robots.acceleration import LoadedArm, Window, bias_of, largest_box
from modcal_core.robots.bodies import Bodies

# --- A path through joint positions without a time: how far along each joint stands, and its first two derivatives

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


# --- The fastest way along a path, between limits that are linear in its acceleration and its squared speed

_STOPPED = 1e-9  # of the greatest x: less is standing still


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
    """The fastest timing from rest to rest at places s (N + 1,) within these limits. Raises Overloaded where they do
    not let the path be gone at all.
    """
    N, step = len(s), np.diff(s)
    k, limits = np.arange(N - 1), []
    for end in (0, 1):  # of every interval
        of_ends = np.stack([-rows.a[k + end], rows.a[k + end]]) / (2.0 * step[:, None])
        of_ends[end] += rows.b[k + end]
        cells = (of_ends.ravel(), (np.tile(np.arange(of_ends[0].size), 2), np.repeat([k, k + 1], rows.a.shape[1])))
        matrix = coo_array(cells, (of_ends[0].size, N))
        limits.append(LinearConstraint(matrix, rows.lower[k + end].ravel(), rows.upper[k + end].ravel()))
    found = milp(-np.ones(N), bounds=Bounds(0.0, np.r_[0.0, rows.most[1:-1], 0.0]), constraints=limits)
    x = np.zeros(N) if found.x is None else np.maximum(found.x, 0.0)
    slowest = 1 + int(np.argmin(x[1:-1]))
    if not x[slowest] > _STOPPED * x.max():
        remedy = "reduce the payload, or use a path that the drives can hold everywhere"
        raise Overloaded(f"path at {s[slowest] / s[-1]:.1%} of its length", "the limits bring it to a stop", remedy)
    speed = np.sqrt(x)
    return Timing(s, x, np.r_[0.0, np.cumsum(2.0 * step / (speed[1:] + speed[:-1]))])


_ROUNDS = 3  # of tangents, after one without viscous friction
_MIN = 1e-3  # of the greatest x: tangents are taken no nearer to standing
_LEAST_PULL = 1e-30  # N m s: less friction than there is
_FASTEST = 1e3  # 1/s along the path, where no speed limit says less


def within_torque(arm: LoadedArm, path: JointPath, places: int = 500) -> Timing:
    """The fastest timing from rest to rest that takes no more than the arm's share of any drive's torque, nor of its
    speed.

    The limits are those of each posture on the way, all joints' motions and speeds coupled. places: grid points.
    Raises BadRobot where a torque is not known, Overloaded where the path cannot be held or gone.
    """
    s, drives = np.linspace(0.0, path.length, places), arm.drives
    q, dq, ddq = path.at(s)
    arm.window(q).require_held()
    bodies = Bodies.at(arm.chain, arm.loaded, q)
    M = bodies.matrix + np.diag(drives.rotor)
    a = (M @ dq[..., None])[..., 0]
    b = (M @ ddq[..., None])[..., 0] + bias_of(bodies, dq, (0.0, 0.0, 0.0))
    weight = bias_of(bodies, np.zeros_like(q), arm.gravity)
    # between two places where a joint turns back, dry friction may point either way
    signs = np.sign(np.stack([dq[[0, *range(places - 1)]], dq, dq[[*range(1, places), places - 1]]]))
    lower = -arm.share * drives.torque - weight - signs.min(axis=0) * drives.coulomb
    upper = arm.share * drives.torque - weight - signs.max(axis=0) * drives.coulomb
    rows = PathRows(a, b, lower, upper, _most(dq, drives.speed))
    timing = fastest(s, rows)
    for _ in range(_ROUNDS if drives.viscous.any() else 0):
        timing = fastest(s, _with_viscous(rows, drives.viscous * dq, timing.x))
    return timing


def within_bounds(path: JointPath, lower: ArrayLike, upper: ArrayLike, speed: ArrayLike, places: int = 500) -> Timing:
    """The fastest timing from rest to rest within constant bounds of accelerations and speeds, (n,) each."""
    s = np.linspace(0.0, path.length, places)
    _, dq, ddq = path.at(s)
    low, high = (np.broadcast_to(np.asarray(side, dtype=float), dq.shape) for side in (lower, upper))
    return fastest(s, PathRows(dq, ddq, low, high, _most(dq, np.asarray(speed, dtype=float))))


def constant_bounds(windows: Window, weights: ArrayLike | None = None) -> tuple[Array, Array]:
    """The largest constant bounds (n,) of accelerations that every posture of these windows allows: the largest box in
    what they have in common; weights: as of :meth:`Window.box`. Raises Overloaded where one of them cannot be held.
    """
    windows.require_held()
    matrix = windows.matrix.reshape(1, -1, len(windows.names))
    lower, upper = largest_box(matrix, windows.lower.reshape(1, -1), windows.upper.reshape(1, -1), weights)
    return lower[0], upper[0]


def motion(path: JointPath, timing: Timing, t: Array) -> tuple[Array, Array, Array]:
    """Positions, velocities and accelerations (m, n) of a timed path at times t (m,) [s]."""
    s, ds, dds = timing.at(t)
    q, dq, ddq = path.at(s)
    return q, dq * ds[:, None], dq * dds[:, None] + ddq * (ds**2)[:, None]


def _most(dq: Array, speed: Array) -> Array:
    """The largest x that keeps every joint within its speed."""
    with np.errstate(divide="ignore"):
        return np.minimum((speed / np.abs(dq)).min(axis=1), _FASTEST) ** 2


def _with_viscous(rows: PathRows, pull: Array, x: Array) -> PathRows:
    """The rows with pull · √x added on the safe side; x (N + 1,): where the tangent is taken."""
    takes, gives = np.maximum(pull, 0.0), np.minimum(pull, 0.0)
    # no nearer to standing than makes sense, and not where the tangent would leave nothing to stand with
    at = np.sqrt(np.maximum(x, _MIN * x.max()))[:, None]
    at_upper = np.minimum(at, rows.upper / np.maximum(takes, _LEAST_PULL))
    at_lower = np.minimum(at, -rows.lower / np.maximum(-gives, _LEAST_PULL))
    chord = 1.0 / np.sqrt(rows.most)[:, None]  # √x ≥ x / √most, and √x ≤ x / (2 √x̂) + √x̂ / 2
    # what raises a torque counts against the upper limit by its tangent, against the lower one by its chord
    b_upper = rows.b + takes * (0.5 / at_upper) + gives * chord
    b_lower = rows.b + takes * chord + gives * (0.5 / at_lower)
    none = np.full_like(pull, np.inf)
    return PathRows(
        np.concatenate([rows.a, rows.a], axis=1),
        np.concatenate([b_upper, b_lower], axis=1),
        np.concatenate([-none, rows.lower - gives * (0.5 * at_lower)], axis=1),
        np.concatenate([rows.upper - takes * (0.5 * at_upper), none], axis=1),
        rows.most,
    )
