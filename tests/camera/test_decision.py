"""When a calibrated arm is to be used: what both arms share does not hide that one is better, and is no gain either."""

from __future__ import annotations

import numpy as np

from modcal_core.camera.claim import APPLY, AS_STATED, DO_NOT_APPLY, DecisionGrounds, DrawnErrors, ToolError, decide
from modcal_core.geometry.so3 import Array

COUNT = 2000


def error(calibrated: Array, nominal: Array) -> ToolError:
    return ToolError({AS_STATED: DrawnErrors(calibrated, calibrated, nominal)})


def test_what_is_open_of_both_arms_hides_no_gain(rng: np.random.Generator) -> None:
    """The lens puts both off by up to 3 mm, and the nominal arm by 2 mm besides, whichever way the lens does."""
    lens = 3e-3 * np.abs(rng.standard_normal(COUNT))
    both = error(np.hypot(lens, 3e-4), np.hypot(lens, 2e-3))
    assert both.interval[2] > both.nominal_interval[0]
    found = decide(both, DecisionGrounds())
    assert found.word == APPLY
    assert "moves both alike" in found.because[0]
    # the same two intervals where nothing is shared
    apart = error(both.by[AS_STATED].calibrated, rng.permutation(both.by[AS_STATED].nominal))
    assert apart.interval == both.interval
    assert apart.nominal_interval == both.nominal_interval
    assert decide(apart, DecisionGrounds()).word == DO_NOT_APPLY


def test_three_draws_in_two_hundred_that_are_worse_are_too_many(rng: np.random.Generator) -> None:
    calibrated = np.full(COUNT, 1e-3)
    nominal = np.where(np.arange(COUNT) < 0.015 * COUNT, 0.9e-3, 2e-3)
    assert decide(error(calibrated, nominal), DecisionGrounds()).word == DO_NOT_APPLY
    nominal = np.where(np.arange(COUNT) < 0.002 * COUNT, 0.9e-3, 2e-3)
    assert decide(error(calibrated, nominal), DecisionGrounds()).word == APPLY


def test_what_the_user_states_of_the_arm_is_to_be_beaten_by_all_of_the_interval() -> None:
    ends = error(np.linspace(1e-4, 1e-3, COUNT), np.full(COUNT, 5e-3))
    assert decide(ends, DecisionGrounds(stated_m=2e-3)).word == APPLY
    found = decide(ends, DecisionGrounds(stated_m=9e-4))
    assert found.word == DO_NOT_APPLY
    assert "0.90 mm is stated" in found.because[0]
