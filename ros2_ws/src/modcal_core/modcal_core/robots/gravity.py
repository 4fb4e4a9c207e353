"""What gravity asks of every joint: force and moment of all that hangs beyond it."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import Frames, frames
from modcal_core.robots.urdf_inertias import Inertias

STANDARD_GRAVITY = 9.80665  # m/s², along −z of the base


def gravity_wrench(chain: Chain, inertias: Inertias, q: Array) -> Array:
    """Weight of the bodies beyond each joint, (n, 6, N): force [N], moment about the joint's origin [N m].

    Both in the frame just before the joint's motion, with its axis along z, so row 5 is the torque about a turning
    joint's axis and row 2 the force along a sliding one's. q: joint positions (N, n).
    """
    f = frames(chain, q)
    centres = np.stack([_centre(chain, inertias, q, f, k) for k in range(chain.n)])
    return _wrench(chain, f, inertias.mass, centres)


def payload_wrench(chain: Chain, q: Array) -> Array:
    """The same, (n, 6, N), of a mass of 1 kg at the tip."""
    f = frames(chain, q)
    mass = np.zeros(chain.n)
    mass[-1] = 1.0
    return _wrench(chain, f, mass, np.broadcast_to(f.p[-1], (chain.n, *f.p[-1].shape)))


def offset_wrench(chain: Chain, q: Array) -> Array:
    """How the latter changes with each metre that the mass is beside the tip, along the tip's x, y, z, (3, n, 6, N)."""
    f = frames(chain, q)
    mass = np.zeros(chain.n)
    mass[-1] = 1.0
    at = np.broadcast_to(f.p[-1], (chain.n, *f.p[-1].shape))
    own = _wrench(chain, f, mass, at)
    return np.stack([_wrench(chain, f, mass, at + f.axes[-1, d]) - own for d in range(3)])


def _centre(chain: Chain, inertias: Inertias, q: Array, f: Frames, k: int) -> Array:
    """Centre of mass of body k in the base, (3, N)."""
    x, y, z = chain.joint_basis[k].T @ inertias.com[k]
    if chain.revolute[k]:
        c, s = np.cos(q[:, k]), np.sin(q[:, k])
        local = (c * x - s * y, s * x + c * y, z)
    else:
        local = (x, y, z + q[:, k])
    out: Array = f.p[k] + sum(f.axes[k, d] * local[d] for d in range(3))
    return out


def _wrench(chain: Chain, f: Frames, mass: Array, centres: Array) -> Array:
    out = np.empty((chain.n, 6, f.p.shape[2]))
    weight, moment_of_mass = 0.0, np.zeros_like(f.p[0])
    for k in range(chain.n - 1, -1, -1):
        weight += float(mass[k]) * STANDARD_GRAVITY
        moment_of_mass = moment_of_mass + float(mass[k]) * STANDARD_GRAVITY * centres[k]
        # (c − p) × (0, 0, −w), summed over the bodies
        x, y = moment_of_mass[0] - weight * f.p[k, 0], moment_of_mass[1] - weight * f.p[k, 1]
        moment = np.stack([-y, x, np.zeros_like(x)])
        for d in range(3):
            out[k, d] = -weight * f.axes[k, d, 2]
            out[k, 3 + d] = np.einsum("cn,cn->n", f.axes[k, d], moment)
    return out
