"""Pulling something open in a small world of another make: gently, to the goal, or not at all and with a reason."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, READY, T_READY, Belief, Pulled, Toy, door, drawer, limits, pull

from modcal_core.articulation.joints import JointModel
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.operation import Operation
from modcal_core.impedance.safety_monitor import ArmSetpoint
from modcal_core.impedance.speed_governor import GovernorSettings, SpeedGovernor
from modcal_core.impedance.task import ImpedanceTask, JointPositions, Stop, Wait
from modcal_core.impedance.wrench import WrenchSensor
from modcal_core.robots.kinematics import forward

pytestmark = pytest.mark.slow

PEAK, MEAN, ABORT = 40.0, 12.0, 60.0  # N
BACK = T_READY[:3, :3].T @ np.array([-1.0, 0.0, 0.0])  # towards −x of the base, seen from the tool
TASK = ImpedanceTask(
    direction=BACK, goal_rad=math.radians(40.0), goal_m=0.2
)  # by then the model is followed at full speed
LIMITS = limits()


def assert_gentle(done: Pulled, peak: float = PEAK) -> None:
    assert done.forces.max() <= peak
    assert done.forces.mean() <= MEAN


def assert_smooth(done: Pulled) -> None:
    """Steps of what was sent, by differences of joints and poses, within the limits."""
    times = np.array([t for t, _ in done.setpoints])
    gaps = np.diff(times)
    together = gaps < 5.0 * PERIOD
    p = np.array([s.pose[:3, 3] for _, s in done.setpoints])
    q = np.array([s.q for _, s in done.setpoints])
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / gaps
    assert (speed <= LIMITS.speed).all()
    rates = np.diff(q, axis=0) / gaps[:, None]
    assert (np.abs(rates) <= LIMITS.joint_speed).all()
    change = np.abs(np.diff(rates, axis=0)) / gaps[1:, None]
    assert (change[together[1:] & together[:-1]] <= LIMITS.joint_acceleration * 1.001).all()


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


def test_forces_that_come_late_do_not_make_it_swing() -> None:
    """80 ms late, against what does not give way: with the plain damping, contact swings up to more than 60 N."""
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


class Still:
    """An arm that stands where it is told, with a weight on its sensor, for what is fed by hand."""

    def __init__(self, operation: Operation) -> None:
        self.operation, self.now, self.q = operation, 50.0, READY
        self.sensor, self.belief = WrenchSensor([(PANDA.tip, np.eye(4))]), Belief()

    def tick(
        self, wrench: Array | None = None, joints_age: float = 0.0, hear: bool = True
    ) -> ArmSetpoint | Wait | Stop:
        self.now += PERIOD
        if hear:
            w = np.array([0, 0, 8.0, 0, 0, 0]) + (0.0 if wrench is None else wrench)
            self.sensor.receive(PANDA.tip, w, self.now, self.now, 0.1)
        joints = JointPositions(self.q, self.now - joints_age)
        out = self.operation.tick(self.now, forward(PANDA, self.q), self.sensor, joints, self.belief)
        if isinstance(out, ArmSetpoint):
            self.q = out.q
        return out

    def until(self, phase: str) -> None:
        for _ in range(2000):
            self.tick()
            if self.operation.phase == phase:
                return
        raise AssertionError(self.operation.phase)


def test_a_stack_behind_the_admittance_shall_be_stiff() -> None:
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    sent = [out for _ in range(5) if isinstance(out := still.tick(), ArmSetpoint)]
    assert (sent[-1].stiffness == [3000.0] * 3 + [200.0] * 3).all()
    assert not sent[-1].wrench.any()


def test_it_waits_for_what_is_late_and_goes_on_from_rest() -> None:
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    last = [out for _ in range(300) if isinstance(out := still.tick(), ArmSetpoint)][-1]
    silent = [still.tick(hear=False) for _ in range(100)]
    assert isinstance(silent[-1], Wait)
    assert "wrench" in silent[-1].why
    sent = [s for s in silent if isinstance(s, ArmSetpoint)]
    assert len(sent) <= 0.1 / PERIOD + 1
    last = sent[-1] if sent else last
    again = still.tick()
    assert isinstance(again, ArmSetpoint)
    assert np.abs(again.q - last.q).max() <= (LIMITS.joint_acceleration * PERIOD**2).max()


def test_it_does_not_wait_for_ever() -> None:
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    outs = [still.tick(joints_age=0.5) for _ in range(int(6.0 / PERIOD))]
    assert all(isinstance(out, Wait) for out in outs[: int(4.5 / PERIOD)])
    assert isinstance(outs[-1], Stop)
    assert "joint_states" in outs[-1].why
    assert isinstance(still.tick(), Stop)  # and stays so


def test_an_arm_that_is_heard_again_lets_go_and_is_not_led_on() -> None:
    """After more than a second without joint states the pull is over; what the servos hold on to is let go."""
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    for _ in range(400):
        still.tick()
    before = forward(PANDA, still.q)[:3, 3]
    lost = [still.tick(joints_age=0.5) for _ in range(int(2.0 / PERIOD))]
    assert all(isinstance(out, Wait) for out in lost)
    outs = [still.tick() for _ in range(300)]
    sent = [out for out in outs if isinstance(out, ArmSetpoint)]
    assert sent
    assert {s.why for s in sent} == {"release"}
    assert np.linalg.norm([s.pose[:3, 3] - before for s in sent], axis=1).max() < 1e-3
    assert isinstance(outs[-1], Stop)
    assert "joint_states" in outs[-1].why


@pytest.mark.parametrize("gap", [0.5, 2.0])
def test_a_release_that_is_interrupted_is_finished(gap: float) -> None:
    """Joint states pause in the middle of it: the rest of its time, and the same word, are still to come."""
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    for _ in range(400):
        still.tick()
    still.operation.release("stopped as asked", still.now)
    sent = [still.tick() for _ in range(25)]
    assert {out.why for out in sent if isinstance(out, ArmSetpoint)} == {"release"}
    lost = [still.tick(joints_age=0.5) for _ in range(int(gap / PERIOD))]
    assert all(isinstance(out, Wait) for out in lost)
    outs = [still.tick() for _ in range(300)]
    again = [out for out in outs if isinstance(out, ArmSetpoint)]
    assert 0.45 <= len(again) * PERIOD <= 0.65
    assert isinstance(outs[-1], Stop)
    assert outs[-1].why == "stopped as asked"


@pytest.mark.parametrize("phase", ["explore", "follow"])
def test_without_its_estimator_a_pull_ends(phase: str) -> None:
    """The model that it had, or was to get, is nobody's any more: it lets go within the patience for any input."""
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    if phase == "follow":
        still.belief.model, still.belief.trusted = drawer(forward(PANDA, still.q)), True
        still.until("follow")
    for _ in range(int(1.5 / PERIOD)):
        assert isinstance(still.tick(), ArmSetpoint)
    still.belief.silent, still.belief.trusted = True, False
    outs = [still.tick() for _ in range(int(1.0 / PERIOD))]
    assert still.operation.phase == "release"
    assert isinstance(outs[-1], Stop)
    assert "articulation_estimator" in outs[-1].why


