"""Sweeps along a serial chain for a block of postures: once from the tool back, once from the root out.

Frame k is that of place k, the joint's axis along z; between places k and k + 1 stand the joint's turn and a constant,
``T_k,k+1 = Rz(q_k) M_k`` (for a sliding joint a shift along z). Everything that a fit needs is said with two things:

* the tool in the frame of each place, found from the tool backwards: ``t_k = Rz(q_k) (R_k t_{k+1} + m_k)``;
* a vector of the root in the frame of each place, found outwards: ``r_{k+1} = R_kᵀ Rz(−q_k) r_k``.

A twist (v, ω) at place k moves the tool by ``R (v + ω × t_k)``, R being the orientation of place k in the root, so the
product of a residual r with it is ``v · r_k + ω · (t_k × r_k)``: the gradient of all places takes two sweeps and no
Jacobian.

Vectors are rows of four, a point's last number is 1 and a direction's 0. A constant is then one product of matrices,
and a turn about z one product of complex numbers, ``x + iy`` being the first half of a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.kernels.turns import Complex, from_left, quaternions
from modcal_core.geometry import Array


@dataclass(frozen=True)
class PostureBlock:
    """Joint positions of a block of B postures. q: (B, n) [rad, m]. turn: e^{iq}, (n, B). half: e^{iq/2}, (n, B), where
    orientations are asked for. revolute: (n,).
    """

    q: Array
    turn: Complex
    half: Complex
    revolute: tuple[bool, ...]

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.revolute)

    @property
    def count(self) -> int:
        """Number of postures."""
        return len(self.q)


class Constants:
    """What stands between the places of a chain, for sweeps over any postures. M: T_k,k+1 at q = 0, (n, 4, 4) [m]."""

    def __init__(self, M: Array, orientations: bool) -> None:
        """orientations: whether those of the tool are asked for."""
        self.M = M
        self.back = np.ascontiguousarray(M.transpose(0, 2, 1))  # of rows, from place k + 1 to k
        self.out = M * _MIRRORED  # of rows of mirrored directions, from place k to k + 1
        if orientations:
            turns = quaternions(M[:, :3, :3])
            self.turned, self.last = from_left(turns), turns[-1]


# Directions with y the other way round: a turn back is then the same product as a turn
_MIRROR = np.array([1.0, -1.0, 1.0, 0.0])
_MIRRORED = np.outer(_MIRROR, _MIRROR)


def tool_in_places(constants: Constants, at: PostureBlock) -> Array:
    """The tool in the frames of places 0 … n − 1, (n, B, 4) [m]."""
    out = np.empty((at.n, at.count, 4))
    xy = out.view(complex)[:, :, 0]
    out[-1] = constants.back[-1, 3]
    for k in range(at.n - 1, -1, -1):
        if k < at.n - 1:
            np.matmul(out[k + 1], constants.back[k], out=out[k])
        if at.revolute[k]:
            np.multiply(xy[k], at.turn[k], out=xy[k])
        else:
            out[k, :, 2] += at.q[:, k]
    return out


def orientation_of_tool(constants: Constants, at: PostureBlock) -> Complex:
    """Quaternions of the tool in the root, (B, 2)."""
    here, other = np.empty((2, at.count, 2), dtype=complex)
    here[:] = constants.last
    for k in range(at.n - 1, -1, -1):
        if k < at.n - 1:
            np.matmul(here.view(float), constants.turned[k], out=other.view(float))
            here, other = other, here
        if at.revolute[k]:
            for part in here.T:
                np.multiply(part, at.half[k], out=part)
    return here


def wrench_on_tool(force: Array, torque: Array | None = None) -> Array:
    """Forces and, where there are any, torques on the tool, (3, B) each, as mirrored rows (1 or 2, B, 4)."""
    given = [force] if torque is None else [force, torque]
    out = np.zeros((len(given), force.shape[1], 4))
    for rows, seen in zip(out, given, strict=True):
        rows[:, 0], rows[:, 2] = seen[0], seen[2]
        np.negative(seen[1], out=rows[:, 1])
    return out


def sums(t: Array, wrench: Array) -> Array:
    """Sums over the postures of all products of the tool's numbers (B, 4) with those of a wrench, (1 or 2, 4, 4)."""
    return np.matmul(t.T, wrench)


def sums_in_places(constants: Constants, at: PostureBlock, t: Array, wrench: Array) -> Array:
    """The same for the wrench as seen from places 0 … n, (n + 1, 1 or 2, 4, 4).

    t: the tool in the places, (n, B, 4). wrench: seen from the root; it is written over.
    """
    out = np.zeros((at.n + 1, len(wrench), 4, 4))
    other = np.empty_like(wrench)
    for k in range(at.n):
        np.matmul(t[k].T, wrench, out=out[k])
        if at.revolute[k]:
            xy = wrench.view(complex)[:, :, 0]
            np.multiply(xy, at.turn[k], out=xy)
        np.matmul(wrench.reshape(-1, 4), constants.out[k], out=other.reshape(-1, 4))
        wrench, other = other, wrench
    out[at.n, :, 3] = wrench.sum(axis=1)  # there the tool is the origin
    return out


def moments(sums: Array) -> Array:
    """What forces and torques on the tool do along the six directions of a place, ``Σ (r, t × r + τ)``, (..., 6), from
    the sums of products (..., 1 or 2, 4, 4).
    """
    S = sums[..., :3] * _MIRROR[:3]
    out = np.empty((*S.shape[:-3], 6))
    out[..., :3] = S[..., 0, 3, :]  # a point's last number is 1
    y, z = [1, 2, 0], [2, 0, 1]
    out[..., 3:] = S[..., 0, y, z] - S[..., 0, z, y]
    if S.shape[-3] > 1:
        out[..., 3:] += S[..., 1, 3, :]
    return out
