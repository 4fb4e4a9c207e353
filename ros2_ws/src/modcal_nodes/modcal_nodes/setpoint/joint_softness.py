"""How soft the servos of an arm's joints may be, by which a force that is not felt is judged; or why nothing tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadRobot
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf_drives import read_drives

_FEW = 3  # joints of one effort are made alike; all of more than that, from shoulder to wrist, are a placeholder


@dataclass(frozen=True)
class JointSoftness:
    """least (n,): stiffness that each joint's servo has at least [N m/rad], NaN where nothing tells. unknown: why not,
    for a person; empty where the leads of joints are judged.
    """

    least: Array
    unknown: str = ""

    @classmethod
    def of(cls, urdf: str, chain: Chain, max_lead: float, held: str = "") -> JointSoftness:
        """For servos that lead by so much [rad] at most under the effort of a URDF.

        held: why it is not joints that are held, as text, where that is known.
        """
        unknown = np.full(chain.n, np.nan)
        if held or not max_lead > 0.0:
            return cls(unknown, held or "max_joint_lead_rad is 0")
        try:
            torque = read_drives(urdf, chain).torque
        except BadRobot as error:  # whose efforts are nonsense can be pulled with, as one that states none
            return cls(unknown, f"the efforts of the robot description cannot be used ({error})")
        stated = torque[chain.revolute & np.isfinite(torque)]
        if not len(stated):
            return cls(unknown, "the robot description states no effort of a joint")
        if len(stated) > _FEW and np.ptp(stated) == 0.0:
            return cls(unknown, f"the robot description states {stated[0]:g} N m for every joint, a placeholder")
        return cls(np.where(chain.revolute, torque / max_lead, np.nan))

    @property
    def said(self) -> str:
        """Which signals limit a force that the sensor hides, as text."""
        if self.unknown:
            return f"the lead of the tool alone ({self.unknown})"
        least, most = np.nanmin(self.least), np.nanmax(self.least)
        return f"the leads of tool and joints (servos of {least:.0f} to {most:.0f} N m/rad at least)"