def test_nothing_moves_before_the_estimator_is_received() -> None:
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.belief.silent = True
    outs = [still.tick() for _ in range(int(3.0 / PERIOD))]
    assert all(isinstance(out, Wait) for out in outs)
    assert "articulation_estimator" in outs[-1].why
    still.belief.silent = False
    still.until("explore")
    never = Still(Operation(PANDA, TASK, LIMITS))
    never.belief.silent = True
    last = [never.tick() for _ in range(int(12.0 / PERIOD))][-1]
    assert isinstance(last, Stop)
    assert "articulation_estimator" in last.why


def test_a_model_that_is_trusted_already_is_followed() -> None:
    """As from an earlier pull at the same object: it is checked in its own time, and followed."""
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.belief.model, still.belief.trusted = drawer(), True
    still.until("check")
    still.until("follow")


def test_where_nothing_is_felt_any_more_it_lets_go() -> None:
    """The force sensor falls silent with force in the hand; where the arm is, is known: the hand lets go, then ends."""
    done = pull(Toy(door(), locked=True), Operation(PANDA, TASK, LIMITS), numb=8.0)
    assert done.stop is not None
    assert "wrench: no message in the last" in done.stop.why
    assert done.forces.max() >= 8.0
    assert done.forces[-1] < 3.0
    assert done.phases[-1] == "release"
    assert_smooth(done)


def test_a_blow_ends_it_and_is_not_given_way_to_further_than_it_moves_the_tool() -> None:
    """What is felt, but moves nothing, may be the sensor's fault: the tool stands where it is, and that is the end."""
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    for _ in range(200):
        still.tick()
    before = forward(PANDA, still.q)
    outs = [still.tick(np.array([0, 200.0, 0, 0, 0, 0])) for _ in range(200)]
    assert still.operation.phase == "release"
    assert isinstance(outs[-1], Stop)
    assert "force" in outs[-1].why
    assert "50 N is the limit" in outs[-1].why
    assert np.linalg.norm(forward(PANDA, still.q)[:3, 3] - before[:3, 3]) < 1e-3


def test_a_clock_that_goes_back_ends_it() -> None:
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    still.tick()
    still.now -= 5.0
    still.sensor.reset()
    assert isinstance(still.tick(), Stop)


def test_the_tool_is_not_weighed_while_it_moves() -> None:
    still = Still(Operation(PANDA, TASK, LIMITS))
    for _ in range(400):
        still.q = still.q + 1e-3
        assert isinstance(still.tick(), Wait)
    assert still.operation.phase == "tare"


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
