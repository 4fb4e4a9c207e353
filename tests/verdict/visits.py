"""Recordings with postures that are come back to; MuJoCo says where the tool is, what does not repeat is planted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cells import Recorded, noisy, record, samples_of, ur10

from modcal_core.calibration.cell import Cell
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.verdict import Verdict

NOISE_M, NOISE_RAD = 2e-5, 3e-5  # per axis


def tour(seed: int, stations: int, returns: int, kind: str = "pose") -> tuple[Recorded, np.ndarray, list[int]]:
    """A displaced arm, postures (stations + returns, 6) to visit, and the rows that come back to an earlier one."""
    made = record(seed, stations, kind)
    q = list(made.samples.q)
    back = []
    for k in range(returns):
        # from a station elsewhere, and so from another side in some joint
        at = stations // 2 + 2 * k
        q.insert(at, made.samples.q[k + 1])  # nobody knows how the first one was reached
        back.append(at)
    return made, np.array(q), back


def visited(
    seed: int,
    stations: int = 100,
    returns: int = 8,
    kind: str = "pose",
    joint_rad: float = 0.0,
    noise_m: float = NOISE_M,
    noise_rad: float = NOISE_RAD,
) -> Samples:
    """Samples of a tour. joint_rad: what each joint misses its position by, another time another way."""
    made, q, _ = tour(seed, stations, returns, kind)
    rng = np.random.default_rng(seed + 500)
    T = made.world.tool_in_tracker(q + joint_rad * rng.standard_normal(q.shape))
    T = noisy(T, noise_m, noise_rad, rng)
    return samples_of(ur10(), q, T, kind)


def moved_by(samples: Samples, shift: np.ndarray) -> Samples:
    """The same with readings shifted (N, 3) [m]."""
    return replace(samples, reading=samples.reading + shift)


def judged(samples: Samples, cell: Cell | None = None) -> Verdict:
    """What is said of a calibration of geometry alone."""
    result = calibrate(samples, ur10(), np.random.default_rng(0), cell or Cell(), look_for_effects=False)
    assert result.report.judged is not None
    return result.report.judged


def said(samples: Samples, cell: Cell | None = None) -> str:
    """Why it is open."""
    return " ".join(judged(samples, cell).open_because)
