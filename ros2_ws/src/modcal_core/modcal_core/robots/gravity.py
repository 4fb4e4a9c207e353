"""What gravity asks of every joint: force and moment of all that hangs beyond it."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array, crossed_rows
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import Frames, frames, posture_frames
from modcal_core.robots.urdf_inertias import HeldBehind, Inertias

STANDARD_GRAVITY = 9.80665  # m/s²
DOWN = np.array([0.0, 0.0, -1.0])  # in the base, where nothing else is known


def chain_gravity_wrench(chain: Chain, inertias: Inertias, q: Array, moved: Array | None = None) -> Array:
    """Weight of the bodies beyond each joint, (n, 6, N): force [N], moment about the joint's origin [N m].

    Both in the frame just before the joint's motion, with its axis along z, so row 5 is the torque about a turning
    joint's axis and row 2 the force along a sliding one's. q: joint positions (N, n). moved: how
    far bodies' centres are from where the inertias have them, behind each joint, (n, N, 3) [m].
    """
    f = frames(chain, q)
    centres = np.stack([_centre(chain, inertias, q, f, k, moved) for k in range(chain.n)])
    return _wrench(chain, f, inertias.mass, centres, inertias.down, inertias.held)


class HeldWeight:
    """What joints give at rest for the weight of their bodies, of one posture at a time, for where a clock runs.

    Of an arm that is held at its base.
    """

    def __init__(self, chain: Chain, inertias: Inertias) -> None:
        """Prepare the bodies of a chain."""
        self._chain, self._down = chain, inertias.down
        self._local = np.einsum("ki,kij->kj", inertias.com, chain.joint_basis)  # with the joints' axes as z [m]
        self._weight = (STANDARD_GRAVITY * inertias.mass)[:, None]
        self._beyond = np.cumsum(self._weight[::-1], axis=0)[::-1]  # of all bodies that a joint carries [N]

    def efforts(self, q: Array) -> Array:
        """Torques (n,) [N m; N] that hold the arm at a posture q (n,)."""
        before, _ = posture_frames(self._chain, q)
        p = before[:, :3, 3]
        x, y, z = self._local.T
        c, s = np.cos(q), np.sin(q)
        local = np.stack([c * x - s * y, s * x + c * y, z], axis=1)
        if not self._chain.revolute.all():
            slides = np.stack([x, y, z + q], axis=1)
            local = np.where(self._chain.revolute[:, None], local, slides)
        centres = p + (before[:, :3, :3] @ local[:, :, None])[:, :, 0]
        moments = np.cumsum((self._weight * centres)[::-1], axis=0)[::-1] - self._beyond * p
        return self._about(before, moments, self._beyond)

    def of_load(self, q: Array) -> Array:
        """The same (n,) for 1 kg at the tip."""
        before, tip = posture_frames(self._chain, q)
        weight = np.full((len(q), 1), STANDARD_GRAVITY)
        return self._about(before, weight * (tip[:3, 3] - before[:, :3, 3]), weight)

    def _about(self, before: Array, moments: Array, weight: Array) -> Array:
        """Efforts against weights (n, 1) [N] that have moments (n, 3) [N m] about the joints."""
        axes = before[:, :3, 2]
        turning = -(moments * crossed_rows(np.broadcast_to(self._down, axes.shape), axes)).sum(axis=1)
        if self._chain.revolute.all():
            return np.asarray(turning)
        return np.where(self._chain.revolute, turning, -weight[:, 0] * (axes @ self._down))


def payload_wrench(chain: Chain, q: Array, down: Array = DOWN, held: HeldBehind | None = None) -> Array:
    """The same, (n, 6, N), of a mass of 1 kg at the tip. down: unit vector (3,) in the base. held: as of inertias."""
    f = frames(chain, q)
    return _tip_wrench(chain, f, f.p[-1], down, held)


def _tip_wrench(chain: Chain, f: Frames, at: Array, down: Array, held: HeldBehind | None) -> Array:
    """The wrenches, (n, 6, N), of 1 kg at points (3, N) that move with the last joint."""
    mass = np.zeros(chain.n)
    mass[-1] = 1.0
    held = None if held is None else held.empty
    return _wrench(chain, f, mass, np.broadcast_to(at, (chain.n, *at.shape)), down, held)


def offset_wrench(chain: Chain, q: Array, down: Array = DOWN, held: HeldBehind | None = None) -> Array:
    """How the latter changes with each metre that the mass is beside the tip, along the tip's x, y, z, (3, n, 6, N)."""
    f = frames(chain, q)
    own = _tip_wrench(chain, f, f.p[-1], down, held)
    return np.stack([_tip_wrench(chain, f, f.p[-1] + f.axes[-1, d], down, held) - own for d in range(3)])


def _centre(chain: Chain, inertias: Inertias, q: Array, f: Frames, k: int, moved: Array | None) -> Array:
    """Centre of mass of body k in the base, (3, N)."""
    com = inertias.com[k] if moved is None else inertias.com[k] + moved[k]
    x, y, z = (com @ chain.joint_basis[k]).T
    if chain.revolute[k]:
        c, s = np.cos(q[:, k]), np.sin(q[:, k])
        local = (c * x - s * y, s * x + c * y, z)
    else:
        local = (x, y, z + q[:, k])
    out: Array = f.p[k] + sum(f.axes[k, d] * local[d] for d in range(3))
    return out


def _wrench(chain: Chain, f: Frames, mass: Array, centres: Array, down: Array, held: HeldBehind | None) -> Array:
    out = np.empty((chain.n, 6, f.p.shape[2]))
    before = 0 if held is None else held.joints
    way = _way(chain, f, down, before)
    weight, moment_of_mass = 0.0, np.zeros_like(f.p[0])
    for k in range(chain.n - 1, before - 1, -1):
        weight += float(mass[k]) * STANDARD_GRAVITY
        moment_of_mass = moment_of_mass + float(mass[k]) * STANDARD_GRAVITY * centres[k]
        out[k] = _borne(f, k, weight, moment_of_mass, way)
    if held is not None:
        weight = held.mass * STANDARD_GRAVITY
        moment_of_mass = np.broadcast_to(weight * held.com[:, None], f.p[0].shape)
        for k in range(before):
            out[k] = -_borne(f, k, weight, moment_of_mass, way)
            weight += float(mass[k]) * STANDARD_GRAVITY
            moment_of_mass = moment_of_mass + float(mass[k]) * STANDARD_GRAVITY * centres[k]
    return out


def _way(chain: Chain, f: Frames, down: Array, before: int) -> Array:
    """Where weight pulls, in the base, (3, N). before: joints behind which the arm is held, where it does not turn."""
    if not before:
        return np.broadcast_to(down[:, None], f.p[0].shape)
    at_zero = frames(chain, np.zeros((1, chain.n)))
    return np.asarray(np.einsum("dcn,d->cn", f.axes[before], at_zero.axes[before, :, :, 0] @ down))


def _borne(f: Frames, k: int, weight: float, moment_of_mass: Array, way: Array) -> Array:
    """Wrench (6, N) at joint k of bodies of this weight, whose centre times it is given."""
    x, y, z = moment_of_mass - weight * f.p[k]
    # (c − p) × w down, summed over the bodies
    moment = np.stack([y * way[2] - z * way[1], z * way[0] - x * way[2], x * way[1] - y * way[0]])
    return np.concatenate(
        [weight * np.einsum("dcn,cn->dn", f.axes[k], way), np.einsum("dcn,cn->dn", f.axes[k], moment)]
    )
