"""Tool poses that an arm must reach, and which part of each counts.

A mask of six says what must be met, turns first as the source has it: about x, y, z, then along x, y, z, all seen from
the tool as it is wanted. 110111 leaves the tool's turn about its own z free.

The source measures a turn by e = ½ (n × n' + o × o' + a × a') between the axes of two frames: sin θ along the axis of
the turn. It is zero at half a turn too, and with a component masked it is zero at still other wrong poses, so it
says how far a pose is missed but does not lead there. What leads there are differences of unit vectors, here *rows*:
linear in the twelve numbers of the pose, zero where the mask is met and nowhere else:

    one axis c free     R e_c − R' e_c                    the axis itself must agree; 3 rows
    none free           R − R', all three axes            9 rows, by √½ to weigh as much
    two free            the one component of e that is left; 1 row
    position            the unmasked components of R'ᵀ (p − p')
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import Array, se3, so3
from modcal_core.modules.catalogue import Arms, ModuleBodies


@dataclass(frozen=True)
class Target:
    """A wanted pose of the tool. T: (4, 4) [m] in the base; mask: (6,) of bool, turns first; name: for people."""

    T: Array
    mask: np.ndarray
    name: str = ""

    @classmethod
    def build(cls, R: ArrayLike, p: ArrayLike, mask: ArrayLike = (1, 1, 1, 1, 1, 1), name: str = "") -> Target:
        """A target of a rotation (3, 3) that may be rounded: made orthonormal, a lone axis that counts first."""
        kept = np.array(mask, dtype=bool)
        T = np.eye(4)
        T[:3, :3] = _orthonormal(np.asarray(R, dtype=float), kept[:3])
        T[:3, 3] = np.asarray(p, dtype=float)
        for array in (T, kept):
            array.flags.writeable = False
        return cls(T, kept, name)

    @property
    def constraints(self) -> int:
        """Σm: of how many numbers the mask asks."""
        return int(self.mask.sum())

    @cached_property
    def rows(self) -> tuple[Array, Array]:
        """A (r, 12) and b (r,) of the rows ``A x − b``, x the 3 × 4 upper part of a pose, row by row."""
        R, p = self.T[:3, :3], self.T[:3, 3]
        out: list[Array] = []
        free = np.flatnonzero(~self.mask[:3])
        if len(free) == 0:
            out += [np.sqrt(0.5) * _entry(i, c) for c in range(3) for i in range(3)]
        elif len(free) == 1:
            out += [_entry(i, int(free[0])) for i in range(3)]
        elif len(free) == 2:
            a = int(np.flatnonzero(self.mask[:3])[0])
            j, k = (a + 1) % 3, (a + 2) % 3
            # of R'ᵀ R the entry (k, j), the sine of a turn about a, against (j, k)
            across = sum(0.5 * (R[d, k] * _entry(d, j) - R[d, j] * _entry(d, k)) for d in range(3))
            out.append(np.asarray(across))
        for i in np.flatnonzero(self.mask[3:]):
            out.append(np.asarray(sum(R[d, i] * _entry(d, 3) for d in range(3))))
        A = np.stack(out) if out else np.zeros((0, 12))
        wanted = np.concatenate([R, p[:, None]], axis=1).ravel()
        return A, A @ wanted

    def error(self, T: ArrayLike) -> Array:
        """The published measure e·m (..., 6) of poses (..., 4, 4): turn, then way [m], in the frame of the target."""
        T = np.asarray(T, dtype=float)
        R = self.T[:3, :3]
        turn = 0.5 * np.cross(T[..., :3, :3], R, axisa=-2, axisb=-2, axisc=-2).sum(axis=-1)
        e = np.concatenate([turn @ R, (self.T[:3, 3] - T[..., :3, 3]) @ R], axis=-1)
        return e * self.mask

    def miss(self, T: ArrayLike) -> tuple[Array, Array]:
        """How far poses (..., 4, 4) miss it: way [m] and angle [rad], (...) each, of what counts.

        The angle is that between the axes where one is free, else that of the turn where none is; with two free, the
        part of the turn about the one that counts.
        """
        T = np.asarray(T, dtype=float)
        e = self.error(T)
        way = np.linalg.norm(e[..., 3:], axis=-1)
        free = np.flatnonzero(~self.mask[:3])
        between = np.swapaxes(T[..., :3, :3], -1, -2) @ self.T[:3, :3]
        if len(free) == 1:
            z = between[..., free[0], :]
            across = np.linalg.norm(np.delete(z, free[0], axis=-1), axis=-1)
            return way, np.arctan2(across, z[..., free[0]])
        if len(free) == 3:
            return way, np.zeros_like(way)
        turn = so3.log(between)
        return way, np.linalg.norm(turn * self.mask[:3], axis=-1)


def _entry(i: int, j: int) -> Array:
    out = np.zeros((3, 4))
    out[i, j] = 1.0
    return out.ravel()


def _orthonormal(R: Array, counts: np.ndarray) -> Array:
    """The nearest rotation; where one axis is free of turning, the nearest that keeps this axis exactly."""
    free = np.flatnonzero(~counts)
    if len(free) != 1:
        return so3.nearest_rotation(R)
    c = int(free[0])
    j, k = (c + 1) % 3, (c + 2) % 3
    out = np.empty((3, 3))
    out[:, c] = R[:, c] / np.linalg.norm(R[:, c])
    x = R[:, j] - out[:, c] * (out[:, c] @ R[:, j])
    out[:, j] = x / np.linalg.norm(x)
    out[:, k] = np.cross(out[:, c], out[:, j])
    return out


# --- Where the parts of many arms are at given postures: what the requirements look at


@dataclass(frozen=True)
class TargetPostures:
    """N arms at S postures for each of K targets. q: (N, K, S, n) [rad, m]."""

    arms: Arms
    bodies: ModuleBodies
    targets: tuple[Target, ...]
    q: Array

    @cached_property
    def _frames(self) -> tuple[Array, Array, Array]:
        return frames(self.arms, self.q)

    @property
    def before(self) -> Array:
        """Frames before every joint's motion, its axis as z, in the base, (N, K, S, n, 4, 4) [m]."""
        return self._frames[0]

    @property
    def behind(self) -> Array:
        """Frames behind every joint's motion, (N, K, S, n, 4, 4) [m]."""
        return self._frames[1]

    @property
    def tip(self) -> Array:
        """The tool in the base, (N, K, S, 4, 4) [m]."""
        return self._frames[2]

    @cached_property
    def task_jacobian(self) -> Array:
        """What the joints do to the tool, turn and way in the target's frame, masked, (N, K, S, 6, n)."""
        z, p = self.before[..., :3, 2], self.before[..., :3, 3]
        turning = self.arms.revolute[:, None, None, :, None]
        w = np.where(turning, z, 0.0)
        v = np.where(turning, np.cross(z, self.tip[..., None, :3, 3] - p), z)
        R = np.stack([t.T[:3, :3] for t in self.targets])[:, None]
        mask = np.stack([t.mask for t in self.targets])[:, None, None]
        out: Array = np.swapaxes(np.concatenate([w @ R, v @ R], axis=-1) * mask, -1, -2)
        return out


def frames(arms: Arms, q: Array) -> tuple[Array, Array, Array]:
    """Frames before and behind the motion of every joint, (N, ..., n, 4, 4), and the tool (N, ..., 4, 4) [m].

    q: (N, ..., n) [rad, m].
    """
    between = (1,) * (q.ndim - 2)
    shape = q.shape[:-1]
    T = np.broadcast_to(arms.origins[:, 0].reshape(-1, *between, 4, 4), (*shape, 4, 4))
    before, behind = np.empty((*q.shape, 4, 4)), np.empty((*q.shape, 4, 4))
    for k in range(arms.n):
        turning = arms.revolute[:, k].reshape(-1, *between)
        xi = np.zeros((*shape, 6))
        xi[..., 5] = np.where(turning, q[..., k], 0.0)
        xi[..., 2] = np.where(turning, 0.0, q[..., k])
        before[..., k, :, :] = T
        T = T @ se3.exp(xi)
        behind[..., k, :, :] = T
        T = T @ arms.origins[:, k + 1].reshape(-1, *between, 4, 4)
    return before, behind, T
