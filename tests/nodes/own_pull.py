"""modcal's own pull in one process: estimator and operation of the core beside the physics, with no nodes between.

The nodes' rates and parameters, but none of the delays of DDS: what a pull owes to the method, and not to its transport.
Unless they are asked for (``late``): then messages wait in queues, as on a busy machine.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from nodes.plain_pulls import Pull

from modcal_core.articulation.online import Tracker
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.joint_force import FreeMotion
from modcal_core.impedance.operation import Operation
from modcal_core.impedance.safety_monitor import ArmSetpoint
from modcal_core.impedance.task import JointPositions, Stop
from modcal_core.impedance.wrench import Load
from modcal_core.robots.kinematics import chain_forward
from modcal_nodes.ros.parameters import ARTICULATION_ESTIMATOR, IMPEDANCE_SETPOINT
from modcal_nodes.setpoint import JointEfforts, JointSoftness, SensedArm, limits, task
from modcal_nodes.simulation.pulling import Pulling

_EVERY = round(IMPEDANCE_SETPOINT["rate_hz"].default / ARTICULATION_ESTIMATOR["rate_hz"].default)
_LONGEST = 60.0  # s
_STALE = 0.1  # s
_STALLS = 0.3  # times a second the process of the pull stands still for some of the mean delays
_STALL = 3.0  # of them


class Queue:
    """Messages on their way, in order, each late by an exponential time of this mean [s]."""

    def __init__(self, late: float, rng: np.random.Generator) -> None:
        self._late, self._rng, self._due = late, rng, -np.inf
        self._waiting: deque[tuple[float, Any]] = deque()

    def send(self, message: Any, now: float) -> None:
        self._due = max(self._due, now + (self._rng.exponential(self._late) if self._late else 0.0))
        self._waiting.append((self._due, message))

    def newest(self, now: float) -> Any:
        """The newest that has come by now [s]; None for no new one."""
        message = None
        while self._waiting and self._waiting[0][0] <= now + 1e-9:
            message = self._waiting.popleft()[1]
        return message


def pull(
    world: Pulling,
    urdf: str,
    sensed: Callable[[Array], Array] = lambda w: w,
    late: float = 0.0,
    efforts: Callable[[], Array] | None = None,
    **other: object,
) -> Pull:
    """Pull with the nodes' default parameters, or others, until it says that it is over.

    sensed: what the force sensor makes of the wrench (6,) at its place. late: mean delay of joint states, wrenches and
    references, each on its own way [s]. efforts: what joint states report of them, if they do.
    """
    chosen = {name: parameter.default for name, parameter in IMPEDANCE_SETPOINT.items()} | other
    arm = SensedArm.of(urdf, chosen)
    arm.sensor.load = Load(world.scene.tool_mass, world.scene.tool_com)
    softest = JointSoftness.of(urdf, arm.chain, chosen["max_joint_lead_rad"]).least
    motion = FreeMotion()
    while world.moves_freely:  # as the node hears before anybody asks for a pull
        world.advance(1.0 / IMPEDANCE_SETPOINT["rate_hz"].default)
        q = world.joints()[0]
        arm.sensor.receive(arm.chain.tip, sensed(world.wrench()), world.time, world.time, _STALE)
        motion.sensor.take(arm.sensor.raw, chain_forward(arm.chain, q)[:3, :3])
        if efforts is not None:
            motion.take(JointPositions(q, world.time, efforts()))
    operation = Operation(
        arm.chain, task(chosen), limits(arm.chain, chosen), softest, JointEfforts.of(urdf, arm.chain).arm, motion
    )
    tracker, state = Tracker(), None
    period, opened, begun = operation.limits.period, 0.0, False
    rng = np.random.default_rng(0)
    states, wrenches, references = (Queue(late, rng) for _ in range(3))
    heard, answer, stalled = None, None, -np.inf
    for k in range(1, round(_LONGEST / period)):
        world.advance(period)
        now = world.time
        if (q := references.newest(now)) is not None:
            world.refer(q)
        states.send((world.joints()[0], now, None if efforts is None else efforts()), now)
        wrenches.send((sensed(world.wrench()), now), now)
        opened = max(opened, world.opened)
        if late and rng.random() < _STALLS * period:
            stalled = now + rng.exponential(_STALL * late)
        if now < stalled:
            continue
        heard = states.newest(now) or heard
        if (felt := wrenches.newest(now)) is not None and now - felt[1] <= _STALE:
            arm.sensor.receive(arm.chain.tip, felt[0], felt[1], now, _STALE)
        if heard is None:
            continue
        q, stamp, effort = heard
        T = chain_forward(arm.chain, q)
        if k % _EVERY == 0 or state is None:
            pulled = float(np.linalg.norm(operation.force[:3])) > ARTICULATION_ESTIMATOR["pull_n"].default
            state = tracker.update(T[:3, 3], T[:3, :3], stamp, pulled)
        answer = operation.tick(now, T, arm.sensor, JointPositions(q, stamp, effort), state)
        if isinstance(answer, Stop):
            break
        if isinstance(answer, ArmSetpoint):
            if not begun:
                world.forget()  # while the tool is tared nothing pulls
            begun = True
            references.send(answer.q, now)
            if not late and (q := references.newest(now)) is not None:
                world.refer(q)
    said = answer.why if isinstance(answer, Stop) else f"no end within {_LONGEST:g} s"
    return Pull(float(np.linalg.norm(world.peak()[:3])), world.mean(), opened, world.scene.goal, said)
