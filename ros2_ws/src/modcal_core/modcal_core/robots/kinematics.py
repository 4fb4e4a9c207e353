"""Forward kinematics and Jacobians of a chain: of many postures at once, and of one where a clock runs.

``frames`` gives the frames just *before* each joint's motion (where a link error sits), the joint's axis as z, and the
tip. Jacobian columns follow from them: a twist e at a frame T moves the tip by ``Ad(T) e`` seen from the base. Only the
descents of many different arms (:mod:`modcal_core.modules.targets`) have kinematics of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import Array, crossed_rows, se3, so3, tool_from
from modcal_core.robots.chain import Chain


@dataclass(frozen=True)
class Loop:
    """How what happens at a place reaches the tool through a closed chain: by its shares along k directions, in the
    base. The first is that of the place's rod; a second counts where a platform is tilted, as its rods differ.

    along: the directions (k, 3, N). shift, turn: of the platform about its hub per unit of a share, (k, 3, N). rates:
    what the constants of the place make of the shares per unit, (k, constants, N). lever, hub: from the place to the
    end of its rod, and where the hub is, (3, N) [m]. rods: turn and shift of the platform per unit by which the place's
    rods differ, and of that times metres of the platform's radius and of the hub's three coordinates, (5, 2, 3, N).
    """

    along: Array
    shift: Array
    turn: Array
    rates: Array
    lever: Array
    hub: Array
    rods: Array

    def moved(self, shift: Array, turn: Array, tool: Array) -> tuple[Array, Array]:
        """(shift, turn) (3, N) of the tool, which is at (3, N) [m], for a twist of the place, its parts (3,) or (3, N)
        in the base [m, rad].
        """
        end = shift.reshape(3, -1) + so3.cross(turn.reshape(3, -1), self.lever)
        return self._by(np.einsum("kcn,cn->kn", self.along, end), tool)

    def moved_by_constant(self, constant: int, tool: Array) -> tuple[Array, Array]:
        """The same per unit of a constant of the place."""
        return self._by(self.rates[:, constant], tool)

    def moved_by_rods(self, direction: int, tool: Array) -> tuple[Array, Array]:
        """The same per unit of one of the five numbers of ``rods``."""
        turn, shift = self.rods[direction]
        return shift + so3.cross(turn, tool - self.hub), turn

    def _by(self, shares: Array, tool: Array) -> tuple[Array, Array]:
        shift, turn = (np.einsum("kcn,kn->cn", part, shares) for part in (self.shift, self.turn))
        return shift + so3.cross(turn, tool - self.hub), turn


@dataclass(frozen=True)
class Frames:
    """Frames along the chain for N poses: entry k is the frame M_k ends in, entry n the tip.

    Component-major, the batch axis last: ``axes[k, d]`` is the direction (3, N) of axis d of frame k in the base, joint
    axes being d = 2; ``p[k]`` its position (3, N) [m]. Each is one contiguous sweep, and a constant rotation is one
    matrix product for all poses.

    loops: by place, where what happens there reaches the tool through a closed chain.
    """

    axes: Array
    p: Array
    loops: Mapping[int, Loop] = field(default_factory=dict)

    def rotation(self, k: int) -> Array:
        """Orientations of frame k in the base, (N, 3, 3)."""
        return self.axes[k].transpose(2, 1, 0)

    def transform(self, k: int) -> Array:
        """Poses of frame k in the base, (N, 4, 4)."""
        return se3.transform(self.rotation(k), self.p[k].T)


def frames(chain: Chain, q: ArrayLike, twists: Mapping[int, Array] | None = None) -> Frames:
    """Frames before every joint, and the tip, for joint positions q (N, n) [rad, m]. twists: small motions (6, N) [m,
    rad] put in at places 0 … n, each in the frame of its place.
    """
    twists = twists or {}
    q = np.asarray(q, dtype=float)
    if len(q) == 1:
        return _frames_of_one(chain, q[0], twists)
    q = np.ascontiguousarray(q.T)
    n, N = q.shape
    M = chain.along_z
    c, s = np.cos(q), np.sin(q)
    axes = np.empty((n + 1, 3, 3, N))
    p = np.empty((n + 1, 3, N))
    axes[0] = M[0, :3, :3].T[:, :, None]
    p[0] = M[0, :3, 3, None]
    turned = np.empty((3, 3, N))
    for k in range(n):
        if k in twists:
            moved_frame(axes[k], p[k], twists[k])
        x, y, z = axes[k]
        at = p[k]
        if chain.revolute[k]:
            np.multiply(x, c[k], out=turned[0])
            turned[0] += s[k] * y
            np.multiply(y, c[k], out=turned[1])
            turned[1] -= s[k] * x
            turned[2] = z
        else:
            turned[...] = axes[k]
            at = at + q[k] * z
        flat = turned.reshape(3, 3 * N)
        np.matmul(M[k + 1, :3, :3].T, flat, out=axes[k + 1].reshape(3, 3 * N))
        np.add(at, (M[k + 1, :3, 3] @ flat).reshape(3, N), out=p[k + 1])
    if n in twists:
        moved_frame(axes[n], p[n], twists[n])
    return Frames(axes, p)


def moved_frame(axes: Array, p: Array, twist: Array) -> None:
    """Shift a frame by the first three rows of a twist (6, N) and turn it by the next three, seen from itself."""
    twist = twist[:6]
    if twist[:3].any():
        for axis, size in zip(axes, twist[:3], strict=True):
            p += axis * size
    if twist[5].any() and not twist[3:5].any():  # about the joint's axis, as most are
        c, s = np.cos(twist[5]), np.sin(twist[5])
        x, y = axes[0].copy(), axes[1].copy()
        axes[0] = c * x + s * y
        axes[1] = c * y - s * x
    elif twist[3:].any():
        x, y, z = axes.copy()
        for turned, (a, b, c) in zip(axes, so3.exp_rows(twist[3:]), strict=True):
            np.multiply(x, a, out=turned)
            turned += y * b
            turned += z * c


def chain_forward(chain: Chain, q: ArrayLike) -> Array:
    """Tip poses T_base_tip (..., 4, 4) for joint positions q (..., n) [rad, m]."""
    q = np.asarray(q, dtype=float)
    return frames(chain, q.reshape(-1, chain.n)).transform(-1).reshape(q.shape[:-1] + (4, 4))


def spatial_jacobian(chain: Chain, q: ArrayLike, f: Frames | None = None) -> Array:
    """Spatial Jacobians (N, 6, n): column i is the base-frame twist of joint i at unit speed. f: the frames there."""
    f = frames(chain, q) if f is None else f
    axis, at = f.axes[:-1, 2].transpose(1, 2, 0), f.p[:-1].transpose(1, 2, 0)  # (3, N, n)
    out = np.concatenate([so3.cross(at, axis), axis])
    if not chain.revolute.all():
        out = np.where(chain.revolute, out, np.concatenate([axis, np.zeros_like(axis)]))
    return out.transpose(1, 0, 2)


def body_jacobian(chain: Chain, q: ArrayLike) -> Array:
    """Body Jacobians (N, 6, n): the same twists seen from the tip, ``Ad(T_base_tip)⁻¹`` times the spatial ones."""
    v, w = tip_motions(chain, frames(chain, q))
    return np.swapaxes(np.concatenate([v, w], axis=2), 1, 2)


def tip_motions(chain: Chain, f: Frames) -> tuple[Array, Array]:
    """Velocities and turns (N, n, 3) of the tip per unit of each joint, seen from the tip: its body Jacobians."""
    R, p = f.rotation(-1), f.p[-1].T
    axis, at = f.axes[:-1, 2].transpose(2, 0, 1), f.p[:-1].transpose(2, 0, 1)  # (N, n, 3)
    turning = chain.revolute[:, None]
    v = np.where(turning, crossed_rows(axis, p[:, None] - at), axis) @ R
    return v, np.where(turning, axis, 0.0) @ R


def link_frames(chain: Chain, f: Frames) -> Array:
    """Frames of the joints after their motion, which links and their inertias are described in, (N, n, 4, 4)."""
    T_joint_next = chain.origins[1:] @ np.concatenate([se3.transform(chain.joint_basis[1:]), np.eye(4)[None]])
    R, p = f.axes[1:].transpose(3, 0, 2, 1), f.p[1:].transpose(2, 0, 1)
    return se3.transform(R, p) @ se3.inverse(T_joint_next)


def pose_and_jacobian(chain: Chain, q: Array) -> tuple[Array, Array]:
    """The tip in the base (4, 4) and its body Jacobian (6, n), for joints q (n,) [rad, m]."""
    f = frames(chain, q[None])
    return f.transform(-1)[0], np.concatenate(tip_motions(chain, f), axis=2)[0].T


def _frames_of_one(chain: Chain, q: Array, twists: Mapping[int, Array]) -> Frames:
    """Frames of one posture (n,), in a third of the time."""
    angle = q * chain.revolute
    motion = np.zeros((chain.n, 4, 4))
    motion[:, 0, 0] = motion[:, 1, 1] = np.cos(angle)
    motion[:, 1, 0] = np.sin(angle)
    motion[:, 0, 1] = -motion[:, 1, 0]
    motion[:, 2, 2] = motion[:, 3, 3] = 1.0
    motion[:, 2, 3] = q - angle
    links = motion @ chain.along_z[1:]
    out, T = np.empty((chain.n + 1, 4, 4)), chain.along_z[0]
    for k in range(chain.n + 1):
        out[k] = tool_from(T, twists[k][:6, 0]) if k in twists else T
        T = out[k] @ links[k] if k < chain.n else T
    return Frames(out[:, :3, :3].transpose(0, 2, 1).copy()[..., None], out[:, :3, 3, None].copy())
