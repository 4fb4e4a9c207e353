"""What may be named as a cause: what unused stations ask for, with its name, and columns that a fit comes to terms with."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability
from modcal_core.calibration.fit import identify
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects import Shape
from modcal_core.effects.families.gear_harmonic import whole
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import PART, SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.outcome import Outcome
from modcal_core.report.report import to_json_data
from modcal_core.verdict import Case, Proofs, Verdict, fitted_case

ELBOW, CALM = 2, Verdict("at_floor")


@cache
def calibrated(fault: str, seed: int = 3, count: int = 90, draw: int = 0) -> tuple[Outcome, Case]:
    """The outcome, and the case of the scored fit, of an arm whose joints are elsewhere than reported by a fault."""
    made, rng = record(seed, count), np.random.default_rng(seed)
    q = made.samples.q
    came = np.diff(q, axis=0, prepend=q[:1])
    off = {
        "the elbow's play": 4e-4 * np.sign(came) * (np.arange(6) == ELBOW),
        "all joints stop short": -3e-4 * came,
        "the elbow's gear": 4e-4 * np.sin(13.0 * q) * (np.arange(6) == ELBOW),
        "the elbow moved once": np.outer(np.arange(count) >= count // 2, 2e-3 * (np.arange(6) == ELBOW)),
    }[fault]
    T = made.world.tool_in_tracker(q + off)
    T[:, :3, 3] += 3e-5 * rng.standard_normal((count, 3))
    samples = replace(samples_of(ur10(), q, T), approach=np.sign(came))
    found = calibrate(samples, ur10(), np.random.default_rng(draw))
    report = found.report
    return report, fitted_case(found.scored, report.samples, report.sets, report.wrong, dict(report.errors))


@pytest.mark.parametrize(("fault", "family"), [("the elbow's play", "backlash"), ("the elbow moved once", "step")])
def test_a_joint_that_is_at_fault_is_named(fault: str, family: str) -> None:
    report, _ = calibrated(fault)
    named = [(effect.family, effect.place) for effect in report.effects]
    assert named == [(family, ur10().names[ELBOW])]
    assert not [name for name in report.effects[0].same_as if "_joint" in name]


def test_a_draw_decides_which_stations_score_and_no_word() -> None:
    """The score is of other stations, whose fit and choice have not seen them; the words are those of all stations."""
    (own, case), (other, again) = (calibrated("the elbow's play", draw=draw) for draw in (0, 5))
    assert set(own.sets.held_out) != set(other.sets.held_out)
    assert not set(other.sets.held_out) & set(other.sets.train)
    assert (own.story, own.status, own.notes) == (other.story, other.status, other.notes)
    np.testing.assert_array_equal(own.model.effects[0].values, other.model.effects[0].values)
    assert own.size_mm("final").rms != other.size_mm("final").rms
    # the fit that is scored has its effect from other stations than the one that is shipped
    assert again.model.effects[0].values[0] != case.model.effects[0].values[0]
    assert other.size_mm("final").rms < 0.5 * other.size_mm("geometric").rms


def test_a_rest_with_its_effects_put_back_is_what_the_model_leaves_without_them() -> None:
    """Else an effect is asked beside twice what it left, and whatever is false in it speaks for it."""
    _, case = calibrated("the elbow's play")
    (play,) = case.model.effects
    bare = replace(case, model=case.model.with_effects((play.with_values(np.zeros(1)),)))
    whole, left = (Proofs(each, CALM)._everything._whole for each in (case, bare))
    assert np.linalg.norm(whole - left) < 1e-3 * np.linalg.norm(left)


def test_a_single_joint_is_not_named_for_what_all_of_them_do() -> None:
    report, case = calibrated("all joints stop short")
    assert not report.effects
    play = calibrated("the elbow's play")[1].model.effects
    with_play = replace(case, model=case.model.with_effects(play))
    assert Proofs(with_play, CALM).of([0]) is None


def test_what_something_in_its_place_beats_beyond_the_odds_is_no_cause() -> None:
    """It is not even one of them: the other is what the stations ask for."""
    _, case = calibrated("the elbow's gear")
    right = [*whole(ur10().names[ELBOW], 13)][-1]
    near = replace(right, shape=Shape("turn", {"cycles": 12.8})).with_values(np.array([2e-4, 1e-4]))
    asked = Proofs(replace(case, model=case.model.with_effects((near,))), CALM)
    assert asked.of([0]) == ()
    assert asked.of([0], [right]) is None


def test_nothing_is_named_beside_a_rest_that_is_predictable_and_many_rejected_stations() -> None:
    _, case = calibrated("the elbow's play")
    few = replace(case, wrong=np.arange(len(case.samples)) % 5 == 0)
    assert Proofs(case, CALM).of([0]) is not None
    assert Proofs(few, CALM).of([0]) is not None
    assert Proofs(few, replace(CALM, source="the posture")).of([0]) is None


def in_a_small_part(seed: int) -> Samples:
    """Points at postures whose last joints hardly turn, so that other links make up for much of what is wrong."""
    recorded = record(seed, 90, "point")
    rng = np.random.default_rng(seed)
    middle, half = np.array([0.2, -1.0, 1.2, -0.4, 0.6, 0.3]), np.array([0.7, 0.5, 0.5, 0.5, 0.12, 0.12])
    q = middle + half * rng.uniform(-1.0, 1.0, recorded.samples.q.shape)
    seen = recorded.world.tool_in_tracker(q)[:, :3, 3] + rng.normal(0.0, 5e-5, (len(q), 3))
    return replace(recorded.samples, q=q, reading=seen)


def said_of(samples: Samples) -> str:
    report = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.rejected == 0
    return " ".join(report.judged.open_because)


def test_joints_that_are_swapped_are_named_though_nothing_is_rejected() -> None:
    samples = in_a_small_part(0)
    said = said_of(replace(samples, q=samples.q[:, [0, 1, 2, 3, 5, 4]]))
    assert "wrist_2_joint and wrist_3_joint look swapped" in said


def test_nothing_is_said_of_the_joints_as_they_are() -> None:
    assert "look swapped" not in said_of(in_a_small_part(0))


def test_no_direction_is_printed_blank() -> None:
    """Where many parameters share what is not shown, each being a small part of it, some are named all the same."""
    samples = record(1, 60).samples
    nominal = fit_cell(ur10(), samples, Cell())
    fit = identify(nominal.model, samples, choose_parameters(nominal.model, views_of(samples)).parameters)
    prior = np.array([p.prior_std if np.isfinite(p.prior_std) else 1.0 for p in fit.parameters])
    for count in (2, 5, len(prior)):
        blind = np.zeros(len(prior))
        blind[:count] = 1.0 / np.sqrt(count)
        seen = 100.0 * (np.eye(len(prior)) - np.outer(blind, blind))
        found = identifiability(replace(fit, information=seen / np.outer(prior, prior)))
        assert found.rank == len(prior) - 1
        (said,) = found.unobservable
        assert said
        named = said.split(" with ")
        assert set(named) <= {p.name for p in fit.parameters[:count]}
        assert len(named) == min(count, 3 if count > 11 else count)


@pytest.mark.slow
def test_the_column_of_a_lagging_joint_names_the_joint() -> None:
    """A topic tells by how much each joint misses its goal, and one joint is logged where it was to be: 1 rad/rad."""
    samples, rng = record(3, 140).samples, np.random.default_rng(0)
    missed = rng.normal(0.0, 2e-3, samples.q.shape)
    q = samples.q.copy()
    q[:, 2] -= missed[:, 2]
    columns = tuple(
        SignalTrack(f"signal:/joint_errors{PART}{name}", samples.stamps, missed[:, [k]], "/joint_errors")
        for k, name in enumerate(samples.names)
    )
    report = calibrate(replace(samples, q=q, signals=columns), ur10(), np.random.default_rng(0)).report
    found = [
        effect for effect in to_json_data(report)["effects"] if effect["driver"].startswith("signal:/joint_errors")
    ]
    assert [(effect["place"], effect["direction"]) for effect in found] == [("elbow_joint", "axis")]
    size = found[0]["parameters"]["axis"]
    assert abs(size["value"] - 1.0) < 3.0 * size["std"] + 0.005
    assert size["std"] < 0.01
