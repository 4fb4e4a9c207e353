"""Pulling something open in a small world of another make: gently, to the goal, or not at all and with a reason."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from impedance.gentle import ABORT, BACK, LIMITS, TASK, assert_gentle, assert_smooth
from impedance.toy import PANDA, PERIOD, Toy, door, drawer, limits, pull

from modcal_core.articulation.joints import JointModel
from modcal_core.impedance.operation import Operation
from modcal_core.impedance.speed_governor import GovernorSettings, SpeedGovernor
from modcal_core.impedance.task import ImpedanceTask

pytestmark = pytest.mark.slow


SCENES = {
    "door": (Toy(door(0.4)), 0.14, TASK.goal_rad),
    "narrow door, hinged on the other side": (Toy(door(0.25, -1.0), friction=2.0, seed=1), 0.14, TASK.goal_rad),
    "drawer": (Toy(drawer(), friction=6.0, spring=10.0, inertia=4.0, seed=2), 0.07, TASK.goal_m),
}


@pytest.mark.parametrize("name", SCENES)
def test_it_opens_gently_as_far_as_it_should(name: str) -> None:
    toy, trusts, goal = SCENES[name]
    done = pull(toy, Operation(PANDA, TASK, LIMITS), trusts)
    assert done.stop is not None
    assert done.stop.done, done.stop.why
    assert done.opened == pytest.approx(goal, rel=0.03)
    assert done.stop.opened == pytest.approx(done.opened, rel=0.03)
    assert list(dict.fromkeys(done.phases)) == ["tare", "explore", "check", "follow", "arrive"]
    assert_gentle(done)
    assert_smooth(done)


def test_a_model_that_is_revised_all_the_time_shakes_nothing(rng: np.random.Generator) -> None:
    """Five times a second the hinge lies 5 mm elsewhere: forces and steps stay as small."""
    done = pull(Toy(door()), Operation(PANDA, TASK, LIMITS), revise=0.005, rng=rng)
    assert done.stop is not None
    assert done.stop.done, done.stop.why
    assert_gentle(done)
    assert_smooth(done)


@pytest.mark.parametrize("wrong", [drawer(), door(0.2)], ids=["a drawer", "a door of half the width"])
def test_a_wrong_model_harms_nothing(wrong: JointModel) -> None:
    """The way that it expects is not the way that the door goes: the pull ends below the limit, or gets there gently."""
    done = pull(Toy(door()), Operation(PANDA, TASK, LIMITS), model=wrong, seconds=50.0)
    assert done.stop is not None
    assert done.forces.max() < ABORT
    assert_smooth(done)


def test_a_way_that_the_arm_cannot_go_is_not_begun() -> None:
    """The believed axis leads the tool through the arm's own shoulder: said after 8°, not found out at 50°."""
    far = ImpedanceTask(direction=BACK, goal_m=0.9)
    done = pull(Toy(drawer(), friction=6.0, inertia=4.0), Operation(PANDA, far, LIMITS), trusts=0.05)
    assert done.stop is not None
    assert not done.stop.done
    assert "cannot move it" in done.stop.why
    assert done.opened < 0.12
    assert "follow" not in done.phases
    assert_gentle(done)


def test_what_nothing_predicts_is_given_up() -> None:
    done = pull(
        Toy(drawer(), friction=3.0, inertia=4.0), Operation(PANDA, replace(TASK, max_exploration=0.08), LIMITS), 9.9
    )
    assert done.stop is not None
    assert "motion not identified after" in done.stop.why
    assert done.opened < 0.1


def test_the_expected_mode_leaves_giving_way_to_the_stack() -> None:
    """A soft servo: what is sent is the expected way itself, with the stiffness that the stack shall have."""
    soft = Toy(door(), stiffness=np.array([400.0] * 3 + [30.0] * 3), friction=0.5, spring=0.5)
    task = replace(TASK, mode="expected")
    done = pull(soft, Operation(PANDA, task, limits(displacement=0.15)))
    assert done.stop is not None
    assert done.stop.done, done.stop.why
    assert_gentle(done)
    following = [s for _, s in done.setpoints if s.why == "follow"]
    truth = np.array([soft.truth.pose(soft.truth.configuration(s.pose))[:3, 3] - s.pose[:3, 3] for s in following])
    assert np.abs(truth[-500:]).max() < 2e-3
    stiff = following[-1].stiffness
    assert stiff[:3].min() == pytest.approx(300.0, rel=0.05)


def test_force_slows_the_pace_down_and_stops_it() -> None:
    pace = SpeedGovernor(GovernorSettings())
    free, half, full = (np.array([f, 0, 0, 0, 0, 0.0]) for f in (20.0, 38.75, 48.0))
    for _ in range(1000):
        pace.step(0.06, math.inf, free, PERIOD)
    assert pace.speed == pytest.approx(0.06)
    for _ in range(100):
        pace.step(0.06, math.inf, half, PERIOD)
    assert pace.speed == pytest.approx(0.03)
    for _ in range(100):
        pace.step(0.06, math.inf, full, PERIOD)
    assert pace.speed == 0.0
    assert GovernorSettings().share(np.array([0, 0, 0, 0, 0, 20.0])) == 0.0
