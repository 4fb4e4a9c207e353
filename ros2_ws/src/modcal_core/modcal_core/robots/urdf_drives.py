"""What the drives of a chain can do, as a URDF states it: effort, velocity, friction.

They are read on their own: kinematics need none of these numbers, and must not fail where one of them is nonsense.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadRobot
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf_tree import document

# field: the element and its attribute, and what is written where nothing is stated
_STATED = {
    "torque": ("limit", "effort", np.nan),
    "speed": ("limit", "velocity", np.inf),
    "coulomb": ("dynamics", "friction", 0.0),
    "viscous": ("dynamics", "damping", 0.0),
}


@dataclass(frozen=True)
class Drives:
    """The drives of n joints, all seen from the joint: behind the gear.

    names: the joints. torque: largest torque either way [N m; N where it slides], NaN where nobody says. speed: largest
    speed [rad/s; m/s]. coulomb: dry friction [N m; N]. viscous: friction per speed [N m s/rad; N s/m]. rotor: inertia
    of motor and gear [kg m²; kg]. All (n,).
    """

    names: tuple[str, ...]
    torque: Array
    speed: Array
    coulomb: Array
    viscous: Array
    rotor: Array

    def with_values(self, what: str, values: Mapping[str, float]) -> Drives:
        """The drives with other numbers of one kind, by joint. Raises BadRobot for a wrong joint or number."""
        new = np.array(getattr(self, what))
        for name, value in values.items():
            if name not in self.names:
                raise BadRobot(
                    f"{what} of joint '{name}'", "is not of this arm", f"name one of {', '.join(self.names)}"
                )
            least = "above 0" if what in ("torque", "speed") else "0 or more"
            if not np.isfinite(value) or value < 0.0 or (value == 0.0 and least == "above 0"):
                raise BadRobot(f"{what} of joint {name}", f"is {value:g}, not a number {least}", "correct it")
            new[self.names.index(name)] = value
        new.flags.writeable = False
        changed: dict[str, Any] = {what: new}
        return replace(self, **changed)

    def require_torque(self) -> None:
        """Raises BadRobot for a joint whose largest torque nobody says."""
        unknown = [name for name, known in zip(self.names, np.isfinite(self.torque), strict=True) if not known]
        if unknown:
            said = "the robot description states no effort for it"
            raise BadRobot(f"drive of joint {', '.join(unknown)}", said, "write <limit effort>, or give the torque")


def read_drives(urdf_xml: str, chain: Chain) -> Drives:
    """The drives of a chain that was read from this URDF; an effort of 0 counts as none stated, so does a speed of 0.

    Raises BadRobot for a number that is none, or is negative, and for a joint that the URDF does not have.
    """
    joints = {e.get("name"): e for e in document(urdf_xml).iterchildren("joint")}
    columns = {what: np.empty(chain.n) for what in _STATED}
    for k, name in enumerate(chain.names):
        if name not in joints:
            raise BadRobot(f"joint {name}", "is not in the robot description", "give the URDF the chain came from")
        for what, (tag, attribute, none) in _STATED.items():
            element = joints[name].find(tag)
            columns[what][k] = _number(None if element is None else element.get(attribute), none, name, attribute)
    for array in (*columns.values(), rotor := np.zeros(chain.n)):
        array.flags.writeable = False
    return Drives(chain.names, **columns, rotor=rotor)


def _number(text: str | None, none: float, joint: str, attribute: str) -> float:
    if text is None or not text.strip():
        return none
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if np.isnan(value) or value < 0.0:
        raise BadRobot(f"joint {joint}: {attribute}", f"'{text}' is not a number of 0 or more", "correct the URDF")
    return none if value == 0.0 or np.isinf(value) else value
