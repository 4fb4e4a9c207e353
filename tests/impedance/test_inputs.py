"""Inputs of a pull that are late, missing or implausible, fed by hand to an arm that stands where it is told."""

from __future__ import annotations

import numpy as np
import pytest
from impedance.gentle import LIMITS, TASK
from impedance.toy import PANDA, PERIOD, READY, Belief, drawer

from modcal_core.geometry.so3 import Array
from modcal_core.impedance.operation import Operation
from modcal_core.impedance.safety_monitor import ArmSetpoint
from modcal_core.impedance.task import JointPositions, Stop, Wait
from modcal_core.impedance.wrench import WrenchSensor
from modcal_core.robots.kinematics import chain_forward

pytestmark = pytest.mark.slow


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
        out = self.operation.tick(self.now, chain_forward(PANDA, self.q), self.sensor, joints, self.belief)
        if isinstance(out, ArmSetpoint):
            self.q = out.q
        return out

    def until(self, phase: str) -> None:
        for _ in range(2000):
            self.tick()
            if self.operation.phase == phase:
                return
        raise AssertionError(self.operation.phase)


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
    before = chain_forward(PANDA, still.q)[:3, 3]
    lost = [still.tick(joints_age=0.5) for _ in range(int(2.0 / PERIOD))]
    assert all(isinstance(out, Wait) for out in lost)
    outs = [still.tick() for _ in range(300)]
    sent = [out for out in outs if isinstance(out, ArmSetpoint)]
    assert sent
    assert {s.why for s in sent} == {"release"}
    assert np.linalg.norm([s.pose[:3, 3] - before for s in sent], axis=1).max() < 1e-3
    assert isinstance(outs[-1], Stop)
    assert "joint_states" in outs[-1].why


def test_a_release_that_is_interrupted_is_finished() -> None:
    """Joint states pause in the middle of it: the rest of its time, and the same word, are still to come."""
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    for _ in range(400):
        still.tick()
    still.operation.release("stopped as asked", still.now)
    sent = [still.tick() for _ in range(25)]
    assert {out.why for out in sent if isinstance(out, ArmSetpoint)} == {"release"}
    lost = [still.tick(joints_age=0.5) for _ in range(int(2.0 / PERIOD))]
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
        still.belief.model, still.belief.trusted = drawer(chain_forward(PANDA, still.q)), True
        still.until("follow")
    for _ in range(int(1.5 / PERIOD)):
        assert isinstance(still.tick(), ArmSetpoint)
    still.belief.late = True  # its heartbeat: the hand stands, and nothing is let go of yet
    assert all(isinstance(still.tick(), ArmSetpoint) for _ in range(int(0.5 / PERIOD)))
    assert (still.operation.phase, still.operation.governor.speed) == (phase, 0.0)
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


def test_a_blow_ends_it_and_is_not_given_way_to_further_than_it_moves_the_tool() -> None:
    """What is felt, but moves nothing, may be the sensor's fault: the tool stands where it is, and that is the end."""
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    for _ in range(200):
        still.tick()
    before = chain_forward(PANDA, still.q)
    outs = [still.tick(np.array([0, 200.0, 0, 0, 0, 0])) for _ in range(200)]
    assert still.operation.phase == "release"
    assert isinstance(outs[-1], Stop)
    assert "force" in outs[-1].why
    assert "50 N is the limit" in outs[-1].why
    assert np.linalg.norm(chain_forward(PANDA, still.q)[:3, 3] - before[:3, 3]) < 1e-3


def test_a_clock_that_goes_back_ends_it() -> None:
    still = Still(Operation(PANDA, TASK, LIMITS))
    still.until("explore")
    still.tick()
    still.now -= 5.0
    still.sensor.reset()
    assert isinstance(still.tick(), Stop)
