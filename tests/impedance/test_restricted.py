"""Limits that change in the middle of a pull hold at once: what is too fast brakes, what is too far lets go."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, T_READY, Toy, drawer, limits, pull

from modcal_core.impedance.operation import Operation
from modcal_core.impedance.safety_monitor import Limits
from modcal_core.impedance.speed_governor import GovernorSettings
from modcal_core.impedance.task import ImpedanceTask

TASK = ImpedanceTask(direction=T_READY[:3, :3].T @ np.array([-1.0, 0.0, 0.0]), goal_m=0.2)


class Changed:
    """Once the way is followed at speed, other limits."""

    def __init__(self, new: Limits, task: ImpedanceTask = TASK) -> None:
        self.new, self.task, self.at = new, task, math.nan

    def __call__(self, now: float, operation: Operation) -> None:
        if operation.phase == "follow" and operation.governor.speed > 0.04 and math.isnan(self.at):
            self.at = now
            operation.restrict(self.task, self.new, now)


def speeds(done: object) -> tuple[np.ndarray, np.ndarray]:
    """Times and speeds of the tool's setpoints [m/s]."""
    t = np.array([t for t, _ in done.setpoints])  # type: ignore[attr-defined]
    p = np.array([s.pose[:3, 3] for _, s in done.setpoints])  # type: ignore[attr-defined]
    return t[1:], np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(t)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["speed", "joint_speed"])
def test_a_lower_speed_holds_at_once_and_the_pull_goes_on(name: str) -> None:
    lower = limits(speed=0.02) if name == "speed" else limits(joint_speed=np.full(7, 0.03))
    changed = Changed(lower)
    done = pull(Toy(drawer(), friction=6.0), Operation(PANDA, TASK, limits()), trusts=0.05, meanwhile=changed)
    assert done.stop is not None
    assert done.stop.done, done.stop.why
    t, v = speeds(done)
    before = v[t <= changed.at].max()
    assert before > 0.03
    assert v[t > changed.at].max() <= before * 1.01  # nothing becomes faster while it brakes
    later = t > changed.at + 0.1
    if name == "speed":
        assert v[later].max() <= 0.02 * (1.0 + 1e-6)
    else:
        q = np.array([s.q for _, s in done.setpoints])
        rates = np.abs(np.diff(q, axis=0)).max(axis=1) / PERIOD
        assert rates[later].max() <= 0.03 * (1.0 + 1e-6)


CASES: dict[str, tuple[Callable[[], Limits], ImpedanceTask, str]] = {
    "force": (
        lambda: limits(force=4.0),
        replace(TASK, governor=GovernorSettings(slowdown=(2.0, 6.0), stop=(3.0, 14.0), max_force=4.0)),
        "4 N is the limit",
    ),
    "displacement": (lambda: limits(displacement=1e-4), TASK, "limits were changed: the setpoint is"),
    "gain": (lambda: limits(gain=0.9), TASK, "limits were changed: the posture is next to singular"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_where_the_new_limits_do_not_allow_what_is_there_the_hand_lets_go(name: str) -> None:
    new, task, why = CASES[name]
    toy = Toy(drawer(), friction=8.0)
    done = pull(toy, Operation(PANDA, TASK, limits()), trusts=0.05, meanwhile=Changed(new(), task))
    assert done.stop is not None
    assert not done.stop.done
    assert why in done.stop.why
    assert done.phases[-1] == "release"
    assert done.forces[-1] < 8.5  # what friction holds, and no more
