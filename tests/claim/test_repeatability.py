"""Joints that do not repeat, against those that were drawn."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.claim.repeatability import missed_by_joints
from modcal_core.geometry.so3 import Array

NOISE, USUAL = 3e-5, 1.5e-5


def stations(rng: np.random.Generator, missed: Array) -> tuple[Array, Array]:
    """Motions (N, J, 3) and what is left (N, 3) of an instrument of NOISE, in NOISE."""
    motions = rng.normal(0.0, 0.5, (*missed.shape, 3)) / NOISE
    return motions, (missed[:, None] @ motions)[:, 0] + rng.normal(size=(len(missed), 3))


def missed_by(motions: Array, left: Array, rng: np.random.Generator) -> Array:
    """Draws (R, N, J) where the scatter is as large as it is."""
    return np.sqrt(np.mean(left**2)) * missed_by_joints(motions, left, left.size, 1.0, rng)


@pytest.mark.parametrize("worn", [0, 4])
def test_the_one_joint_that_scatters_is_found_with_its_tails(rng: np.random.Generator, worn: int) -> None:
    missed = np.zeros((160, 6))
    missed[:, worn] = 4e-4 * (rng.random(160) < 0.1) * rng.choice([-1.0, 1.0], 160)
    motions, left = stations(rng, missed)
    drawn = missed_by(motions, left, rng)
    size = np.sqrt((drawn**2).mean(axis=(0, 1)))
    assert size[worn] == pytest.approx(np.sqrt((missed[:, worn] ** 2).mean()), rel=0.15)
    assert np.delete(size, worn).max() < USUAL
    assert np.mean(np.abs(drawn[..., worn]) > 3e-4) == pytest.approx(np.mean(missed[:, worn] != 0.0), abs=0.03)


def test_an_instrument_that_scatters_is_no_joint_and_joints_that_all_do_are_found(rng: np.random.Generator) -> None:
    for size in (0.0, 6e-5):
        motions, left = stations(rng, rng.normal(0.0, size, (160, 6)))
        drawn = missed_by(motions, left, rng)
        found = np.sqrt((drawn**2).mean())
        assert found == pytest.approx(size, rel=0.1) if size else found < USUAL


def test_where_no_reading_moves_with_a_joint_it_repeats_as_usual(rng: np.random.Generator) -> None:
    motions, left = stations(rng, np.zeros((20, 6)))
    motions[:, 2] = 0.0
    drawn = missed_by(motions, left, rng)
    assert 0.2 * USUAL < np.median(np.abs(drawn[..., 2])) < 5.0 * USUAL
