"""What the joints of an arm report now, from messages of one driver or several."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from sensor_msgs.msg import JointState

from modcal_core.errors import BadCommand
from modcal_core.geometry.so3 import Array
from modcal_msgs_py.commands import JointInput
from modcal_nodes.measuring.runner import JointReport


class JointReports:
    """The newest report of all joints. clock: seconds of the node's own time, in which messages are stamped."""

    def __init__(self, names: tuple[str, ...], lower: Array, upper: Array, clock: Callable[[], float]) -> None:
        self._joints, self._clock = JointInput(names, lower, upper), clock
        self._received = -np.inf

    def receive(self, message: JointState, stale: float) -> None:
        """Take a message. Raises BadCommand for one that is wrong or older than ``stale`` [s]."""
        self._joints.receive(message, self._clock(), stale)
        self._received = time.monotonic()

    def require_fresh(self, stale: float) -> None:
        """Raises BadCommand unless every joint was received within so many seconds."""
        self._joints.require_fresh(self._clock(), stale)

    @property
    def position(self) -> Array | None:
        """Where the joints are (n,), None while some were never heard of."""
        return None if self._joints.missing() else self._joints.position.copy()

    def now(self) -> JointReport | None:
        """The report; None while some joints were never heard of."""
        q = self.position
        if q is None:
            return None
        effort = self._joints.effort.copy()
        # joints may come in messages of several drivers: the one heard longest ago counts
        age = max(self._clock() - float(self._joints.stamps.min()), 0.0)
        received = min(self._received, time.monotonic() - age)
        return JointReport(q, received, effort if np.isfinite(effort).all() else None)


def required(reports: JointReports | None, stale: float) -> None:
    """Raises BadCommand where joints were never heard of, or not for so many seconds."""
    if reports is None:
        raise BadCommand("joint_states", "not received yet", "start the driver, or remap the topic")
    reports.require_fresh(stale)
