"""Sweeps along a serial chain for a block of postures: once from the tool back, once from the root out.

Frame k is that of place k, the joint's axis along z; between places k and k + 1 stand the joint's turn and a constant,
``T_k,k+1 = Rz(q_k) M_k`` (for a sliding joint a shift along z). Everything that a fit needs is said with two things:

* the tool in the frame of each place, found from the tool backwards: ``t_k = Rz(q_k) (R_k t_{k+1} + m_k)``;
* a vector of the root in the frame of each place, found outwards: ``r_{k+1} = R_kᵀ Rz(−q_k) r_k``.

A twist (v, ω) at place k moves the tool by ``R (v + ω × t_k)``, R being the orientation of place k in the root, so the
product of a residual r with it is ``v · r_k + ω · (t_k × r_k)``: the gradient of all places takes two sweeps and no
Jacobian. Arrays are component-major with the postures last; each turn about z is a few contiguous passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class Postures:
    """Joint positions of a block of B postures. c, s: cosines and sines, (n, B). q: (n, B) [rad, m]. revolute: (n,)."""

    c: Array
    s: Array
    q: Array
    revolute: np.ndarray

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.revolute)

    @property
    def count(self) -> int:
        """Number of postures."""
        return self.q.shape[1]


def tool_in_places(M: Array, at: Postures, directions: bool = False) -> Array:
    """The tool in the frames of places 0 … n − 1, (n, 3, V, B) [m], for constants M (n, 4, 4).

    directions: beside its origin (V = 1) also its x and y axes (V = 3).
    """
    V = 3 if directions else 1
    out = np.empty((at.n, 3, V, at.count))
    last = np.zeros((3, V, 1))
    last[:, 0, 0] = M[-1, :3, 3]
    if directions:
        last[:, 1:, 0] = M[-1, :3, :2]
    for k in range(at.n - 1, -1, -1):
        if k == at.n - 1:
            u = np.broadcast_to(last, (3, V, at.count))
        else:
            u = (M[k, :3, :3] @ out[k + 1].reshape(3, -1)).reshape(3, V, -1)
            u[:, 0] += M[k, :3, 3:]
        here = out[k]
        if at.revolute[k]:
            c, s = at.c[k], at.s[k]
            np.multiply(u[:2], c, out=here[:2])
            here[0] -= s * u[1]
            here[1] += s * u[0]
            here[2] = u[2]
        else:
            here[...] = u
            here[2, 0] += at.q[k]
    return out


def moments(M: Array, at: Postures, t: Array, force: Array, torque: Array | None = None) -> Array:
    """Sums over the postures of what a force (3, B) on the tool and a torque (3, B) do along the six directions of
    places 0 … n, (n + 1, 6): ``Σ (r_k, t_k × r_k + τ_k)``.

    t: the tool in the places, (n, 3, B) or its first part.
    """
    out = np.zeros((at.n + 1, 6))
    V = 1 if torque is None else 2
    r = np.empty((3, V, at.count))
    r[:, 0] = force
    if torque is not None:
        r[:, 1] = torque
    turned = np.empty_like(r)
    for k in range(at.n + 1):
        if k:
            flat = M[k - 1, :3, :3].T @ turned.reshape(3, -1)
            r = flat.reshape(3, V, -1)
        sums = r.sum(axis=2)
        out[k, :3] = sums[:, 0]
        if torque is not None:
            out[k, 3:] = sums[:, 1]
        if k == at.n:
            break
        S = t[k] @ r[:, 0].T
        out[k, 3] += S[1, 2] - S[2, 1]
        out[k, 4] += S[2, 0] - S[0, 2]
        out[k, 5] += S[0, 1] - S[1, 0]
        if at.revolute[k]:
            c, s = at.c[k], at.s[k]
            np.multiply(r[:2], c, out=turned[:2])
            turned[0] += s * r[1]
            turned[1] -= s * r[0]
            turned[2] = r[2]
        else:
            turned[...] = r
    return out


def outward(axes: Array, k: int, M: Array, at: Postures, out: Array) -> None:
    """Write the axes of place k + 1 in the root, (3, 3, B) with the axis first, given those of place k."""
    if at.revolute[k]:
        c, s = at.c[k], at.s[k]
        turned = np.empty_like(axes)
        np.multiply(axes[:2], c, out=turned[:2])
        turned[0] += s * axes[1]
        turned[1] -= s * axes[0]
        turned[2] = axes[2]
        axes = turned
    np.matmul(M[k, :3, :3].T, axes.reshape(3, -1), out=out.reshape(3, -1))


def unit_turns(axes: Array, t: Array, out: Array) -> None:
    """Write what turns about the three axes of a place do to the tool, (3, 3, B): ``R (e_d × t)``, t being (3, B)."""
    x, y, z = axes
    np.multiply(y, t[2], out=out[0])
    np.subtract(t[1] * z, out[0], out=out[0])
    np.multiply(z, t[0], out=out[1])
    np.subtract(t[2] * x, out[1], out=out[1])
    np.multiply(x, t[1], out=out[2])
    np.subtract(t[0] * y, out[2], out=out[2])
