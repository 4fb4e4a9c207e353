"""Pulls in a small world: gently to the goal, or let go below the limit; inputs that are late, and limits that change."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from impedance.gentle import ABORT, BACK, LIMITS, TASK, assert_gentle, assert_smooth
from impedance.toy import PANDA, PERIOD, T_READY, Toy, door, drawer, limits, pull

from modcal_core.impedance.operation import Operation
from modcal_core.impedance.safety_monitor import Limits
from modcal_core.impedance.speed_governor import GovernorSettings
from modcal_core.impedance.task import ImpedanceTask

pytestmark = pytest.mark.slow

SCENES = {
    "door": (Toy(door(0.25, -1.0), friction=2.0, seed=1), 0.14, TASK.goal_rad),
    "drawer": (Toy(drawer(), friction=6.0, spring=10.0, inertia=4.0, seed=2), 0.07, TASK.goal_m),
}


@pytest.mark.parametrize("name", SCENES)
def test_it_opens_gently_as_far_as_it_should(name: str) -> None:
    toy, trusts, goal = SCENES[name]
    done = pull(toy, Operation(PANDA, TASK, LIMITS), trusts)
    assert done.stop.done, done.stop.why
    assert done.opened == pytest.approx(goal, rel=0.03)
    assert done.stop.opened == pytest.approx(done.opened, rel=0.03)
    assert list(dict.fromkeys(done.phases)) == ["tare", "explore", "check", "follow", "arrive"]
    assert_gentle(done)
    assert_smooth(done)


def test_a_model_that_is_revised_all_the_time_shakes_nothing(rng: np.random.Generator) -> None:
    """Five times a second the hinge lies 5 mm elsewhere: forces and steps stay as small."""
    done = pull(Toy(door()), Operation(PANDA, TASK, LIMITS), revise=0.005, rng=rng)
    assert done.stop.done, done.stop.why
    assert_gentle(done)
    assert_smooth(done)


def test_a_wrong_model_harms_nothing() -> None:
    """The way that it expects is not the way that the door goes: the pull ends below the limit, or gets there gently."""
    done = pull(Toy(door()), Operation(PANDA, TASK, LIMITS), model=drawer(), seconds=50.0)
    assert done.stop is not None
    assert done.forces.max() < ABORT
    assert_smooth(done)


def test_a_way_that_the_arm_cannot_go_is_not_begun() -> None:
    """The believed axis leads the tool through the arm's own shoulder: said after 8°, not found out at 50°."""
    far = ImpedanceTask(direction=BACK, goal_m=0.9)
    done = pull(Toy(drawer(), friction=6.0, inertia=4.0), Operation(PANDA, far, LIMITS), trusts=0.05)
    assert not done.stop.done
    assert "cannot move it" in done.stop.why
    assert done.opened < 0.12
    assert "follow" not in done.phases
    assert_gentle(done)


def test_what_nothing_predicts_is_given_up() -> None:
    done = pull(
        Toy(drawer(), friction=3.0, inertia=4.0), Operation(PANDA, replace(TASK, max_exploration=0.08), LIMITS), 9.9
    )
    assert "motion not identified after" in done.stop.why
    assert done.opened < 0.1


def test_the_expected_mode_leaves_giving_way_to_the_stack() -> None:
    """A soft servo: what is sent is the expected way itself, with the stiffness that the stack shall have."""
    soft = Toy(door(), stiffness=np.array([400.0] * 3 + [30.0] * 3), friction=0.5, spring=0.5)
    task = replace(TASK, mode="expected")
    done = pull(soft, Operation(PANDA, task, limits(displacement=0.15)))
    assert done.stop.done, done.stop.why
    assert_gentle(done)
    following = [s for _, s in done.setpoints if s.why == "follow"]
    truth = np.array([soft.truth.pose(soft.truth.configuration(s.pose))[:3, 3] - s.pose[:3, 3] for s in following])
    assert np.abs(truth[-500:]).max() < 2e-3
    stiff = following[-1].stiffness
    assert stiff[:3].min() == pytest.approx(300.0, rel=0.05)


# The object, how it is pulled, what is said in the end, and the force [N] that is left then.
LET_GO: dict[str, tuple[Toy, dict[str, float], str, float]] = {
    "locked": (Toy(door(), locked=True), {}, "does not move", 5.0),
    "ends early": (Toy(door(), last=0.5), {}, "stopped moving", ABORT),
    # the setpoint runs on, the hand does not, the wrench comes with fresh stamps and never changes
    "sensor stuck at 25 N": (Toy(door(), locked=True), {"stuck": 25.0}, "wrench", 5.0),
    # it hears its own noise and nothing of the contact: nothing repeats itself, and nothing is felt
    "sensor beside": (Toy(door(), locked=True, delay=20), {"deaf": 1.0}, "the setpoint leads the tool", 5.0),
    # where the arm is, is known: the hand lets go, then ends
    "sensor silent": (Toy(door(), locked=True), {"numb": 8.0}, "wrench: no message in the last", 3.0),
}


