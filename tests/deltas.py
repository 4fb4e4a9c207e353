"""Deltas whose truth is MuJoCo's closed chains: what the tests of the Delta measure against."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cells import samples_of

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.robots.delta import Delta
from modcal_core.robots.mechanism import random_postures
from modcal_nodes.io.inputs import read_delta
from modcal_nodes.simulation.delta_world import DeltaWorld, displaced

FILE = Path(__file__).resolve().parents[1] / "examples" / "robots" / "delta.yaml"
LINEAR = FILE.with_name("linear_delta.yaml")
NOISE_M = 3e-5


def nominal(shaft: bool = True, linear: bool = False) -> Delta:
    """The Delta of the examples, with arms or with towers, or the same without its shaft."""
    delta = read_delta(LINEAR if linear else FILE)
    if shaft:
        return delta
    offset, proximal, distal = delta.constants[3:]
    ends = (None, None) if not linear else (delta.lower[:3], delta.upper[:3])
    return Delta.build(
        delta.names[:3], offset, proximal, distal, lower=ends[0], upper=ends[1], tool=delta.tool, linear=linear
    )


@dataclass(frozen=True)
class RecordedDelta:
    """The drawing, the true robot in MuJoCo, and samples of it."""

    nominal: Delta
    true: Delta
    world: DeltaWorld
    samples: Samples


def record_delta(
    seed: int,
    count: int,
    kind: str = "point",
    shaft: bool = True,
    gear: tuple[int, float, float] | None = None,
    compliance: float = 0.0,
    noise_m: float = NOISE_M,
    unequal: float | tuple[float, float, float] = 0.0,
    linear: bool = False,
) -> RecordedDelta:
    """Readings of a displaced Delta at random postures. gear: joint, cycles a turn and amplitude of the unmodelled effect.

    unequal: by how much the two rods of each arm differ [m].
    """
    rng = np.random.default_rng(seed)
    drawn = nominal(shaft, linear)
    true = displaced(drawn, rng, 5e-4, 1e-3)
    world = DeltaWorld(true, se3.exp(rng.normal(size=6)), compliance=compliance, unequal=unequal)
    q = random_postures(drawn, count, rng)
    sent = q.copy()
    if gear is not None:
        joint, cycles, amplitude = gear
        sent[:, joint] += amplitude * np.sin(cycles * q[:, joint] + 0.4)
    T = world.tool_in_tracker(sent)
    T[:, :3, 3] += noise_m * rng.standard_normal((count, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(5e-5 * rng.standard_normal((count, 3)))
    return RecordedDelta(drawn, true, world, samples_of(drawn, q, T, kind))


def postures(delta: Delta, count: int, seed: int = 0) -> Array:
    """Postures (count, n) that the platform can take."""
    return random_postures(delta, count, np.random.default_rng(seed))
