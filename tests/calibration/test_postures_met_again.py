"""Postures that are read again and again: what has met a posture is not scored on it, and it is counted once."""

from __future__ import annotations

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import uncertainty
from modcal_core.calibration.data_split import distinct, independent_unit, split, units_of_stations
from modcal_core.calibration.fit import identify, require_enough
from modcal_core.calibration.noise import errors
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.contents import independent_units
from modcal_nodes.simulation.world import World

rng_of = np.random.default_rng


def taken(rows: np.ndarray, count: int = 40) -> Samples:
    """Readings at these postures of ``count`` random ones, one after the other, each with a reading of its own."""
    made = record(3, count).world
    q = rng_of(5).uniform(-2.5, 2.5, (count, 6))[rows]
    q += rng_of(6).normal(0, 2e-5, q.shape)  # controllers come back to about that
    return samples_of(ur10(), q, made.tool_in_tracker(q))


@pytest.mark.parametrize("order", ["read four times each", "visited in four rounds"])
def test_all_readings_of_a_posture_are_in_one_set(order: str) -> None:
    rows = np.repeat(np.arange(40), 4) if order.startswith("read") else np.tile(np.arange(40), 4)
    samples = taken(rows)
    sets = split(samples, rng_of(0))
    held = [set(rows[part].tolist()) for part in (sets.train, sets.explain, sets.held_out)]
    assert sum(map(len, held)) == len(set().union(*held)) == 40
    assert [len(part) for part in held] == pytest.approx([20, 8, 12], abs=1)
    # nor are two readings of one posture two independent witnesses
    units = independent_units(samples, sets.held_out, blocks=False)
    assert len(np.unique(units)) == len(held[2])


def test_across_a_change_a_posture_stays_in_its_set() -> None:
    rows = np.tile(np.arange(40), 2)
    samples = taken(rows)
    sets = split(samples, rng_of(0), None, [float(samples.stamps[40]) - 1.0])
    for part in (sets.train, sets.explain, sets.held_out):
        assert sorted(rows[part[part < 40]]) == sorted(rows[part[part >= 40]])


def test_a_few_returns_change_nothing() -> None:
    rows = np.r_[np.arange(94), np.arange(0, 60, 10)]
    samples = taken(rows, 94)
    assert len(np.unique(distinct(samples.q))) == 100
    assert (units_of_stations(samples)[1] == np.arange(100)).all()


def test_equations_are_those_of_different_postures() -> None:
    require_enough(taken(np.arange(40)), 42, share=0.5)
    with pytest.raises(NotEnoughData, match="48 stations in 8 postures .* give 24 equations.* 17 different postures"):
        require_enough(taken(np.repeat(np.arange(8), 6)), 42, share=0.5)


def test_the_score_is_what_new_postures_meet() -> None:
    """Points, each read five times, gave a model that had them by heart: 0.09 mm held out, and 1.6 mm off elsewhere.

    Of two arms together: a dozen postures that are held out tell it to about a tenth.
    """
    held_out, new = np.array([scored_and_true(2), scored_and_true(3)]).sum(axis=0)
    assert held_out > 0.85 * new


def scored_and_true(seed: int) -> tuple[float, float]:
    """The mean error on held-out readings of an arm whose gears err in a way that is not looked for, and elsewhere."""
    rng = rng_of(seed)
    world = World(ur10(), rng, 5e-4, 1e-3)

    def seen(q: np.ndarray) -> Samples:
        T = world.tool_in_tracker(q + 8e-4 * np.sin(q * [43.0, 57.0, 71.0, 0.0, 0.0, 0.0]))
        T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
        return samples_of(ur10(), q, T, "point")

    samples = seen(np.repeat(rng.uniform(-2.5, 2.5, (27, 6)), 5, axis=0))
    made = calibrate(samples, ur10(), rng_of(0), look_for_effects=False)
    held_out = errors(made.scored.model, samples.select(made.report.sets.held_out)).position_norm.mean()
    new = errors(made.scored.model, seen(rng.uniform(-2.5, 2.5, (400, 6)))).position_norm.mean()
    return float(held_out), float(new)


def test_readings_of_one_stop_share_their_noise_and_those_of_a_later_one_do_not() -> None:
    rows = np.r_[np.repeat(np.arange(40), 4), 7, 7, 3]
    expected = np.cumsum(np.r_[0, np.diff(rows) != 0])
    assert (independent_unit(taken(rows)) == expected).all()
    assert (independent_unit(taken(np.tile(np.arange(40), 3))) == np.arange(120)).all()


@pytest.mark.parametrize("seed", range(6))
def test_a_sound_arm_that_is_read_five_times_at_each_stop_has_no_effects(seed: int) -> None:
    """What the arm does not repeat is the same in all five, and had been taken for gears, steps and drifts."""
    once = record(seed, 50, noise_m=4e-5, noise_rad=4e-5).samples
    rows = np.repeat(np.arange(50), 5)
    T = se3.transform(once.R[rows], once.reading[rows] + rng_of(seed).normal(0, 5e-6, (len(rows), 3)))
    made = calibrate(samples_of(ur10(), once.q[rows], T), ur10(), rng_of(0))
    assert made.report.effects == ()
    assert made.report.grounds.regimes == ()


def five_times(seed: int, apart: float) -> Samples:
    """Fifty stops, each read five times: by an arm that stops a little beside, and an instrument that scatters."""
    once = record(seed, 50, noise_m=4e-5, noise_rad=4e-5).samples
    rows = np.repeat(np.arange(50), 5)
    turned = so3.exp(rng_of(seed).normal(0, apart, (len(rows), 3)))
    moved = once.reading[rows] + rng_of(seed + 100).normal(0, apart, (len(rows), 3))
    return samples_of(ur10(), once.q[rows], se3.transform(once.R[rows] @ turned, moved))


@pytest.mark.parametrize(("apart", "worth"), [(5e-6, 1.0), (4e-4, 5.0)])
def test_parameters_are_known_as_well_as_the_stops_tell(apart: float, worth: float) -> None:
    """Where the arm's own scatter rules, five readings are worth one; where the instrument's does, five."""
    ratios = []
    for seed in range(8):
        many = five_times(seed, apart)
        start = fit_cell(ur10(), many, Cell()).model
        parameters = choose_parameters(start, views_of(many)).parameters
        all_of_them = identify(start, many, parameters)
        once = identify(start, many.select(slice(None, None, 5)), parameters)
        known = uncertainty(all_of_them.model, many, parameters, all_of_them)
        np.testing.assert_allclose(known.std, all_of_them.std, rtol=0.02)
        ratios.append(np.median(once.covariance.diagonal() / all_of_them.covariance.diagonal()))
    assert np.median(ratios) == pytest.approx(worth, rel=0.25)