@pytest.mark.parametrize("name", LET_GO)
def test_what_does_not_go_on_is_let_go_below_the_limit(name: str) -> None:
    toy, how, why, left = LET_GO[name]
    done = pull(toy, Operation(PANDA, TASK, LIMITS), **how)
    assert not done.stop.done
    assert why in done.stop.why
    assert done.forces.max() < ABORT
    assert done.forces[-1] < left
    assert_smooth(done)


def test_a_hard_stop_is_met_below_the_limit() -> None:
    """As stiff as is believed, received 80 ms late, at full speed: no more than the last force that may be."""
    hard = Toy(drawer(), friction=6.0, last=0.15, stiffness=np.array([15e3] * 3 + [600.0] * 3), delay=20)
    done = pull(hard, Operation(PANDA, TASK, LIMITS), trusts=0.03)
    assert not done.stop.done
    assert done.opened == pytest.approx(0.15, abs=1e-3)
    assert "follow" in done.phases
    assert hard.peak < LIMITS.force
    assert done.forces[-1] < 5.0
    assert_smooth(done)


def test_the_expected_mode_lets_go_as_well() -> None:
    """There it is the stack that would go on pulling, at where it was told to be."""
    soft = Toy(door(), locked=True, stiffness=np.array([1000.0] * 3 + [30.0] * 3))  # as the stack is told to be
    done = pull(soft, Operation(PANDA, replace(TASK, mode="expected"), limits(displacement=0.15)))
    assert "does not move" in done.stop.why
    assert done.forces.max() > 15.0
    assert done.forces[-1] < 1.0


TO_20_CM = ImpedanceTask(direction=T_READY[:3, :3].T @ np.array([-1.0, 0.0, 0.0]), goal_m=0.2)


class Changed:
    """Once the way is followed at speed, other limits."""

    def __init__(self, new: Limits, task: ImpedanceTask = TO_20_CM) -> None:
        self.new, self.task, self.at = new, task, math.nan

    def __call__(self, now: float, operation: Operation) -> None:
        if operation.phase == "follow" and operation.governor.speed > 0.008 and math.isnan(self.at):
            self.at = now
            operation.restrict(self.task, self.new, now)


def speeds(done: object) -> tuple[np.ndarray, np.ndarray]:
    """Times and speeds of the tool's setpoints [m/s]."""
    t = np.array([t for t, _ in done.setpoints])  # type: ignore[attr-defined]
    p = np.array([s.pose[:3, 3] for _, s in done.setpoints])  # type: ignore[attr-defined]
    return t[1:], np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(t)


def test_a_lower_speed_holds_at_once_and_the_pull_goes_on() -> None:
    changed = Changed(limits(joint_speed=np.full(7, 0.015)))
    toy, how = Toy(drawer(), friction=6.0), Operation(PANDA, TO_20_CM, limits())
    done = pull(toy, how, trusts=0.05, meanwhile=changed, seconds=60.0)
    assert done.stop.done, done.stop.why
    t, v = speeds(done)
    before = v[t <= changed.at].max()
    assert before > 0.008
    assert v[t > changed.at].max() <= before * 1.01  # nothing becomes faster while it brakes
    q = np.array([s.q for _, s in done.setpoints])
    rates = np.abs(np.diff(q, axis=0)).max(axis=1) / PERIOD
    assert rates[t > changed.at + 0.1].max() <= 0.015 * (1.0 + 1e-6)


CASES: dict[str, tuple[Callable[[], Limits], ImpedanceTask, str]] = {
    "force": (
        lambda: limits(force=4.0),
        replace(TO_20_CM, governor=GovernorSettings(slowdown=(2.0, 6.0), stop=(3.0, 14.0), max_force=4.0)),
        "4 N is the limit",
    ),
    "displacement": (lambda: limits(displacement=1e-4), TO_20_CM, "limits were changed: the setpoint is"),
    "gain": (lambda: limits(gain=0.9), TO_20_CM, "limits were changed: the posture is next to singular"),
}


@pytest.mark.parametrize("name", CASES)
def test_where_the_new_limits_do_not_allow_what_is_there_the_hand_lets_go(name: str) -> None:
    new, task, why = CASES[name]
    toy = Toy(drawer(), friction=8.0)
    done = pull(toy, Operation(PANDA, TO_20_CM, limits()), trusts=0.05, meanwhile=Changed(new(), task))
    assert not done.stop.done
    assert why in done.stop.why
    assert done.phases[-1] == "release"
    assert done.forces[-1] < 8.5  # what friction holds, and no more
