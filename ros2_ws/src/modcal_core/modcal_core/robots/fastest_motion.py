"""The fastest motion along a joint path: within the drives' torque at every posture, or within constant bounds.

Along q(s) the drives give τ = (M q') s̈ + (M q'' + C(q, q') q') ṡ² + g + friction, linear in s̈ and ṡ² but for viscous
friction, which goes with ṡ = √x. There the square root is replaced by lines that err on the safe side: where friction
takes torque from the drive by its tangent at the last solution (so the error goes as this is repeated), where it helps
to brake by its chord. The direction of every joint is known along a path, and with it the sign of dry friction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry.so3 import Array
from modcal_core.robots.acceleration import Window, window
from modcal_core.robots.chain import Chain
from modcal_core.robots.dynamics import DOWN, bias_of
from modcal_core.robots.inertia import Bodies
from modcal_core.robots.joint_path import JointPath
from modcal_core.robots.path_timing import PathRows, Timing, fastest
from modcal_core.robots.urdf_drives import Drives
from modcal_core.robots.urdf_inertias import Inertias

_ROUNDS = 3  # of tangents, after one without viscous friction
_MIN = 1e-3  # of the greatest x: tangents are taken no nearer to standing
_NONE = 1e-30  # N m s: less friction than there is
_FASTEST = 1e3  # 1/s along the path, where no speed limit says less


def within_torque(
    chain: Chain,
    inertias: Inertias,
    drives: Drives,
    path: JointPath,
    share: float = 1.0,
    places: int = 500,
    gravity: Sequence[float] | Array = DOWN,
) -> Timing:
    """The fastest timing from rest to rest that takes no more than this share of any drive's torque, nor of its speed.

    The limits are those of each posture on the way, all joints' motions and speeds coupled. places: grid points.
    Raises BadRobot where a torque is not known, Overloaded where the path cannot be held or gone.
    """
    s = np.linspace(0.0, path.length, places)
    q, dq, ddq = path.at(s)
    window(chain, inertias, drives, q, share=share, gravity=gravity).require_held()
    bodies = Bodies.at(chain, inertias, q)
    M = bodies.matrix + np.diag(drives.rotor)
    a = (M @ dq[..., None])[..., 0]
    b = (M @ ddq[..., None])[..., 0] + bias_of(bodies, dq, (0.0, 0.0, 0.0))
    weight = bias_of(bodies, np.zeros_like(q), gravity)
    # between two places where a joint turns back, dry friction may point either way
    signs = np.sign(np.stack([dq[[0, *range(places - 1)]], dq, dq[[*range(1, places), places - 1]]]))
    lower = -share * drives.torque - weight - signs.min(axis=0) * drives.coulomb
    upper = share * drives.torque - weight - signs.max(axis=0) * drives.coulomb
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
    """The largest constant bounds (n,) of accelerations that every posture of these windows allows, all joints at once.

    The largest box in what the windows have in common; weights: as of :meth:`Window.box`. Raises Overloaded where one
    of them cannot be held.
    """
    windows.require_held()
    lower, upper = windows.together().box(weights)
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
    at_upper = np.minimum(at, rows.upper / np.maximum(takes, _NONE))
    at_lower = np.minimum(at, -rows.lower / np.maximum(-gives, _NONE))
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
