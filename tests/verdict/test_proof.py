"""What may be named as a cause: what stations that were not used ask for, and nothing else takes the place of."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.loop import calibrate
from modcal_core.outcome import Outcome
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


def test_a_single_joint_is_not_named_for_what_all_of_them_do() -> None:
    report, case = calibrated("all joints stop short")
    assert not report.effects
    play = calibrated("the elbow's play")[1].model.effects
    with_play = replace(case, model=case.model.with_effects(play))
    assert Proofs(with_play, CALM).of([0]) is None


def test_nothing_is_named_beside_a_rest_that_is_predictable_and_many_rejected_stations() -> None:
    _, case = calibrated("the elbow's play")
    few = replace(case, wrong=np.arange(len(case.samples)) % 5 == 0)
    assert Proofs(case, CALM).of([0]) is not None
    assert Proofs(few, CALM).of([0]) is not None
    assert Proofs(few, replace(CALM, source="the posture")).of([0]) is None
