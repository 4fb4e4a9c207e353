"""The main path: three sets that never meet, postures that are read again, sockets, and frozen scores elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell, with_sockets
from modcal_core.calibration.covariance import uncertainty
from modcal_core.calibration.data_split import independent_unit, split
from modcal_core.calibration.distances import Distance
from modcal_core.calibration.fit import identify, require_enough
from modcal_core.calibration.noise import errors
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import BadRecording, BadTable, NotEnoughData
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import ORDER_ONLY, SOCKETS, Recording
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.contents import independent_units
from modcal_core.report.report import to_json_data
from modcal_nodes.simulation.mjcf import World


@pytest.mark.parametrize("block", [1, 7, None])
def test_the_three_sets_never_meet(block: int | None) -> None:
    samples = record(1, 160).samples
    # two instruments at every station
    both = samples.select(np.r_[np.arange(160), np.arange(160)])
    sets = split(both, np.random.default_rng(3), block)
    stations = [set(both.station[rows]) for rows in (sets.train, sets.explain, sets.held_out)]
    assert sum(len(s) for s in stations) == 160 == len(set.union(*stations))
    assert [len(s) for s in stations] == [80, 32, 48] if block in (1, None) else sets.unit == "block"


def test_so_few_that_no_effect_is_told_from_noise_are_for_the_geometry() -> None:
    made = record(4, 11, "pose")
    report = calibrate(made.samples, ur10(), np.random.default_rng(0)).report
    assert (len(report.sets.train), len(report.sets.explain), len(report.sets.held_out)) == (8, 0, 3)
    assert not report.searched
    claim = report.claim
    q = made.samples.q[:1] + 0.1 * np.random.default_rng(1).standard_normal((200, 6))
    low, high = made.samples.q.min(axis=0), made.samples.q.max(axis=0)
    shipped = calibrate(made.samples, ur10(), np.random.default_rng(0)).calibration
    q = np.clip(q, low, high)
    gap = shipped.predict(q)[:, :3, 3] - made.world.tool_in_tracker(q)[:, :3, 3]
    assert np.percentile(1e3 * np.linalg.norm(gap, axis=1), 95) < claim.mm["p95"].ci95[1]


@pytest.mark.slow
def test_held_out_error_is_that_of_the_world() -> None:
    made = record(2, 160)
    result = calibrate(made.samples, ur10(), np.random.default_rng(0))
    data = to_json_data(result.report)
    assert data["split"] == {"unit": "station", "train": 80, "explain": 32, "held_out": 48}
    assert data["error_mm"]["nominal"]["rms"] > 10 * data["error_mm"]["final"]["rms"]
    # noise of 0.05 mm an axis, and the scatter of 30 parameters from 80 poses
    assert data["error_mm"]["final"]["rms"] == pytest.approx(0.05 * np.sqrt(3), rel=0.25)
    assert data["identifiability"]["rank"] == 30
    assert data["identifiability"]["unobservable"] == []
    q = np.random.default_rng(4).uniform(-np.pi, np.pi, (200, 6))
    gap = result.calibration.calibrated.predict(q)[:, :3, 3] - made.world.tool_in_tracker(q)[:, :3, 3]
    assert np.sqrt(np.mean(np.sum(gap**2, axis=1))) < 3e-5


@pytest.mark.slow
def test_a_moved_base_and_tool_are_found_again() -> None:
    made = record(4, 160)
    calibration = calibrate(made.samples, ur10(), np.random.default_rng(0)).calibration
    rng = np.random.default_rng(9)
    q = rng.uniform(-np.pi, np.pi, (100, 6))
    moved = se3.exp(rng.normal(size=6)) @ made.world.tool_in_tracker(q) @ se3.exp(0.1 * rng.normal(size=6))
    samples = samples_of(ur10(), q, moved, frame="another")
    with pytest.raises(BadTable, match="--refit-base"):
        evaluate(calibration, samples, rng)
    report = evaluate(calibration, samples, rng, refit_base=True, refit_tool=True)
    before, after = report.size_mm("nominal"), report.size_mm("final")
    assert after.rms < 0.05 < 0.3 < before.rms
    assert report.set_sizes()["held_out"] == 30
    only_base = evaluate(calibration, samples, rng, refit_base=True).size_mm("final")
    assert only_base.rms > 10.0  # the tool has changed too


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "offender"),
    [
        (lambda q: q[:, [0, 2, 1, 3, 4, 5]], "joints shoulder_lift_joint and elbow_joint look swapped"),
        (lambda q: np.degrees(0.03 * q), "joint positions look like degrees"),
        (lambda q: np.roll(q, 1, axis=0), "readings look"),
    ],
)
def test_mistakes_in_pairing_are_named(spoil: object, offender: str) -> None:
    made = record(6, 120)
    q = made.samples.q if "degrees" not in offender else 0.03 * made.samples.q
    T = made.world.tool_in_tracker(q)
    wrong = spoil(made.samples.q)  # type: ignore[operator]
    with pytest.raises(BadRecording, match=offender):
        calibrate(samples_of(ur10(), wrong, T), ur10(), np.random.default_rng(0))


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


def test_equations_are_those_of_different_postures() -> None:
    require_enough(taken(np.arange(40)), 42, share=0.5)
    with pytest.raises(NotEnoughData, match="48 stations in 8 postures .* give 24 equations.* 13 different postures"):
        require_enough(taken(np.repeat(np.arange(8), 6)), 42, share=0.5)


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
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


CHAIN = ur10()


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "noise"), [("point", 0.0), ("pose", 1e-5)])
def test_a_tracker_that_stands_still_is_refused(kind: str, noise: float) -> None:
    made = record(1, 80, kind)
    T = np.repeat(made.world.tool_in_tracker(made.samples.q[:1]), 80, axis=0)
    T[:, :3, 3] += noise * np.random.default_rng(0).normal(size=(80, 3))
    with pytest.raises(BadRecording, match=rf"/tracker/{kind} \(tracker\): readings stand still .*sockets"):
        calibrate(samples_of(CHAIN, made.samples.q, T, kind), CHAIN, np.random.default_rng(0))
    good = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    with pytest.raises(BadRecording, match="stand still"):
        evaluate(good, samples_of(CHAIN, made.samples.q, T, kind), np.random.default_rng(0))


def test_metres_that_were_taken_for_millimetres_do_not_stand_still() -> None:
    """A thousandth of the way is a unit: only what does not go along with the tip is a tracker that stands still."""
    made = record(1, 80)
    good = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    small = replace(made.samples, reading=1e-3 * made.samples.reading)
    with pytest.raises(BadRecording, match="metres taken for millimetres"):
        evaluate(good, small, np.random.default_rng(0))


def test_sockets_are_stated_by_the_cell_a_distance_or_the_recording() -> None:
    q = np.random.default_rng(0).uniform(-1, 1, (10, 6))
    origin = np.tile(np.eye(4), (10, 1, 1))
    samples = samples_of(CHAIN, q, origin, "point", "a")
    both = samples.followed_by(samples_of(CHAIN, q, origin, "point", "b"))
    assert with_sockets(both, Cell(sockets=("a", "b")), CHAIN).sockets == ("a", "b")
    assert with_sockets(both, Cell(distances=(Distance(("a", "b"), 0.05, 1e-4),)), CHAIN).is_same_point(1)
    assert with_sockets(replace(both, sockets=("b", "a")), Cell(), CHAIN).is_same_point(0)
    with pytest.raises(BadRecording, match=r"point \(b\)"):
        with_sockets(both, Cell(sockets=("a",)), CHAIN)


def test_a_recording_says_what_its_notes_state() -> None:
    stated = Recording(warnings=(ORDER_ONLY, f"{SOCKETS}left_hole_0, left_hole_1."))
    assert stated.sockets == ("left_hole_0", "left_hole_1")
    assert not stated.has_clock
    assert Recording(warnings=("A note.",)).has_clock
    samples = record(1, 20).samples
    assert not samples.followed_by(replace(samples, clock=False)).clock
