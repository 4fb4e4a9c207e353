"""How hard each joint may be accelerated, here and now: what gravity, friction and speed leave of the drives' torque.

Joint i's drive, of torque τ_i within ±τ_max,i, moves

    Σ_j M_ij q̈_j = τ_i − f_i − (C q̇ + g)_i,      f_i = sign(q̇_i) f_c,i + f_v,i q̇_i

(rotor inertias are on the diagonal of M), so the accelerations that all drives can give are a polytope,

    lower ≤ M q̈ ≤ upper,      upper = τ_max − f − C q̇ − g,      lower = −τ_max − f − C q̇ − g.

A joint that stands may begin to move either way: then dry friction is taken from both sides. Three readings of it:

* *equivalent*: each joint by itself, the others at rest and whatever their drives must bear left out of account,
  ``lower_i / M_ii ≤ q̈_i ≤ upper_i / M_ii``: the equivalent-inertia method, with unequal bounds up and down.
* *given*: joint i's interval in the polytope while the others accelerate as they do, all drives minded.
* *box*: bounds that hold together, whatever the others do within theirs (:mod:`modcal_core.robots.boxes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot, Overloaded
from modcal_core.geometry.so3 import Array
from modcal_core.robots.boxes import largest_box
from modcal_core.robots.chain import Chain
from modcal_core.robots.dynamics import DOWN, bias_of
from modcal_core.robots.inertia import Bodies
from modcal_core.robots.urdf_drives import Drives
from modcal_core.robots.urdf_inertias import Inertias

STILL = 1e-3  # rad/s or m/s below which a joint may begin to move either way


@dataclass(frozen=True)
class Window:
    """The accelerations that the drives can give at N postures: lower ≤ M q̈ ≤ upper.

    names: the n joints. matrix: M (N, n, n) [kg m², kg m, kg]. lower, upper: torque that is left for accelerating,
    (N, n) [N m; N].
    """

    names: tuple[str, ...]
    matrix: Array
    lower: Array
    upper: Array

    def equivalent(self) -> tuple[Array, Array]:
        """Bounds (N, n) [rad/s², m/s²] of each joint by its equivalent inertia, the diagonal of M.

        Where the drive cannot hold the joint, both bounds have one sign.
        """
        inertia = np.diagonal(self.matrix, axis1=1, axis2=2)
        return self.lower / inertia, self.upper / inertia

    def given(self, acceleration: ArrayLike) -> tuple[Array, Array]:
        """Bounds (N, n) of each joint while the others accelerate as given, (N, n) or (n,); all drives are minded.

        NaN where no acceleration of this joint keeps them all within their limits.
        """
        a = np.broadcast_to(np.asarray(acceleration, dtype=float), self.lower.shape)
        taken = (self.matrix @ a[..., None]) - self.matrix * a[:, None, :]  # row k, by all but joint i: (N, k, i)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(side[..., None] - taken) / self.matrix for side in (self.lower, self.upper)])
        untouched = self.matrix == 0.0
        within = (taken >= self.lower[..., None]) & (taken <= self.upper[..., None])
        low = np.where(untouched, np.where(within, -np.inf, np.inf), ends.min(axis=0)).max(axis=1)
        high = np.where(untouched, np.where(within, np.inf, -np.inf), ends.max(axis=0)).min(axis=1)
        return np.where(low <= high, low, np.nan), np.where(low <= high, high, np.nan)

    def box(self, weights: ArrayLike | None = None) -> tuple[Array, Array]:
        """Bounds (N, n), lower < 0 < upper, that hold together: the largest box in the polytope, by Π upper · lower.

        weights: exponents of the joints in that product, (n,), if some matter more. Raises Overloaded where the drives
        cannot even hold what there is.
        """
        self.require_held()
        return largest_box(self.matrix, self.lower, self.upper, weights)

    def held(self) -> np.ndarray:
        """Whether all drives can go on without accelerating, with torque left either way, (N,)."""
        return np.all((self.lower < 0.0) & (self.upper > 0.0), axis=1)

    def require_held(self) -> None:
        """Raises Overloaded, with the worst joint, where the drives cannot hold gravity, friction and speed."""
        if self.held().all():
            return
        short = np.maximum(self.lower, -self.upper) / (self.upper - self.lower)
        at, joint = np.unravel_index(int(np.argmax(short)), short.shape)
        half = 0.5 * (self.upper - self.lower)[at, joint]
        needed = abs(0.5 * (self.upper + self.lower)[at, joint])
        where = f" at posture {at + 1} of {len(self.lower)}" if len(self.lower) > 1 else ""
        raise Overloaded(
            f"joint {self.names[joint]}{where}",
            f"gravity, friction and speed need {needed:.4g} of the {half:.4g} N m (N) that its drive has",
            "reduce the payload or the speed, or use another posture",
        )

    def together(self) -> Window:
        """The accelerations that are within all N windows, as one window with all their rows, (1, N n, n)."""
        n = len(self.names)
        return Window(self.names, self.matrix.reshape(1, -1, n), self.lower.reshape(1, -1), self.upper.reshape(1, -1))


def window(
    chain: Chain,
    inertias: Inertias,
    drives: Drives,
    q: ArrayLike,
    velocity: ArrayLike | None = None,
    share: float = 1.0,
    gravity: Sequence[float] | Array = DOWN,
) -> Window:
    """The accelerations that the drives can give at joint positions q (N, n) and velocities (N, n), default at rest.

    share: of the drives' torque that may be used. gravity: (3,) [m/s²] in the base. Raises BadRobot where a torque
    limit, or the mass that a joint moves, is not known.
    """
    q = np.atleast_2d(np.asarray(q, dtype=float))
    v = np.zeros_like(q) if velocity is None else np.atleast_2d(np.asarray(velocity, dtype=float))
    drives.require_torque()
    bodies = Bodies.at(chain, inertias, q)
    M = bodies.matrix + np.diag(drives.rotor)
    light = np.diagonal(M, axis1=1, axis2=2).min(axis=0) <= 0.0
    if light.any():
        name = chain.names[int(np.argmax(light))]
        raise BadRobot(
            f"joint {name}", "moves nothing that has a mass", "write the links' <inertial>, or a rotor inertia"
        )
    still = np.abs(v) < STILL
    taken = bias_of(bodies, v, gravity) + drives.viscous * v + np.where(still, 0.0, np.sign(v) * drives.coulomb)
    most = share * drives.torque - np.where(still, drives.coulomb, 0.0)
    return Window(chain.names, M, -most - taken, most - taken)
