"""The guard: whatever is thrown at it, what it lets through is finite, fresh and within every limit."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, READY, T_READY, limits

from modcal_core.errors import BadCommand
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.safety_monitor import ArmSetpoint, LateInput, SafetyMonitor, SensorReadings
from modcal_core.robots.kinematics import body_jacobian, chain_forward

LIMITS = limits(speed=0.25, acceleration=2.5)
ATTEMPTS = 8_000  # bench/control_tick.py makes a hundred thousand
_STEPS = (PERIOD, PERIOD, PERIOD, 0.5 * PERIOD, 2.0 * PERIOD, 0.3)
_PARTS = ("pose", "q", "velocity", "wrench", "stiffness", "frame", "names", "T", "F", "joints", "stamp", "now")
NASTY = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e12, 1e-300, 0.0, -0.0, 4e-323)


def setpoint(q: Array, velocity: Array | None = None) -> ArmSetpoint:
    speed = np.zeros(7) if velocity is None else velocity
    return ArmSetpoint(
        PANDA.base, PANDA.names, chain_forward(PANDA, q), q, speed, np.zeros(6), np.array([900.0] * 3 + [50.0] * 3)
    )


def sensors(now: float, q: Array = READY) -> SensorReadings:
    joints = dict(zip(PANDA.names, q.tolist(), strict=True))
    return SensorReadings(
        joints, now - 0.004, chain_forward(PANDA, q), np.array([5.0, 0, 0, 0, 1.0, 0]), PANDA.tip, now - 0.002
    )


def opened(now: float = 10.0) -> SafetyMonitor:
    guard = SafetyMonitor(PANDA, LIMITS)
    guard.open(T_READY, READY, now)
    return guard


def test_what_is_good_goes_through_as_it_is() -> None:
    guard, q, v = opened(), READY.copy(), 0.0
    for k in range(1, 200):
        now = 10.0 + k * PERIOD
        v = min(v + 5.0 * PERIOD, 0.1)
        q = q + np.array([v * PERIOD, 0, 0, 0, 0, 0, v * PERIOD])
        sent = setpoint(q)
        assert guard.check(sent, sensors(now, q), now) is sent


def _late(part: str, seconds: float) -> Callable[[SensorReadings], SensorReadings]:
    return lambda h: replace(h, **{part: getattr(h, part) + seconds})


BAD: dict[str, tuple[Callable[[ArmSetpoint], ArmSetpoint], Callable[[SensorReadings], SensorReadings], str]] = {
    "NaN joint": (lambda w: replace(w, q=w.q * np.nan), lambda h: h, "finite"),
    "NaN pose": (lambda w: replace(w, pose=w.pose * np.nan), lambda h: h, "finite"),
    "other frame": (lambda w: replace(w, frame="map"), lambda h: h, "frame 'map'"),
    "other joints": (lambda w: replace(w, names=w.names[::-1]), lambda h: h, "different joints"),
    "fewer joints": (lambda w: replace(w, q=w.q[:6]), lambda h: h, "finite numbers"),
    "no rotation": (lambda w: replace(w, pose=w.pose @ np.diag([1, 1, -1, 1])), lambda h: h, "not a rotation"),
    "scaled": (lambda w: replace(w, pose=w.pose @ np.diag([1, 1, 1.01, 1])), lambda h: h, "not a rotation"),
    "far joint": (lambda w: replace(w, q=w.q + 0.1), lambda h: h, "limit"),
    "beyond a limit": (lambda w: replace(w, q=w.q * 0 + 5.0), lambda h: h, "outside"),
    "fast joint speed": (lambda w: replace(w, velocity=w.q * 0 + 9.0), lambda h: h, "named speed"),
    "pose apart from joints": (lambda w: replace(w, pose=se3.transform(p=[0.03, 0, 0]) @ w.pose), lambda h: h, "limit"),
    "stiffer than allowed": (lambda w: replace(w, stiffness=w.stiffness * 10), lambda h: h, "stiffness"),
    "negative stiffness": (lambda w: replace(w, stiffness=-w.stiffness), lambda h: h, "stiffness"),
    "wrench too large": (lambda w: replace(w, wrench=w.wrench + 60.0), lambda h: h, "wrench"),
    "too much force": (lambda w: w, lambda h: replace(h, wrench=np.array([0, 60.0, 0, 0, 0, 0])), "60.0 N"),
    "too much moment": (lambda w: w, lambda h: replace(h, wrench=np.array([0, 0, 0, 0, 30.0, 0])), "30.0 N m"),
    "NaN force": (lambda w: w, lambda h: replace(h, wrench=h.wrench * np.nan), "finite"),
    "wrench elsewhere": (lambda w: w, lambda h: replace(h, wrench_frame="camera"), "frame 'camera'"),
    "a joint unheard": (lambda w: w, lambda h: replace(h, joints={}), "missing"),
    "tool elsewhere": (
        lambda w: w, lambda h: replace(h, T_base_tool=se3.transform(p=[0.2, 0, 0]) @ h.T_base_tool), "distance"
    ),
    "tool turned": (
        lambda w: w, lambda h: replace(h, T_base_tool=h.T_base_tool @ se3.transform(so3.exp([1, 0, 0]))), "turn"
    ),
    "old joints": (lambda w: w, _late("joints_stamp", -0.2), "joint_states"),
    "joints of the future": (lambda w: w, _late("joints_stamp", 0.2), "joint_states"),
    "old wrench": (lambda w: w, _late("wrench_stamp", -0.2), "wrench"),
    "wrench without a time": (lambda w: w, _late("wrench_stamp", math.nan), "stamp"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_is_bad_does_not_and_the_guard_shuts(name: str) -> None:
    spoil_wish, spoil_heard, said = BAD[name]
    guard = opened()
    with pytest.raises(BadCommand, match=said) as refused:
        guard.check(spoil_wish(setpoint(READY)), spoil_heard(sensors(10.004)), 10.004)
    late = isinstance(refused.value, LateInput)
    assert late == (name in ("old joints", "joints of the future", "old wrench"))
    if late:  # only late: it goes on
        guard.check(setpoint(READY), sensors(10.008), 10.008)
    else:
        with pytest.raises(BadCommand, match="tripped"):
            guard.check(setpoint(READY), sensors(10.008), 10.008)
        guard.open(T_READY, READY, 10.012)
        guard.check(setpoint(READY), sensors(10.016), 10.016)


def test_speed_and_acceleration_of_the_tool() -> None:
    """Just within goes, just beyond does not; a pause is a stop, after which one step is all that is allowed."""
    step = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    most = LIMITS.angular_acceleration * PERIOD**2
    J = body_jacobian(PANDA, READY[None])[0] @ step
    assert np.linalg.norm(J[3:]) == pytest.approx(1.0)
    for share, passes in ((0.99, True), (1.01, False)):
        for pause in (PERIOD, 0.5):
            guard, now = opened(), 10.0 + pause
            q = READY + share * most * step
            if passes:
                guard.check(setpoint(q), sensors(now), now)
            else:
                with pytest.raises(BadCommand, match="acceleration"):
                    guard.check(setpoint(q), sensors(now), now)


def test_a_singular_posture_does_not_pass() -> None:
    """Whatever is asked of the least gain, by the singular values of the Jacobian."""
    stretched = np.array([0.0, 0.3, 0.0, -0.3, 0.0, 1.9, 0.785])
    least = float(np.linalg.svd(body_jacobian(PANDA, stretched[None])[0], compute_uv=False).min())
    for share in (0.99, 1.01):
        guard = SafetyMonitor(PANDA, limits(gain=share * least))
        guard.open(chain_forward(PANDA, stretched), stretched, 10.0)
        with contextlib.nullcontext() if share < 1.0 else pytest.raises(BadCommand, match="singular"):
            guard.check(setpoint(stretched), sensors(10.004, stretched), 10.004)


def test_beyond_the_limit_of_force_only_what_goes_back_to_the_tool_passes() -> None:
    """Once it was said that the tool is let go, for a second; of the same steps, one away from the tool shuts it."""
    step = 1e-4 * np.array([0, 0, 0, 0, 0, 0.3, 1.0])
    pressed = np.array([0, 90.0, 0, 0, 0, 0])
    for side, passes in ((1.0, True), (-1.0, False)):
        guard, tool = opened(), READY + 40.0 * side * step  # which lies on one side of where the arm was told to be

        def said(now: float, tool: Array = tool) -> SensorReadings:
            return replace(sensors(now, tool), wrench=pressed)

        guard.allow_release(10.0)
        with contextlib.nullcontext() if passes else pytest.raises(BadCommand, match="moves away"):
            guard.check(setpoint(READY + step), said(10.004), 10.004)
        assert bool(guard.tripped) != passes
    guard = opened()
    with pytest.raises(BadCommand, match="90.0 N"):  # nobody has said so
        guard.check(setpoint(READY), replace(sensors(10.004), wrench=pressed), 10.004)
    guard = opened()
    guard.allow_release(10.0)
    guard.check(setpoint(READY), replace(sensors(10.9), wrench=pressed), 10.9)
    with pytest.raises(BadCommand, match="90.0 N"):
        guard.check(setpoint(READY), replace(sensors(11.1), wrench=pressed), 11.1)


def test_while_it_is_let_go_no_wrench_is_needed_but_the_joints_are() -> None:
    nothing = replace(sensors(10.004), wrench=np.full(6, np.nan), wrench_stamp=1.0)
    guard = opened()
    with pytest.raises(BadCommand, match="wrench"):
        guard.check(setpoint(READY), nothing, 10.004)
    guard = opened()
    guard.allow_release(10.0)
    guard.check(setpoint(READY), nothing, 10.004)
    with pytest.raises(BadCommand, match="joint_states"):
        guard.check(setpoint(READY), replace(nothing, joints_stamp=1.0), 10.008)


def test_what_still_moves_away_must_brake() -> None:
    """The limits of acceleration forbid to turn back at once; going on as before is not braking."""
    step = 1e-4 * np.array([0, 0, 0, 0, 0, 0, 1.0])
    tool = READY - 40.0 * step
    for second, passes in ((0.9, False), (0.3, True)):
        guard = opened()
        guard.check(setpoint(READY + step), sensors(10.004, tool), 10.004)
        guard.allow_release(10.004)
        with contextlib.nullcontext() if passes else pytest.raises(BadCommand, match="moves away"):
            guard.check(setpoint(READY + (1.0 + second) * step), sensors(10.008, tool), 10.008)


def test_a_clock_that_goes_back_shuts_it() -> None:
    guard = opened()
    guard.check(setpoint(READY), sensors(10.004), 10.004)
    with pytest.raises(BadCommand, match="moved backwards"):
        guard.check(setpoint(READY), sensors(9.0), 9.0)
    with pytest.raises(BadCommand, match="tripped"):
        guard.check(setpoint(READY), sensors(10.008), 10.008)


@dataclass
class Witness:
    """Sees what comes out and knows the limits, by other ways than the guard."""

    now: float = -math.inf
    q: Array | None = None
    pose: Array | None = None
    velocity: Array | None = None
    joint_velocity: Array | None = None
    count: int = 0

    def restart(self, now: float) -> None:
        self.now, self.q, self.pose = now, READY, T_READY
        self.velocity, self.joint_velocity = np.zeros(3), np.zeros(7)

    def see(self, out: ArmSetpoint, h: SensorReadings, now: float) -> None:
        self.count += 1
        for array in (out.pose, out.q, out.velocity, out.wrench, out.stiffness):
            assert np.isfinite(array).all()
        assert out.frame == PANDA.base
        assert out.names == PANDA.names
        assert now > self.now
        assert abs(now - h.joints_stamp) <= LIMITS.timeout
        assert abs(now - h.wrench_stamp) <= LIMITS.timeout
        assert np.linalg.norm(h.wrench[:3]) <= LIMITS.force
        assert (out.q >= PANDA.lower).all()
        assert (out.q <= PANDA.upper).all()
        assert np.linalg.det(out.pose[:3, :3]) == pytest.approx(1.0, abs=1e-5)
        assert np.abs(chain_forward(PANDA, out.q)[:3, 3] - out.pose[:3, 3]).max() <= LIMITS.consistency
        assert np.linalg.norm(out.pose[:3, 3] - h.T_base_tool[:3, 3]) <= LIMITS.displacement * 1.001
        assert (np.abs(out.stiffness) <= 5000.0).all()
        assert self.q is not None
        dt = now - self.now
        paused = dt > 5.0 * PERIOD
        dt = PERIOD if paused else dt
        velocity, joint_velocity = (out.pose[:3, 3] - self.pose[:3, 3]) / dt, (out.q - self.q) / dt
        then = np.zeros(3) if paused else self.velocity
        assert np.linalg.norm(velocity) <= LIMITS.speed * 1.001
        assert np.linalg.norm(velocity - then) <= LIMITS.acceleration * dt * 1.001
        assert (np.abs(joint_velocity) <= LIMITS.joint_speed * 1.001).all()
        self.now, self.q, self.pose = now, out.q, out.pose
        self.velocity, self.joint_velocity = velocity, joint_velocity


def spoiled(rng: np.random.Generator, array: Array) -> Array:
    out = np.array(array, dtype=float)
    kind = rng.integers(4)
    if kind == 0:
        out.flat[rng.integers(out.size)] = NASTY[rng.integers(len(NASTY))]
    elif kind == 1:
        out.flat[rng.integers(out.size)] += rng.normal() * 10.0 ** rng.uniform(-6, 3)
    elif kind == 2:
        out = out * rng.choice([-1.0, 1000.0, 0.0])
    else:
        out = out.ravel()[: rng.integers(out.size)]
    return out


def attacked(
    rng: np.random.Generator, w: ArmSetpoint, h: SensorReadings, now: float
) -> tuple[ArmSetpoint, SensorReadings, float]:
    """One thing made hostile."""
    part = _PARTS[rng.integers(len(_PARTS))]
    if part in ("pose", "q", "velocity", "wrench", "stiffness"):
        return replace(w, **{part: spoiled(rng, getattr(w, part))}), h, now  # type: ignore[arg-type]
    if part == "frame":
        return replace(w, frame=str(rng.choice(["", "map", PANDA.tip]))), h, now
    if part == "names":
        return replace(w, names=tuple(rng.permutation(PANDA.names)[: rng.integers(8)])), h, now
    if part == "T":
        return w, replace(h, T_base_tool=spoiled(rng, h.T_base_tool)), now
    if part == "F":
        return w, replace(h, wrench=spoiled(rng, h.wrench), wrench_frame=str(rng.choice([PANDA.tip, "x"]))), now
    if part == "joints":
        joints = dict(h.joints)
        name = str(rng.choice(PANDA.names))
        if rng.random() < 0.5:
            joints[name] = NASTY[rng.integers(3)]
        else:
            joints.pop(name)
        return w, replace(h, joints={**joints, "gripper": 0.1}), now
    if part == "stamp":
        which = str(rng.choice(["joints_stamp", "wrench_stamp"]))
        return w, replace(h, **{which: rng.choice([now - 1.0, now + 1.0, *NASTY])}), now
    return w, h, float(rng.choice([now - 1.0, now, *NASTY]))


@pytest.mark.slow
def test_nothing_hostile_ever_gets_through(rng: np.random.Generator) -> None:
    """Most of what is tried is hostile in one way or another; what is good in between goes through."""
    assert fuzz(ATTEMPTS, rng) > ATTEMPTS // 20


def fuzz(attempts: int, rng: np.random.Generator) -> int:
    """How many of so many attempts got through, each of them looked at by a witness."""
    guard, witness = SafetyMonitor(PANDA, LIMITS), Witness()
    now, q, v = 10.0, READY, np.zeros(7)
    guard.open(T_READY, q, now)
    witness.restart(now)
    passed = 0
    w, h = setpoint(q), sensors(now)
    for _ in range(attempts):
        if guard.tripped:
            # reopened where the arm stands, as an honest supervisor would
            now += PERIOD
            q, v = READY, np.zeros(7)
            guard.open(T_READY, q, now)
            witness.restart(now)
            w, h = setpoint(q), sensors(now)
        now += _STEPS[rng.integers(len(_STEPS))]
        if rng.random() < 0.15:
            v = np.clip(v + 0.01 * rng.normal(size=7) - 0.02 * v, -0.05, 0.05)
            q = q + v * PERIOD
            w = setpoint(q, v)
        h = replace(h, joints_stamp=now - 0.01 * rng.random(), wrench_stamp=now - 0.01 * rng.random())
        attack = rng.random() < 0.85
        sent, said, at = attacked(rng, w, h, now) if attack else (w, h, now)
        with contextlib.suppress(BadCommand):
            out = guard.check(sent, said, at)
            witness.see(out, said, at)
            passed += 1
            now, w, q = at, replace(out), out.q
    assert passed == witness.count
    return passed
