"""A force that no sensor tells is found, whichever way the stack is stiff; sound sensors and late ones are believed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, READY

from modcal_core.geometry.so3 import Array
from modcal_core.impedance.observer import Observer, Repetition
from modcal_core.impedance.speed_governor import GovernorSettings, SpeedGovernor
from modcal_core.impedance.task import ImpedanceTask, JointPositions
from modcal_core.robots.kinematics import pose_and_jacobian

pytestmark = pytest.mark.slow

LAG = 0.025  # s; 0.03 is stated
MAX = 50.0  # N
SUBSTEPS = 2
JOINTS = 1.0 / np.array([4000.0] * 4 + [1000.0] * 3)  # rad/N m
AXES = 1.0 / np.array([20e3] * 3 + [600.0] * 3)  # m/N, rad/N m
BACK = np.array([-1.0, 0.0, 0.0])
UNKNOWN = np.full(7, np.nan)


@dataclass
class Arm:
    """Servos that lag and yield, and a handle that is dragged along −x with dry friction and a spring, up to a jam.

    stack: whether the joints' servos yield, or the tool in its axes. jam: where it jams [m]. stiffer: times that the
    servos are. grasp: stiffness of the fingers [N/m].
    """

    stack: str = "joints"
    jam: float = 0.15
    stiffer: float = 1.0
    grasp: float = 20e3
    seed: int = 0
    wrench: Array = field(default_factory=lambda: np.zeros(6))  # on the tool, in its axes

    def __post_init__(self) -> None:
        self.q, self.compliance, self.axes = READY.copy(), JOINTS / self.stiffer, AXES / self.stiffer
        self.x0 = pose_and_jacobian(PANDA, self.q)[0][:3, 3]
        self._rng, self.way = np.random.default_rng(self.seed), 0.0

    def follow(self, reference: Array) -> None:
        """One period."""
        h = PERIOD / SUBSTEPS
        for _ in range(SUBSTEPS):
            T, J = pose_and_jacobian(PANDA, self.q)
            self.way = float(BACK @ (T[:3, 3] - self.x0))
            drag = 5.0 * min(1.0, max(self.way, 0.0) / 1e-3) + 15.0 * self.way
            held = (drag if self.jam > 0.0 else 0.0) + self.grasp * max(self.way - self.jam, 0.0)
            self.wrench = np.concatenate([T[:3, :3].T @ (-held * BACK), np.zeros(3)])
            lead = reference - self.q
            if self.stack == "joints":
                self.q = self.q + h / LAG * (lead + self.compliance * (J.T @ self.wrench))
            else:
                self.q = self.q + h / LAG * (J.T @ np.linalg.solve(J @ J.T, J @ lead + self.axes * self.wrench))

    def encoders(self) -> Array:
        return self.q + self._rng.normal(0.0, 1e-5, len(self.q))


class Soft(Arm):
    """One servo's compliance is not that of the others, and changes with the force, as a gear's does."""

    def follow(self, reference: Array) -> None:
        self.compliance[1] = 3.0 * JOINTS[1] / (1.0 + np.linalg.norm(self.wrench[:3]) / 10.0)
        super().follow(reference)


def pulled(
    arm: Arm,
    frozen: float = math.inf,
    share: float = 1.0,
    least: Array = UNKNOWN,
    late: float = 0.0,
    speed: float = 0.03,
    slows: bool = True,
) -> tuple[float, float, str]:
    """(true force [N] at which it is let go, or the last one; largest that is hidden [N]; why).

    frozen: way [m] from which the sensor says the same, with its noise. share: of every force that it tells. late:
    references and readings may come late by [s]. slows: whether the setpoint slows down for what is felt and hidden.
    """
    rng, task = np.random.default_rng(1), ImpedanceTask()
    observer, governor, said = Observer(task, PERIOD, least), SpeedGovernor(GovernorSettings()), np.zeros(6)
    reference, held, hidden, now = READY.copy(), None, [0.0], 0.0
    sent: list[tuple[float, Array]] = []
    refused = None
    while refused is None and now < 60.0 and np.linalg.norm(said[:3]) < 1.2 * MAX + 1.0 and arm.way < 0.3:
        now += PERIOD
        T, J = pose_and_jacobian(PANDA, reference)
        size = float(np.linalg.norm(said[:3])) + observer.hidden if slows else 0.0
        pace = governor.step(speed, math.inf, np.array([size, 0.0, 0.0, 0.0, 0.0, 0.0]), PERIOD) / PERIOD
        twist = np.concatenate([T[:3, :3].T @ (pace * BACK), np.zeros(3)])
        reference = reference + PERIOD * (J.T @ np.linalg.solve(J @ J.T, twist))
        sent.append((now + rng.uniform(0.0, late), reference))
        observer.sent(reference, pose_and_jacobian(PANDA, reference)[0][:3, 3], now)
        arm.follow(next(r for t, r in reversed(sent) if t <= now or r is sent[0][1]))
        if arm.way >= frozen and held is None:
            held = arm.wrench.copy()
        said = share * (arm.wrench if held is None else held) + rng.normal(0.0, [0.1] * 3 + [0.005] * 3)
        observer.hear(said, now)
        observer.take(JointPositions(arm.encoders(), now), now + rng.uniform(0.0, late), said, J, MAX)
        if np.linalg.norm(said[:3]) <= 0.95 * MAX:  # beyond which no pull goes on
            hidden.append(observer.hidden)
        refused = observer.refused(float(np.linalg.norm(said[:3])), 0.0, now, MAX)
    return float(np.linalg.norm(arm.wrench[:3])), max(hidden), str(refused or "")


@pytest.mark.parametrize(
    ("stiffer", "fingers", "speed"), [(0.4, 20e3, 0.03), (1.0, 20e3, 0.03), (1.0, 3e3, 0.03), (4.0, 3e3, 0.03)]
)
@pytest.mark.parametrize("stack", ["joints", "axes"])
def test_a_sensor_that_freezes_before_a_jam_is_found_out_below_the_limit(
    stack: str, stiffer: float, fingers: float, speed: float
) -> None:
    """On stiff servos as well, whose leads hardly grow, with fingers that go on for centimetres."""
    force, hidden, why = pulled(Arm(stack, stiffer=stiffer, grasp=fingers), frozen=0.148, speed=speed)
    assert force < 1.2 * MAX
    assert hidden > 0.3 * MAX
    assert "leads the tool" in why


@pytest.mark.parametrize("stiffer", [0.4, 1.0, 7.5])
@pytest.mark.parametrize(("stack", "late"), [("joints", 0.0), ("joints", 0.02), ("axes", 0.0)])
def test_a_sensor_that_follows_hides_nothing(stack: str, late: float, stiffer: float) -> None:
    """Up to a force beyond what is stated, in a jam at full speed, with messages that come late at random: these slow
    the pull down for a moment.
    """
    force, hidden, why = pulled(Arm(stack, stiffer=stiffer), late=late, slows=False)
    assert force > 1.2 * MAX
    assert hidden < (0.7 if late else 0.2) * MAX
    assert not why


def test_a_servo_that_yields_more_than_its_twin_is_no_hidden_force() -> None:
    force, hidden, why = pulled(Soft(), slows=False)
    assert force > 1.2 * MAX
    assert hidden < 0.2 * MAX
    assert not why


@pytest.mark.parametrize("stiffer", [0.4, 1.0])
@pytest.mark.parametrize(("jam", "speed"), [(0.0, 7e-3), (0.15, 0.03)])
def test_a_sensor_that_tells_nothing_is_found_out(jam: float, speed: float, stiffer: float) -> None:
    """At what is locked, and at what jams on its way."""
    force, _, why = pulled(Arm(jam=jam, stiffer=stiffer), share=0.0, speed=speed)
    assert force < 1.2 * MAX
    assert why


@pytest.mark.parametrize("share", [0.1, 0.2])
@pytest.mark.parametrize(("jam", "speed"), [(0.0, 7e-3), (0.15, 0.03)])
def test_a_sensor_that_tells_a_part_is_found_out_where_the_softest_is_known(
    jam: float, speed: float, share: float
) -> None:
    force, _, why = pulled(Arm(jam=jam), share=share, least=1.0 / JOINTS / 1.5, speed=speed)
    assert force < 1.2 * MAX
    assert why


@pytest.mark.parametrize("softer", [0.67, 1.0, 3.0])
def test_a_sensor_that_tells_all_is_believed_up_to_half_beyond_what_is_stated_of_servos(softer: float) -> None:
    force, hidden, why = pulled(Arm(), least=1.0 / JOINTS / softer, slows=False)
    assert force > 1.2 * MAX
    assert hidden < 0.4 * MAX
    assert not why


@pytest.mark.parametrize("gather", [0.15, 2.0])
def test_servos_that_follow_by_a_delay_hide_nothing_as_they_set_off_and_brake(gather: float) -> None:
    """They stand while the reference has gone on, and go on while it stands."""
    observer, delay = Observer(ImpedanceTask(), PERIOD, 1.0 / JOINTS / 1.8), round(0.03 / PERIOD)
    J = pose_and_jacobian(PANDA, READY)[1]
    way = np.linalg.pinv(J) @ np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    sent, speed = [READY] * (1 + delay), 0.0
    for k in range(1, 500):
        now = k * PERIOD
        aim = 0.06 if now % 0.8 < 0.4 else 0.0
        speed += float(np.clip(aim - speed, -2.0 * PERIOD, gather * PERIOD))
        sent.append(sent[-1] + way * (speed * PERIOD))
        observer.sent(sent[-1], np.zeros(3), now)
        observer.take(JointPositions(sent[-1 - delay], now), now, np.zeros(6), J, MAX)
        assert observer.refused(0.0, 0.0, now, MAX) is None


def test_a_sensor_that_repeats_itself_longer_than_ever_is_stuck() -> None:
    """Sent twice each: that is how this driver is. Then it says the same for a tenth of a second."""
    repetition, rng = Repetition(), np.random.default_rng(0)
    readings = [r for _ in range(150) for r in 2 * [rng.normal(0.0, 0.2, 6)]]
    for k, raw in enumerate(readings + [readings[-1]] * 30):
        assert not repetition.stuck or k > len(readings) + 20
        repetition.hear(raw, PERIOD * k)
        repetition.moved(1e-4)
    assert repetition.stuck


def test_a_coarse_sensor_on_an_arm_that_stands_is_not_stuck() -> None:
    """It says whole newtons, and something new at each as the arm shakes while it moves; then the arm stands."""
    repetition, rng = Repetition(), np.random.default_rng(0)
    for k in range(2000):
        repetition.hear(np.round(3.0 + rng.normal(0.0, 2.0 if k < 1000 else 0.01, 6)), PERIOD * k)
        repetition.moved(1e-4 if k < 1000 else 0.0)
        assert not repetition.stuck


def test_what_is_felt_while_the_tool_stands_tells_nothing() -> None:
    """In a jam any sensor tells something in the end, and fingers yield by some millimetres."""
    jam, free = (Observer(ImpedanceTask(), PERIOD, UNKNOWN) for _ in range(2))
    for observer, way in ((jam, 2.5e-3), (free, 4e-3)):
        for at in np.linspace(0.0, way, 20):
            observer.note(12.0, float(at))
    assert not jam.told
    assert free.told
    assert jam.speed(0.1, False, MAX) < free.speed(0.1, False, MAX) == ImpedanceTask().exploration_speed
    assert jam.speed(0.1, True, MAX) < free.speed(0.1, True, MAX) == ImpedanceTask().speed
