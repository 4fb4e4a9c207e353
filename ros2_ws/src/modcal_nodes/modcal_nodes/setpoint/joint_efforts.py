"""What is known of an arm's joints by which their efforts show a force; or why nothing tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadRobot
from modcal_core.impedance.effort_check import ArmEfforts
from modcal_core.impedance.operation import Operation
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf_drives import read_drives
from modcal_core.robots.urdf_inertias import read_inertias


@dataclass(frozen=True)
class JointEfforts:
    """arm: what is known, None where that is not enough. unknown: why not, as text."""

    arm: ArmEfforts | None
    unknown: str = ""

    @classmethod
    def of(cls, urdf: str, chain: Chain) -> JointEfforts:
        """For the masses and efforts that a URDF states."""
        try:
            bodies, full = read_inertias(urdf, chain), read_drives(urdf, chain).torque
        except BadRobot as error:  # what is nonsense can be pulled with, as what is not there
            return cls(None, f"the robot description cannot be used ({error})")
        if not bodies.mass.any():
            return cls(None, "the robot description states no masses")
        if not np.isfinite(full).all():
            return cls(None, "the robot description does not state the effort of every joint")
        return cls(ArmEfforts(chain, bodies, full))

    def said(self, operation: Operation | None) -> str:
        """The force [N] that they show at least in a pull, or why they show none; empty before it moves."""
        if operation is None or operation.phase == "tare":
            return ""
        check = operation.tool_force.efforts
        return (self.unknown or check.unusable) or f"{check.force:.1f}"
