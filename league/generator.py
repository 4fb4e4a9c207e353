"""Arms that exist nowhere: recordings whose truth is known, by error models that no method here fits.

Axes are lines that were machined askew (a product of exponentials); links bend about three axes under the weight of all
that they carry; encoders sit off centre on their shafts; gears add a rounded triangle; backlash is crossed by the load
as well as by the motion; steel grows while it warms. The tracker measures angles and a range. The file is frozen:
`seeds.json` holds its digest and the seed that was drawn after that.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from league.arm import Arm, Array, pose, quaternion, rotation

G = 9.81
PERIOD = 12.0  # s between stations


@dataclass
class World:
    """An arm as built, its tool, an instrument, and faults by name with the joints that have them."""

    arm: Arm
    rng: np.random.Generator
    faults: dict[str, tuple[int, ...]] = field(default_factory=dict)
    tool: Array = field(init=False)
    tracker: Array = field(init=False)

    def __post_init__(self) -> None:
        rng, n = self.rng, len(self.arm.names)
        T = self.arm.frames(np.zeros((1, n)))[0]
        self.axes = T[:-1, :3, 2] + 1.0e-3 * rng.normal(size=(n, 3))
        self.axes /= np.linalg.norm(self.axes, axis=1)[:, None]
        self.points = T[:-1, :3, 3] + 4e-4 * rng.standard_t(4, size=(n, 3))
        self.zeros = 1.5e-3 * rng.standard_t(4, size=n)
        self.home = T[-1] @ pose(rotation(1e-3 * rng.normal(size=3)), 5e-4 * rng.normal(size=3))
        masses = self.arm.masses[:, 0].copy()
        masses[masses < 0.1] = 2.0
        self.masses = masses
        self.stiff = np.stack([np.full(n, 6e4), np.full(n, 2.4e5), np.full(n, 2.4e5)], axis=1) * rng.uniform(
            0.7, 1.4, (n, 3)
        )
        self.off_centre = rng.uniform(2e-4, 4e-4, n), rng.uniform(0.0, 2.0 * np.pi, n)
        self.teeth = rng.integers(15, 110, n), rng.uniform(0.0, 2.0 * np.pi, n)
        self.gap = rng.uniform(3e-4, 6e-4, n)
        self.noise = 2e-5 * rng.uniform(0.5, 1.5)
        self.grows = rng.uniform(0.8e-4, 1.5e-4)
        self.place(moved=False)

    def place(self, moved: bool) -> None:
        """Set up instrument and target; moved: somewhere near the first time."""
        rng = self.rng
        if moved:
            self.tracker = self.tracker @ pose(rotation(0.2 * rng.normal(size=3)), 0.1 * rng.normal(size=3))
            self.tool = self.tool @ pose(rotation(0.1 * rng.normal(size=3)), 5e-3 * rng.normal(size=3))
            return
        self.tool = pose(rotation(0.4 * rng.normal(size=3)), 0.05 * rng.normal(size=3) + [0.0, 0.0, 0.1])
        self.tracker = pose(rotation(0.5 * rng.normal(size=3)), 0.5 * rng.normal(size=3) + [2.5, 0.0, 0.0])

    def postures(self, count: int, share: float = 0.7) -> Array:
        """Postures (count, n) in the middle of the ranges, the target above the floor."""
        low, high = np.maximum(self.arm.low, -np.pi), np.minimum(self.arm.high, np.pi)
        middle, half = 0.5 * (low + high), 0.5 * share * (high - low)
        q = self.rng.uniform(middle - half, middle + half, (8 * count, len(low)))
        return q[self.arm.frames(q)[:, -1, 2, 3] > 0.1][:count]

    def poses(self, q: Array, before: Array, t: Array) -> Array:
        """True poses (N, 4, 4) of the target in the instrument's frame, where each posture was reached from another."""
        n = q.shape[1]
        angle = q + self.zeros
        for k in self.faults.get("eccentric", ()):
            e, phase = self.off_centre[0][k], self.off_centre[1][k]
            angle[:, k] += np.arctan2(e * np.sin(q[:, k] + phase), 1.0 + e * np.cos(q[:, k] + phase)) * 2.0
        for k in self.faults.get("gear", ()):
            wave = np.sin(self.teeth[0][k] * q[:, k] + self.teeth[1][k])
            angle[:, k] += 2.5e-4 * np.arcsin(0.95 * wave)
        growth = np.ones(len(q))
        if "warm" in self.faults:
            growth = growth + self.grows * (1.0 - np.exp(-t / 2400.0))
        T, frames = self._chain(angle, np.zeros((len(q), n, 3)), growth)
        torque = self._torque(frames)
        for k in self.faults.get("backlash", ()):
            push = np.sign(q[:, k] - before[:, k]) * 6.0 + torque[:, k] @ self.axes[k]
            angle[:, k] += self.gap[k] * np.tanh(push / 3.0)
        bends = np.zeros((len(q), n, 3))
        for k in self.faults.get("elastic", ()):
            bends[:, k] = torque[:, k] / self.stiff[k]
        T, _ = self._chain(angle, bends, growth)
        return self.tracker @ T @ self.tool

    def _chain(self, angle: Array, bends: Array, growth: Array) -> tuple[Array, Array]:
        """Tips (N, 4, 4), and poses (N, n, 4, 4) that take a link's place at rest to where it is."""
        T, frames = np.broadcast_to(np.eye(4), (len(angle), 4, 4)), []
        for k in range(angle.shape[1]):
            R = rotation(angle[:, k, None] * self.axes[k]) @ rotation(bends[:, k])
            p = self.points[k] * growth[:, None]
            T = T @ pose(R, p - np.einsum("nij,nj->ni", R, p))
            frames.append(T)
        home = np.broadcast_to(self.home, T.shape).copy()
        home[:, :3, 3] *= growth[:, None]
        return T @ home, np.stack(frames, axis=1)

    def _torque(self, frames: Array) -> Array:
        """Torques (N, n, 3) [N m] of all weights beyond each joint, in the frame of its link at rest."""
        ends = np.concatenate([self.points[1:], self.home[None, :3, 3]])
        centre = np.einsum("nkij,kj->nki", frames[..., :3, :3], 0.5 * (self.points + ends)) + frames[..., :3, 3]
        at = np.einsum("nkij,kj->nki", frames[..., :3, :3], self.points) + frames[..., :3, 3]
        out = np.zeros_like(centre)
        for k in range(len(self.masses)):
            for m in range(k, len(self.masses)):
                load = np.cross(centre[:, m] - at[:, k], [0.0, 0.0, -G * self.masses[m]])
                out[:, k] += np.einsum("nji,nj->ni", frames[:, k, :3, :3], load)
        return out

    def read(self, T: Array) -> Array:
        """Readings (N, 7) of poses: a range and two angles of the position, a turn, and joints that do not repeat."""
        rng, p = self.rng, T[:, :3, 3]
        far = np.linalg.norm(p, axis=1, keepdims=True)
        along = p / far
        noise = rng.normal(size=p.shape)
        radial = np.sum(noise * along, axis=1, keepdims=True) * along
        p = p + 0.5 * self.noise * radial + self.noise * (0.6 + 0.25 * far) * (noise - radial)
        R = T[:, :3, :3] @ rotation(5e-5 * rng.normal(size=p.shape))
        return np.concatenate([p, quaternion(R)], axis=1)
