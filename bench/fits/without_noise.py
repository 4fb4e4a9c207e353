"""What is read of a cell, beside what would be read of it without noise and with joints that repeat exactly."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "verdict"))
from workcell import BEGIN, Bend, Session, Works

from modcal_core.measurements.samples import Samples

Array = np.ndarray


class WorksWithoutNoise(Works):
    """A cell that keeps, of each recording it makes, what no noise would have left of it."""

    def __init__(self, robot: str, rng: np.random.Generator) -> None:
        super().__init__(robot, rng)
        self.exact: list[Session] = []

    def observe(self, q: Array, again: Array | None = None, *bends: Bend, **options: Any) -> Session:
        """As of any cell; the same random numbers follow."""
        session = super().observe(q, again, *bends, **options)
        following = self.rng.bit_generator.state
        none = {"noise_mm": 0.0, "noise_mrad": 0.0, "repeat": 0.0}
        self.exact.append(super().observe(q, again, *bends, **{**options, **none}))
        self.rng.bit_generator.state = following
        return session


def exact_samples(samples: Samples, sessions: list[Session]) -> Samples:
    """These samples with the readings that the sessions without noise have at their stamps."""
    stamps = BEGIN + np.concatenate([session.t for session in sessions])
    order = np.argsort(stamps, kind="stable")
    rows = order[np.searchsorted(stamps[order], samples.stamps - 1e-6)]
    if np.abs(stamps[rows] - samples.stamps).max() > 1e-6:
        raise SystemExit("samples with and without noise are not the same stations")
    p = np.concatenate([session.p for session in sessions])
    R = np.concatenate([session.R.as_matrix() for session in sessions])
    return replace(samples, reading=p[rows], R=R[rows])
