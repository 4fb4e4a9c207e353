"""modcal's own pull in one process: estimator and operation of the core beside the physics, with no nodes between.

The nodes' rates and parameters, but none of the delays of DDS: what a pull owes to the method, and not to its transport.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from nodes.plain_pulls import Pull

from modcal_core.articulation.online import Tracker
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.operation import Operation
from modcal_core.impedance.safety_monitor import ArmSetpoint
from modcal_core.impedance.task import JointPositions, Stop
from modcal_core.impedance.wrench import Load
from modcal_core.robots.kinematics import forward
from modcal_nodes.ros.parameters import ARTICULATION_ESTIMATOR, IMPEDANCE_SETPOINT
from modcal_nodes.setpoint.arm import SensedArm, limits, task
from modcal_nodes.simulation.pulling import Pulling

_EVERY = round(IMPEDANCE_SETPOINT["rate_hz"].default / ARTICULATION_ESTIMATOR["rate_hz"].default)
_LONGEST = 60.0  # s
_STALE = 0.1  # s


def pull(world: Pulling, urdf: str, sensed: Callable[[Array], Array] = lambda w: w, **other: object) -> Pull:
    """Pull with the nodes' default parameters, or others, until it says that it is over.

    sensed: what the force sensor makes of the wrench (6,) at its place.
    """
    chosen = {name: parameter.default for name, parameter in IMPEDANCE_SETPOINT.items()} | other
    arm = SensedArm.of(urdf, chosen)
    arm.sensor.load = Load(world.scene.tool_mass, world.scene.tool_com)
    operation, tracker, state = Operation(arm.chain, task(chosen), limits(arm.chain, chosen)), Tracker(), None
    period, opened, begun = operation.limits.period, 0.0, False
    for k in range(1, round(_LONGEST / period)):
        world.advance(period)
        now, (q, _) = world.time, world.joints()
        T = forward(arm.chain, q)
        arm.sensor.receive(arm.chain.tip, sensed(world.wrench()), now, now, _STALE)
        if k % _EVERY == 0 or state is None:
            pulled = float(np.linalg.norm(operation.force[:3])) > ARTICULATION_ESTIMATOR["pull_n"].default
            state = tracker.update(T[:3, 3], T[:3, :3], now, pulled)
        answer = operation.tick(now, T, arm.sensor, JointPositions(q, now), state)
        if isinstance(answer, Stop):
            break
        if isinstance(answer, ArmSetpoint):
            if not begun:
                world.forget()  # while the tool is tared nothing pulls
            begun = True
            world.refer(answer.q)
        opened = max(opened, world.opened)
    said = answer.why if isinstance(answer, Stop) else f"no end within {_LONGEST:g} s"
    return Pull(float(np.linalg.norm(world.peak()[:3])), world.mean(), opened, world.scene.goal, said)
