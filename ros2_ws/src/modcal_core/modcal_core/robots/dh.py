"""Denavit–Hartenberg tables, classical and modified, in and out.

Classical (Denavit & Hartenberg 1955): ``T_{i-1,i} = Rz(θ_i) Tz(d_i) Tx(a_i) Rx(α_i)``; the joint turns about the z axis of
the frame before it. Modified (Craig 1986): ``T_{i-1,i} = Rx(α_{i-1}) Tx(a_{i-1}) Rz(θ_i) Tz(d_i)``; about that of its own.

Both put frames on the common normals of neighbouring axes. That is exact for any chain, but where two axes are nearly and
not quite parallel the normal lies far away and jumps with the smallest change: such a chain is refused by name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadTable, NotRepresentable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain

PARALLEL_RAD = 1e-9  # axes closer than this are parallel
FARTHEST_M = 20.0  # an offset beyond this only says that two axes are nearly parallel


@dataclass(frozen=True)
class DhTable:
    """rows: θ offset [rad], d [m], a [m], α [rad] of each joint, (n, 4). For a sliding joint, d is the offset.

    modified: Craig's convention; a and α of row i are then those before joint i. T_base: first frame in the base,
    T_tool: tip in the last frame, (4, 4).
    """

    names: tuple[str, ...]
    rows: Array
    revolute: np.ndarray
    T_base: Array
    T_tool: Array
    modified: bool = False


def from_dh(
    names: Sequence[str],
    rows: ArrayLike,
    revolute: ArrayLike | None = None,
    T_base: ArrayLike | None = None,
    T_tool: ArrayLike | None = None,
    modified: bool = False,
) -> Chain:
    """The chain of a table with rows (θ offset, d, a, α) [rad, m, m, rad]. Raises BadTable for a wrong shape."""
    table = np.asarray(rows, dtype=float)
    if table.shape != (len(names), 4) or not np.isfinite(table).all():
        raise BadTable("DH table", f"needs {len(names)} rows of 4 finite numbers", "give θ offset, d, a, α for each joint")
    theta, d, a, alpha = table.T
    turn = _screw_z(theta, d)
    link = _screw_x(alpha, a)
    origins = np.tile(np.eye(4), (len(names) + 1, 1, 1))
    if modified:
        origins[:-1] = link
        origins[1:] = turn @ origins[1:]
    else:
        origins[1:] = turn @ link
    origins[0] = (np.eye(4) if T_base is None else np.asarray(T_base, dtype=float)) @ origins[0]
    origins[-1] = origins[-1] @ (np.eye(4) if T_tool is None else np.asarray(T_tool, dtype=float))
    return Chain.build(names, origins, None, revolute)


def to_dh(chain: Chain, modified: bool = False) -> DhTable:
    """The table of a chain, with the same kinematics to rounding.

    Raises NotRepresentable, naming the joints and the angle between them, for axes that are nearly parallel.
    """
    T = chain.T_base_joint_home @ _aligned(chain)
    axes = [(T[k, :3, 3], T[k, :3, 2]) for k in range(chain.n)]
    feet = [_common_normal(axes[k], axes[k + 1], chain.names[k : k + 2]) for k in range(chain.n - 1)]
    frames = _modified_frames(T, axes, feet) if modified else _classical_frames(T, axes, feet)
    rows = np.zeros((chain.n, 4))
    for k in range(chain.n):
        step = se3.inverse(frames[k]) @ frames[k + 1]
        rows[k] = _read_modified(step) if modified else _read_classical(step)
    return DhTable(
        chain.names, rows, chain.revolute, frames[0], se3.inverse(frames[-1]) @ chain.home, modified
    )


def to_chain(table: DhTable) -> Chain:
    """The chain of a table."""
    return from_dh(table.names, table.rows, table.revolute, table.T_base, table.T_tool, table.modified)


def _screw_z(angle: Array, shift: Array) -> Array:
    zero = np.zeros_like(angle)
    return se3.transform(so3.exp(np.stack([zero, zero, angle], -1)), np.stack([zero, zero, shift], -1))


def _screw_x(angle: Array, shift: Array) -> Array:
    zero = np.zeros_like(angle)
    return se3.transform(so3.exp(np.stack([angle, zero, zero], -1)), np.stack([shift, zero, zero], -1))


def _aligned(chain: Chain) -> Array:
    """What turns each joint frame so that its axis is z; the tip stays."""
    return se3.transform(np.concatenate([chain.joint_basis, np.eye(3)[None]]))


_Line = tuple[Array, Array]


def _common_normal(first: _Line, second: _Line, names: Sequence[str]) -> tuple[Array, Array, Array] | None:
    """(foot on the first line, foot on the second, unit direction from first to second), None for parallel lines."""
    (p, u), (q, v) = first, second
    across = np.cross(u, v)
    sine = float(np.linalg.norm(across))
    if sine < PARALLEL_RAD:
        return None
    along = np.linalg.solve(np.stack([u, -v, across / sine], axis=1), q - p)
    if np.abs(along[:2]).max() > FARTHEST_M:
        raise NotRepresentable(
            f"joints {names[0]} and {names[1]}",
            f"axes are {np.degrees(np.arcsin(sine)):.4f}° from parallel: the DH offset is {np.abs(along[:2]).max():.0f} m, "
            f"{FARTHEST_M:g} m is the limit",
            "export CPC or URDF, which have no such jump",
        )
    x = across / sine * (1.0 if along[2] >= 0.0 else -1.0)
    return p + along[0] * u, q + along[1] * v, x


def _frame(origin: Array, x: Array, z: Array) -> Array:
    x = x - z * (x @ z)
    x = x / np.linalg.norm(x)
    return se3.transform(np.stack([x, np.cross(z, x), z], axis=1), origin)


def _across(first: _Line, second: _Line, spare: Array, through: Array) -> Array:
    """Direction of the normal of parallel lines, from first to second; any normal where they are one line."""
    gap = second[0] - through
    gap = gap - first[1] * (gap @ first[1])
    return gap if np.linalg.norm(gap) > 1e-9 else spare


def _classical_frames(T: Array, axes: list[_Line], feet: list[tuple[Array, Array, Array] | None]) -> list[Array]:
    """Frames 0 … n: frame k has the axis of joint k + 1 as z and the normal from the axis before as x."""
    frames = [T[0]]
    for k, normal in enumerate(feet):
        q, z = axes[k + 1]
        before = frames[-1]
        if normal is None:
            x = _across(axes[k], axes[k + 1], before[:3, 0], before[:3, 3])
            origin = q + z * (z @ (before[:3, 3] - q))
        else:
            _, origin, x = normal
        frames.append(_frame(origin, x, z))
    return [*frames, frames[-1]]


def _modified_frames(T: Array, axes: list[_Line], feet: list[tuple[Array, Array, Array] | None]) -> list[Array]:
    """Frames 0 … n: frame k has the axis of joint k as z and the normal to the next axis as x; frame 0 is frame 1."""
    frames: list[Array] = []
    for k, (p, z) in enumerate(axes):
        normal = feet[k] if k < len(feet) else None
        if normal is not None:
            frames.append(_frame(normal[0], normal[2], z))
            continue
        # the last joint, or one whose next axis is parallel: stand where the normal from the axis before arrives
        before = feet[k - 1] if k > 0 else None
        if before is not None:
            origin = before[1]
        else:
            through = frames[-1][:3, 3] if frames else p
            origin = p + z * (z @ (through - p))
        spare = frames[-1][:3, 0] if frames else T[0, :3, 0]
        if np.linalg.norm(np.cross(spare, z)) < 1e-9:
            spare = T[k, :3, 0]
        x = _across((p, z), axes[k + 1], spare, origin) if k < len(feet) else spare
        frames.append(_frame(origin, x, z))
    return [frames[0], *frames]


def _read_classical(step: Array) -> Array:
    """θ, d, a, α of ``Rz(θ) Tz(d) Tx(a) Rx(α)``."""
    R, p = step[:3, :3], step[:3, 3]
    theta = np.arctan2(R[1, 0], R[0, 0])
    alpha = np.arctan2(R[2, 1], R[2, 2])
    return np.array([theta, p[2], np.cos(theta) * p[0] + np.sin(theta) * p[1], alpha])


def _read_modified(step: Array) -> Array:
    """θ, d, a, α of ``Rx(α) Tx(a) Rz(θ) Tz(d)``."""
    R, p = step[:3, :3], step[:3, 3]
    theta = np.arctan2(-R[0, 1], R[0, 0])
    alpha = np.arctan2(-R[1, 2], R[2, 2])
    return np.array([theta, -np.sin(alpha) * p[1] + np.cos(alpha) * p[2], p[0], alpha])
