"""Recordings whose truth is MuJoCo's: what the tests of identification measure against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.recording import JointTrack
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import Mechanism
from modcal_nodes.simulation.mjcf import World

NOISE_M = 5e-5
NOISE_RAD = 5e-5


def ur10() -> Chain:
    """The UR10 by its published DH table, written out joint by joint."""
    d = (0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922)
    a = (0.0, -0.612, -0.5723, 0.0, 0.0, 0.0)
    alpha = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
    names = (
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    )
    origins = [np.eye(4)]
    origins += [se3.transform(so3.exp([al, 0.0, 0.0]), [x, 0.0, z]) for x, z, al in zip(a, d, alpha, strict=True)]
    return Chain.build(names, origins, lower=[-2 * np.pi] * 6, upper=[2 * np.pi] * 6, base="base_link", tip="tool0")


def slider_arm() -> Chain:
    """Five joints, two of them sliding, axes along x, y, z and one askew."""
    rng = np.random.default_rng(5)
    origins = se3.exp(np.c_[rng.uniform(-0.4, 0.4, (6, 3)), rng.uniform(-1.5, 1.5, (6, 3))])
    axes = [[0, 0, 1], [0, 1, 0], [-1, 0, 0], [0, 0, -1], [1, 2, -1]]
    names = [f"j{k}" for k in range(5)]
    return Chain.build(
        names, origins, axes, [True, False, True, True, False], [-2, -0.4, -2, -2, -0.3], [2, 0.4, 2, 2, 0.3]
    )


@dataclass(frozen=True)
class Recorded:
    """Samples, the world they came from, and the exact readings of the same postures."""

    world: World
    samples: Samples
    exact: Samples

    def reread(self, T: Array, kind: str = "pose") -> Samples:
        """Poses T (N, 4, 4) that are read at the same postures, with the same noise of positions."""
        seen = samples_of(self.world.nominal, self.samples.q, T, kind)
        return replace(seen, reading=seen.reading + self.samples.reading - self.exact.reading)


def record(
    seed: int,
    count: int,
    kind: str = "pose",
    chain: Chain | None = None,
    noise_m: float = NOISE_M,
    noise_rad: float = NOISE_RAD,
    length_std: float = 5e-4,
    angle_std: float = 1e-3,
) -> Recorded:
    """Readings of a displaced arm at random postures, with white noise."""
    rng = np.random.default_rng(seed)
    chain = ur10() if chain is None else chain
    T_tracker_base = se3.exp(rng.normal(size=6))
    T_tip_tool = se3.exp(np.r_[0.05, 0.03, 0.12, rng.normal(size=3)])
    world = World(chain, rng, length_std, angle_std, T_tracker_base, T_tip_tool)
    q = rng.uniform(np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi), (count, chain.n))
    T = world.tool_in_tracker(q)
    exact = samples_of(chain, q, T, kind)
    return Recorded(world, samples_of(chain, q, noisy(T, noise_m, noise_rad, rng), kind), exact)


def noisy(T: Array, metres: float, radians: float, rng: np.random.Generator) -> Array:
    """Poses (N, 4, 4) with white noise of these deviations along and about every axis."""
    out = T.copy()
    out[:, :3, 3] += metres * rng.standard_normal((len(T), 3))
    out[:, :3, :3] = out[:, :3, :3] @ so3.exp(radians * rng.standard_normal((len(T), 3)))
    return out


def joint_track(names: Sequence[str], stamps: Array, q: Array) -> JointTrack:
    """Joint states that report positions alone, received when they are stamped."""
    unknown = np.full_like(q, np.nan)
    return JointTrack(tuple(names), stamps, q, unknown, unknown, stamps)


def samples_of(chain: Mechanism, q: Array, T: Array, kind: str = "pose", frame: str = "tracker") -> Samples:
    """Samples of one frame for joint positions q (N, n) and readings T (N, 4, 4), one station each."""
    N = len(q)
    return Samples(
        names=chain.names,
        frames=(frame,),
        q=q,
        stamps=1.7e9 + 2.0 * np.arange(N),
        kind=np.array([kind] * N, dtype=KIND_NAMES),
        reading=T[:, :3, 3],
        R=T[:, :3, :3] if kind == "pose" else np.tile(np.eye(3), (N, 1, 1)),
    )
