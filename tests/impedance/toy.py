"""A small world to pull in: a servo that is stiff and late, welded to a handle that has mass, friction and a spring.

It knows the chain's kinematics, and of the object only its twist; what is pulled and what pulls meet in a stiff spring.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from modcal_core.articulation.joints import JointModel
from modcal_core.articulation.models.registry import axis_model
from modcal_core.geometry.single import along_screw, pose_error
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.operation import Operation
from modcal_core.impedance.safety_monitor import ArmSetpoint, Limits
from modcal_core.impedance.task import JointPositions, Stop
from modcal_core.impedance.wrench import WrenchSensor
from modcal_core.robots.kinematics import chain_forward, pose_and_jacobian
from modcal_core.robots.urdf import read_chain

ROOT = Path(__file__).resolve().parents[2]
PANDA = read_chain((ROOT / "examples" / "robots" / "panda.urdf").read_text(), "panda_link0", "panda_hand_tcp")
READY = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.7, 0.785])
T_READY = chain_forward(PANDA, READY)
PERIOD = 0.004
_SUBSTEPS = 2
_SERVO = np.array([1e4] * 3 + [600.0] * 3)  # N/m, N m/rad
_SLACK = np.array([60.0] * 3 + [4.0] * 3)  # N s/m, N m s/rad
_LAG = 0.03  # s


def limits(**other: object) -> Limits:
    return replace(Limits(np.full(7, 1.5), np.full(7, 15.0)), **other)  # type: ignore[arg-type]


def door(radius: float = 0.4, side: float = 1.0, T: Array = T_READY) -> JointModel:
    """A door whose handle is at T, hinged about the vertical; it opens towards −x of the base."""
    hinge = T[:3, 3] + np.array([0.0, side * radius, 0.0])
    # towards −x: v = ω × (handle − hinge) = ω × (0, −side r, 0), so ω along −side z gives v along −x
    return axis_model("revolute").joint(T, np.array([0.0, 0.0, -side]), hinge - hinge[2] * np.array([0.0, 0.0, 1.0]))


def drawer(T: Array = T_READY) -> JointModel:
    return axis_model("prismatic").joint(T, np.array([-1.0, 0.0, 0.0]), np.zeros(3))


@dataclass
class Belief:
    model: JointModel | None = None
    trusted: bool = False
    event: str | None = None
    late: bool = False
    silent: bool = False


@dataclass
class Toy:
    """The object at configuration a [rad or m], with its own speed; the servo at joints q."""

    truth: JointModel
    friction: float = 1.0  # N m or N
    spring: float = 2.0  # a rad or m
    inertia: float = 1.0
    damping: float = 0.5
    last: float = 2.0
    locked: bool = False
    servo_lag: float = _LAG
    stiffness: Array = field(default_factory=lambda: _SERVO)
    delay: int = 2  # periods until a reading is heard
    noise: float = 0.3  # N
    weight: Array = field(default_factory=lambda: np.array([0.3, -0.2, 12.0, 0.1, 0.2, 0.0]))
    seed: int = 0

    def __post_init__(self) -> None:
        self.a, self.speed = 0.0, 0.0
        self.command = READY.copy()
        self.q = READY.copy()
        self.contact, self.peak = np.zeros(6), 0.0
        self._rng = np.random.default_rng(self.seed)
        self.handle = self.truth.pose(0.0)
        self._e, self._missing = np.zeros(6), np.zeros(6)
        self._twist = self.truth.twist()

    def step(self) -> None:
        """One period."""
        h = PERIOD / _SUBSTEPS
        for _ in range(_SUBSTEPS):
            self.q = self.q + (self.command - self.q) * (h / (self.servo_lag + h))
            S = chain_forward(PANDA, self.q)
            # from where the servo would have the tool to where it is, seen from the tool
            e = pose_error(S, self.handle)
            self._missing = e
            rate = (e - self._e) / h
            self._e = e
            wrench = -(self.stiffness * e + _SLACK * rate)  # on the handle, of the tool, seen from the tool: pulls back
            v, w = self._twist[:3], self._twist[3:]
            R = self.handle[:3, :3]
            f, x = R @ wrench[:3], self.handle[:3, 3]
            moment = np.array([x[1] * f[2] - x[2] * f[1], x[2] * f[0] - x[0] * f[2], x[0] * f[1] - x[1] * f[0]])
            pull = float(v @ f + w @ (moment + R @ wrench[3:]))
            if self.locked:
                self.speed = 0.0
            else:
                free = self.speed + h * (pull - self.spring * self.a - self.damping * self.speed) / self.inertia
                stick = h * self.friction / self.inertia
                self.speed = float(np.sign(free) * max(abs(free) - stick, 0.0))
            self.a += h * self.speed
            if not 0.0 <= self.a <= self.last:
                self.a, self.speed = min(max(self.a, 0.0), self.last), 0.0
            self.handle = along_screw(self.truth.start, self._twist * self.a)
            self.contact = -wrench  # on the tool
            self.peak = max(self.peak, float(np.linalg.norm(wrench[:3])))

    def reading(self) -> tuple[Array, Array]:
        """(joint positions, raw wrench of the sensor) of now: encoders see where the weld holds the tool."""
        J = pose_and_jacobian(PANDA, self.q)[1]
        q = self.q + J.T @ np.linalg.solve(J @ J.T, self._missing)
        w = self.contact + self.weight + self.noise * np.r_[np.ones(3), 0.02 * np.ones(3)] * self._rng.normal(size=6)
        return q, w


@dataclass
class Pulled:
    """What came of it. forces (m,), moments (m,) of the contact; setpoints; the last word."""

    stop: Stop | None
    forces: Array
    moments: Array
    setpoints: list[tuple[float, ArmSetpoint]]
    phases: list[str]
    opened: float


def pull(
    toy: Toy,
    operation: Operation,
    trusts: float = 0.14,
    model: JointModel | None = None,
    seconds: float = 40.0,
    revise: float = 0.0,
    rng: np.random.Generator | None = None,
    numb: float = np.inf,
    stuck: float = np.inf,
    deaf: float = 0.0,
    meanwhile: Callable[[float, Operation], None] = lambda now, operation: None,
) -> Pulled:
    """Pull until it says stop. trusts: configuration from which the model (default: the truth) is trusted.

    numb: force in the hand [N] from which nothing is heard of the wrench any more. stuck: force from which the sensor says
    the same for ever, with fresh stamps. deaf: share of the contact's force that it never says. meanwhile: is called before each tick. revise: deviation of the point and the axis of the model, anew five times a second [m, rad].
    """
    sensor, belief = WrenchSensor([(PANDA.tip, np.eye(4))]), Belief()
    forces, moments, setpoints, phases = [], [], [], []
    late: deque[tuple[float, Array, Array]] = deque()
    stop, last = None, None
    given = toy.truth if model is None else model
    for k in range(int(seconds / PERIOD)):
        now = 100.0 + k * PERIOD
        q, w = toy.reading()
        late.append((now, q, w - deaf * toy.contact))
        if len(late) <= toy.delay:
            toy.step()
            continue
        stamp, q, w = late.popleft()
        last = w if toy.peak < stuck or last is None else last
        w = last
        if toy.peak < numb:
            sensor.receive(PANDA.tip, w, stamp, now, 0.1)
        if toy.a >= trusts:
            belief.trusted = True
            if belief.model is None or (revise and rng is not None and k % 50 == 0):
                belief.model = _revised(given, revise, rng) if revise and rng is not None else given
        meanwhile(now, operation)
        answer = operation.tick(now, chain_forward(PANDA, q), sensor, JointPositions(q, stamp), belief)
        phases.append(operation.phase)
        if isinstance(answer, Stop):
            stop = answer
            break
        if isinstance(answer, ArmSetpoint):
            setpoints.append((now, answer))
            toy.command = answer.q
        toy.step()
        forces.append(float(np.linalg.norm(toy.contact[:3])))
        moments.append(float(np.linalg.norm(toy.contact[3:])))
    return Pulled(stop, np.array(forces), np.array(moments), setpoints, phases, toy.a)


def _revised(model: JointModel, size: float, rng: np.random.Generator) -> JointModel:
    axis = model.axis + size * rng.normal(size=3)
    point = model.point + size * rng.normal(size=3) if model.turns else model.point
    return axis_model(model.kind).joint(model.start, axis / np.linalg.norm(axis), point)
