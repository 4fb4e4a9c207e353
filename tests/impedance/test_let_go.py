"""What is locked, jams or ends early, and sensors that feel nothing of it: let go below the limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from impedance.gentle import ABORT, LIMITS, TASK, assert_smooth
from impedance.toy import PANDA, Toy, door, drawer, limits, pull

from modcal_core.impedance.operation import Operation
from modcal_core.impedance.speed_governor import GovernorSettings

pytestmark = pytest.mark.slow


def test_forces_that_come_late_do_not_make_it_swing() -> None:
    """80 ms late, against what is rigid: with the plain damping, contact swings up to more than 60 N."""
    done = pull(Toy(door(), delay=20, locked=True), Operation(PANDA, TASK, LIMITS))
    assert done.stop is not None
    assert "does not move" in done.stop.why
    assert done.forces.max() <= GovernorSettings().stop[0]


def test_what_is_locked_is_left_alone() -> None:
    done = pull(Toy(door(), locked=True), Operation(PANDA, TASK, LIMITS))
    assert done.stop is not None
    assert not done.stop.done
    assert "does not move" in done.stop.why
    assert done.forces.max() < ABORT
    assert done.forces[-1] < 5.0  # and the force was let go
    assert_smooth(done)


@pytest.mark.parametrize("delay", [2, 20])
def test_a_hard_stop_is_met_below_the_limit(delay: int) -> None:
    """As stiff as is believed, heard 8 to 80 ms late, at full speed: no more than the last force that may be."""
    hard = Toy(drawer(), friction=6.0, last=0.15, stiffness=np.array([15e3] * 3 + [600.0] * 3), delay=delay)
    done = pull(hard, Operation(PANDA, TASK, LIMITS), trusts=0.03)
    assert done.stop is not None
    assert not done.stop.done
    assert done.opened == pytest.approx(0.15, abs=1e-3)
    assert "follow" in done.phases
    assert hard.peak < LIMITS.force
    assert done.forces[-1] < 5.0
    assert_smooth(done)


@pytest.mark.parametrize("stuck", [2.0, 15.0, 25.0])
def test_a_force_sensor_that_is_stuck_does_not_tear_at_what_is_locked(stuck: float) -> None:
    """The setpoint runs on, the hand does not, the wrench comes with fresh stamps and never changes."""
    done = pull(Toy(door(), locked=True), Operation(PANDA, TASK, LIMITS), stuck=stuck)
    assert done.stop is not None
    assert "wrench" in done.stop.why
    assert done.forces.max() < ABORT
    assert done.forces[-1] < 5.0
    assert_smooth(done)


@pytest.mark.parametrize("delay", [2, 20])
def test_a_force_sensor_that_hangs_beside_what_is_held_is_found_out_by_the_lead(delay: int) -> None:
    """It hears its own noise and nothing of the contact: nothing repeats itself, and nothing is felt."""
    done = pull(Toy(door(), locked=True, delay=delay), Operation(PANDA, TASK, LIMITS), deaf=1.0)
    assert done.stop is not None
    assert "the setpoint leads the tool" in done.stop.why
    assert done.forces.max() < ABORT
    assert done.forces[-1] < 5.0
    assert_smooth(done)


def test_a_stuck_sensor_lets_go_in_the_expected_mode_as_well() -> None:
    soft = Toy(door(), locked=True, stiffness=np.array([1000.0] * 3 + [30.0] * 3))
    done = pull(soft, Operation(PANDA, replace(TASK, mode="expected"), limits(displacement=0.15)), deaf=1.0)
    assert done.stop is not None
    assert "the setpoint leads the tool" in done.stop.why
    assert done.forces.max() < ABORT
    assert done.forces[-1] < 5.0


def test_a_force_beyond_the_limit_is_let_go_and_not_left_standing() -> None:
    """Of a limit below what the object takes: the spring between setpoint and tool is unwound before the end."""
    done = pull(Toy(door(), locked=True), Operation(PANDA, TASK, limits(force=20.0)))
    assert done.stop is not None
    assert "20 N is the limit" in done.stop.why
    assert 19.5 < done.forces.max() < 1.2 * 20.0  # felt with noise, and crept up to
    assert done.forces[-1] < 1.0
    assert_smooth(done)


def test_the_expected_mode_lets_go_as_well() -> None:
    """There it is the stack that would go on pulling, at where it was told to be."""
    soft = Toy(door(), locked=True, stiffness=np.array([1000.0] * 3 + [30.0] * 3))  # as the stack is told to be
    done = pull(soft, Operation(PANDA, replace(TASK, mode="expected"), limits(displacement=0.15)))
    assert done.stop is not None
    assert "does not move" in done.stop.why
    assert done.forces.max() > 15.0
    assert done.forces[-1] < 1.0


def test_a_door_that_ends_early_is_noticed() -> None:
    done = pull(Toy(door(), last=0.5), Operation(PANDA, TASK, LIMITS))
    assert done.stop is not None
    assert not done.stop.done
    assert "stopped moving" in done.stop.why
    assert done.forces.max() < ABORT


def test_where_nothing_is_felt_any_more_it_lets_go() -> None:
    """The force sensor falls silent with force in the hand; where the arm is, is known: the hand lets go, then ends."""
    done = pull(Toy(door(), locked=True), Operation(PANDA, TASK, LIMITS), numb=8.0)
    assert done.stop is not None
    assert "wrench: no message in the last" in done.stop.why
    assert done.forces.max() >= 8.0
    assert done.forces[-1] < 3.0
    assert done.phases[-1] == "release"
    assert_smooth(done)
