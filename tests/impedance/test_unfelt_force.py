"""A force that no sensor tells shows in the servos' leads, whichever way the stack is stiff."""

from __future__ import annotations

import math

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, READY

from modcal_core.geometry.so3 import Array
from modcal_core.impedance.speed_governor import GovernorSettings, SpeedGovernor
from modcal_core.impedance.task import JointPositions
from modcal_core.impedance.unfelt_force import UnfeltForce
from modcal_core.robots.kinematics import pose_and_jacobian

pytestmark = pytest.mark.slow

LAG, STATED_LAG = 0.025, 0.03  # s
MAX = 50.0  # N
SUBSTEPS = 2
GRASP = 20e3  # N/m
JOINTS = 1.0 / np.array([4000.0] * 4 + [1000.0] * 3)  # rad/N m
AXES = 1.0 / np.array([20e3] * 3 + [600.0] * 3)  # m/N, rad/N m
BACK = np.array([-1.0, 0.0, 0.0])


class Arm:
    """Servos that lag and yield, and a handle that is dragged along −x with dry friction and a spring, up to a jam.

    stack: whether the joints' servos yield, or the tool in its axes. jam: where it jams [m].
    """

    def __init__(self, stack: str, jam: float, rng: np.random.Generator) -> None:
        self.stack, self.jam, self._rng = stack, jam, rng
        self.q = READY.copy()
        self.compliance = JOINTS.copy()
        self.x0 = pose_and_jacobian(PANDA, self.q)[0][:3, 3]
        self.wrench = np.zeros(6)  # on the tool, in its axes
        self.way = 0.0  # m

    def follow(self, reference: Array) -> None:
        """One period."""
        h = PERIOD / SUBSTEPS
        for _ in range(SUBSTEPS):
            T, J = pose_and_jacobian(PANDA, self.q)
            self.way = float(BACK @ (T[:3, 3] - self.x0))
            held = self.drag() + GRASP * max(self.way - self.jam, 0.0)
            self.wrench = np.concatenate([T[:3, :3].T @ (-held * BACK), np.zeros(3)])
            lead = reference - self.q
            if self.stack == "joints":
                self.q = self.q + h / LAG * (lead + self.compliance * (J.T @ self.wrench))
            else:
                v = (J @ lead + AXES * self.wrench) / LAG
                self.q = self.q + h * (J.T @ np.linalg.solve(J @ J.T, v))

    def drag(self) -> float:
        """What holds the handle back before the jam [N]."""
        return 5.0 * min(1.0, max(self.way, 0.0) / 1e-3) + 15.0 * self.way

    def encoders(self) -> Array:
        return self.q + self._rng.normal(0.0, 1e-5, len(self.q))


def pulled(
    arm: Arm, follows: bool, speed: float = 0.03, late: float = 0.0, slows: bool = True, share: float = 0.0
) -> tuple[float, float]:
    """(true force [N] at which it is let go, or the last one; largest that is hidden [N]).

    follows: whether the sensor does so to the end; else it says, from 2 mm before the jam, what it said then, with its
    noise, and a share of what comes. late: references and readings may come late by [s]. slows: whether the setpoint
    slows down for what is felt and hidden.
    """
    rng = np.random.default_rng(1)
    check = UnfeltForce(len(READY), STATED_LAG, PERIOD)
    governor, said = SpeedGovernor(GovernorSettings()), np.zeros(6)
    reference, held, hidden = READY.copy(), None, []
    sent: list[tuple[float, Array]] = []
    now = 0.0
    for _ in range(int((arm.jam + 0.02) / speed / PERIOD)):
        now += PERIOD
        T, J = pose_and_jacobian(PANDA, reference)
        size = float(np.linalg.norm(said[:3])) + check.force if slows else 0.0
        pace = governor.step(speed, math.inf, np.array([size, 0.0, 0.0, 0.0, 0.0, 0.0]), PERIOD) / PERIOD
        twist = np.concatenate([T[:3, :3].T @ (pace * BACK), np.zeros(3)])
        reference = reference + PERIOD * (J.T @ np.linalg.solve(J @ J.T, twist))
        sent.append((now + rng.uniform(0.0, late), reference))
        check.sent(reference, now)
        arm.follow(next(r for t, r in reversed(sent) if t <= now or r is sent[0][1]))
        w = arm.wrench
        if not follows and held is None and arm.way > arm.jam - 2e-3:
            held = w.copy()
        said = (w if held is None else held + share * (w - held)) + rng.normal(0.0, [0.1] * 3 + [0.005] * 3)
        stamp = now
        now_heard = now + rng.uniform(0.0, late)
        check.take(JointPositions(arm.encoders(), stamp), now_heard, said, J, MAX)
        hidden.append(check.force)
        if check.refused(said, MAX) is not None or np.linalg.norm(said[:3]) > 1.2 * MAX + 1.0:
            break  # the other is let go for what is felt
    return float(np.linalg.norm(arm.wrench[:3])), max(hidden)


@pytest.mark.parametrize("stack", ["joints", "axes"])
def test_a_sensor_that_freezes_before_a_jam_is_found_out_below_the_limit(stack: str) -> None:
    for seed in range(2):
        force, hidden = pulled(Arm(stack, 0.15, np.random.default_rng(seed)), follows=False)
        assert force < 1.2 * MAX
        assert hidden > 0.3 * MAX


@pytest.mark.parametrize(("stack", "late"), [("joints", 0.02), ("axes", 0.0)])
def test_a_sensor_that_follows_hides_nothing(stack: str, late: float, rng: np.random.Generator) -> None:
    """Up to a force beyond what is stated, in a jam at full speed, with messages that come late at random."""
    force, hidden = pulled(Arm(stack, 0.15, rng), follows=True, late=late, slows=False)
    assert force > 1.2 * MAX
    assert hidden < (0.4 if late else 0.2) * MAX


def test_a_servo_that_yields_more_than_its_twin_is_no_hidden_force(rng: np.random.Generator) -> None:
    """Its compliance is not that of the others, and changes with the force, as a gear's does: no model has that."""

    class Soft(Arm):
        def follow(self, reference: Array) -> None:
            self.compliance[1] = 3.0 * JOINTS[1] / (1.0 + np.linalg.norm(self.wrench[:3]) / 10.0)
            super().follow(reference)

    force, hidden = pulled(Soft("joints", 0.15, rng), follows=True, slows=False)
    assert force > 1.2 * MAX
    assert hidden < 0.2 * MAX
