"""Readings that a controller filled in, among others that were measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.geometry import se3
from modcal_core.hypotheses.computed_part import computed_in_part
from modcal_core.robots.mechanism import forward

CHAIN = ur10()
BASE = se3.exp([1.0, 0.4, 0.2, 0.1, -0.3, 2.0])
CLEAN = record(11, 80).samples


@pytest.mark.parametrize("rows", [np.arange(20, 40), np.arange(0, 80, 4)])
def test_poses_that_the_controller_filled_in(rows: np.ndarray) -> None:
    """With any base and tool; a micrometre more than instruments resolve is a measurement again."""
    T = BASE @ forward(CHAIN, CLEAN.q[rows]) @ se3.exp([0.02, 0.05, 0.1, 0.4, 0.1, 0.0])
    reading, R = CLEAN.reading.copy(), CLEAN.R.copy()
    reading[rows], R[rows] = T[:, :3, 3], T[:, :3, :3]
    filled = replace(CLEAN, reading=reading, R=R)
    (said,) = computed_in_part(filled, CHAIN)
    assert "20 of 80 stations" in said
    assert "computed from the joints" in said
    reading[rows] += np.random.default_rng(2).normal(0.0, 2e-5, (20, 3))
    assert computed_in_part(replace(filled, reading=reading), CHAIN) == ()


def test_points_that_the_controller_filled_in_while_the_target_was_hidden() -> None:
    rows = np.arange(30, 62)
    reading = CLEAN.reading.copy()
    reading[rows] = se3.apply(BASE @ forward(CHAIN, CLEAN.q[rows]), np.ones(3) / 9)
    points = replace(CLEAN, reading=reading, kind=np.full(80, "point", CLEAN.kind.dtype))
    (said,) = computed_in_part(points, CHAIN)
    assert "stations 30 to 61" in said


def test_nothing_is_said_of_measured_readings() -> None:
    for samples in (CLEAN, CLEAN.select(np.zeros(80, int)), CLEAN.select(np.arange(15))):
        assert computed_in_part(samples, CHAIN) == ()
