"""Where the parts of many arms are at given postures: what the requirements look at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.modules.catalogue import Arms, ModuleBodies
from modcal_core.modules.targets import Target


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
