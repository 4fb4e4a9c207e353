"""Checks of an arm in a world of MuJoCo, as several tests ask for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from cells import NOISE_M, NOISE_RAD, Recorded, ur10

from modcal_core.calibration.store import Calibration
from modcal_core.checkup import Checked
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.samples import Samples
from modcal_core.public import check

FLOOR = np.sqrt(3.0) * NOISE_M
FRESH = np.random.default_rng(79).uniform(-2.5, 2.5, (100, 6))  # postures that no check has seen

Cell = tuple[Recorded, Calibration]
Poses = Callable[[Array], Array]
Seen = Callable[[Array, Poses], Array]  # poses that are read at joint positions, by those of an arm that did not change


def readings(
    q: Array, T: Array, rng: np.random.Generator, noise: float = 1.0, kind: str = "pose", frame: str = "tracker"
) -> Samples:
    """Poses (N, 4, 4) with the instrument's noise, or their points."""
    T = T.copy()
    T[:, :3, 3] += noise * NOISE_M * rng.standard_normal((len(q), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(noise * NOISE_RAD * rng.standard_normal((len(q), 3)))
    made = Samples.from_arrays(q, poses=T, names=ur10().names, stamps=1e6 + 5.0 * np.arange(len(q)), frame=frame)
    return replace(made, kind=np.full(len(q), kind, dtype=KIND_NAMES))


def postures(seed: int, count: int = 10) -> Array:
    """Those of :func:`checked`."""
    return np.random.default_rng([seed, 11]).uniform(-2.5, 2.5, (count, 6))


def checked(cell: Cell, seen: Seen, seed: int = 0, count: int = 10, kind: str = "pose", **of: float | str) -> Checked:
    """A check by stations at random postures. of: noise and frame of the readings."""
    rng = np.random.default_rng([seed, 11])
    q = rng.uniform(-2.5, 2.5, (count, 6))
    T = seen(q, cell[0].world.tool_in_tracker)
    return check(cell[1], readings(q, T, rng, kind=kind, **of))  # type: ignore[arg-type]


def missed(cell: Cell, calibration: Calibration | None, seen: Seen, frame: str = "tracker") -> float:
    """RMS distance [m] at fresh postures of a calibration's predictions from where the tool is."""
    return rms(calibration.predict(FRESH, frame), seen(FRESH, cell[0].world.tool_in_tracker))


def twist(size: float, way: tuple[float, ...]) -> Array:
    """A small motion (4, 4)."""
    return se3.exp(size * np.array(way))


def about(joint: int, size: float) -> Array:
    """Joint positions with one of them off."""
    return size * np.eye(6)[joint]


def names(found: Checked) -> set[tuple[str, str]]:
    """What was named."""
    return {(c.kind, c.place) for c in found.changes}


def rms(a: Array, b: Array) -> float:
    """Of distances between poses [m]."""
    return float(np.sqrt(np.mean(np.sum((a[:, :3, 3] - b[:, :3, 3]) ** 2, axis=1))))
