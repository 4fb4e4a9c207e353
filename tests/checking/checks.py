"""Checks of an arm in a world of MuJoCo, as several tests ask for them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from cells import NOISE_M, NOISE_RAD, Recorded, ur10

from modcal_core.calibration.store import Calibration
from modcal_core.checkup import Checked
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.public import check

FLOOR = np.sqrt(3.0) * NOISE_M


Poses = Callable[[Array], Array]


def readings(q: Array, T: Array, rng: np.random.Generator, noise: float = 1.0) -> Samples:
    """Poses (N, 4, 4) with the instrument's noise."""
    T = T.copy()
    T[:, :3, 3] += noise * NOISE_M * rng.standard_normal((len(q), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(noise * NOISE_RAD * rng.standard_normal((len(q), 3)))
    return Samples.from_arrays(q, poses=T, names=ur10().names, stamps=1e6 + 5.0 * np.arange(len(q)))


def checked(
    cell: tuple[Recorded, Calibration],
    seen: Callable[[Array, Poses], Array],
    seed: int = 0,
    count: int = 10,
    noise: float = 1.0,
) -> tuple[Checked, Array, Array]:
    """A check by stations at random postures, these, and where the tool truly was."""
    rng = np.random.default_rng([seed, 11])
    q = rng.uniform(-2.5, 2.5, (count, 6))
    T = seen(q, cell[0].world.tool_in_tracker)
    return check(cell[1], readings(q, T, rng, noise)), q, T


def twist(size: float, way: tuple[float, ...]) -> Array:
    """A small motion (4, 4)."""
    return se3.exp(size * np.array(way))


def names(found: Checked) -> set[tuple[str, str]]:
    """What was named."""
    return {(c.kind, c.place) for c in found.changes}


def rms(a: Array, b: Array) -> float:
    """Of distances between poses [m]."""
    return float(np.sqrt(np.mean(np.sum((a[:, :3, 3] - b[:, :3, 3]) ** 2, axis=1))))
