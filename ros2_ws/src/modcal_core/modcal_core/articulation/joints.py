"""The four ways a handle can move, each a screw motion about one axis: rigid, prismatic, revolute, screw.

``pose(a) = exp(ξ a) start`` with the space twist ξ = (v, ω) of the joint (Lynch and Park, Modern Robotics, 3.3):
prismatic ξ = (axis, 0), revolute ξ = (point × axis, axis), screw ξ = (point × axis + pitch axis, axis), rigid ξ = 0.
All of it stands in the frame of the track, called world below: a robot's base link or a tracker's frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.geometry import se3
from modcal_core.geometry.single import crossed
from modcal_core.geometry.so3 import HAT, Array

Kind = Literal["rigid", "prismatic", "revolute", "screw"]
KINDS: tuple[Kind, ...] = get_args(Kind)
# How far a turn weighs against a shift where one configuration must satisfy both: a hand is about this long.
_LENGTH = 0.1  # m
_EYE = np.eye(3)


@dataclass(frozen=True)
class JointModel:
    """How a handle moves: ``T_world_handle = pose(a)`` at configuration a [rad when it turns, else m].

    start: T_world_handle (4, 4) at configuration 0, with the identity rotation when only positions were seen.
    axis: unit vector (3,). point: on the axis (3,) [m], the one nearest to start when it turns, else zeros.
    pitch: advance along the axis [m/rad], 0 unless a screw. oriented: whether start's rotation was seen.
    Raises BadRobot when these are no joint.
    """

    kind: Kind
    start: Array
    axis: Array
    point: Array
    pitch: float = 0.0
    oriented: bool = True

    def __post_init__(self) -> None:
        for name, shape in (("start", (4, 4)), ("axis", (3,)), ("point", (3,))):
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != shape or not np.isfinite(array).all():
                raise BadRobot(f"joint {self.kind}, {name}", f"is not {shape} finite numbers", "give finite numbers")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.kind not in KINDS:
            raise BadRobot(f"joint {self.kind}", f"is none of {', '.join(KINDS)}", "name one of them")
        if abs(math.sqrt(self.axis @ self.axis) - 1.0) > 1e-6:
            raise BadRobot(
                f"joint {self.kind}, axis", f"has length {np.linalg.norm(self.axis):g}, not 1", "normalise it"
            )
        if not np.isfinite(self.pitch) or (self.pitch != 0.0 and self.kind != "screw"):
            raise BadRobot(f"joint {self.kind}, pitch", f"is {self.pitch:g} m/rad", "only a screw has a finite pitch")
        R = self.start[:3, :3]
        if np.abs(R @ R.T - _EYE).max() > 1e-6 or crossed(R[:, 0], R[:, 1]) @ R[:, 2] < 0.0:
            raise BadRobot(f"joint {self.kind}, start", "is no rigid transform", "give a rotation and a position")

    @classmethod
    def trusted(
        cls, kind: Kind, start: Array, axis: Array, point: Array, pitch: float = 0.0, oriented: bool = True
    ) -> JointModel:
        """A joint of numbers known to be sound, not looked at again: one made anew with every pose has no time."""
        joint = cls.__new__(cls)
        for name, value in (("start", start), ("axis", axis), ("point", point)):
            value.flags.writeable = False
            object.__setattr__(joint, name, value)
        for name, other in (("kind", kind), ("pitch", pitch), ("oriented", oriented)):
            object.__setattr__(joint, name, other)
        return joint

    @property
    def turns(self) -> bool:
        """Whether the handle turns about the axis, so that configurations are angles."""
        return self.kind in ("revolute", "screw")

    @property
    def radius(self) -> float:
        """Distance [m] from the handle to the axis; inf when it slides, 0 when nothing moves."""
        if not self.turns:
            return np.inf if self.kind == "prismatic" else 0.0
        arm = self.start[:3, 3] - self.point
        arm = arm - self.axis * (self.axis @ arm)
        return math.sqrt(arm @ arm)

    @property
    def length_per_unit(self) -> float:
        """Path of the handle [m] per unit of configuration: 1 when it slides, about the radius when it turns."""
        return math.hypot(self.radius, self.pitch) if self.turns else float(self.kind == "prismatic")

    def twist(self) -> Array:
        """Space twist (6,), (v, ω), per unit of configuration."""
        if self.kind == "rigid":
            return np.zeros(6)
        if self.kind == "prismatic":
            return np.concatenate([self.axis, np.zeros(3)])
        return np.concatenate([np.cross(self.point, self.axis) + self.pitch * self.axis, self.axis])

    def pose(self, a: ArrayLike) -> Array:
        """T_world_handle (..., 4, 4) at configurations a (...)."""
        return se3.exp(np.asarray(a, dtype=float)[..., None] * self.twist()) @ self.start

    def position(self, a: ArrayLike) -> Array:
        """Positions of the handle (..., 3) [m] at configurations a (...)."""
        return self.pose(a)[..., :3, 3]

    def configuration(self, seen: ArrayLike) -> Array:
        """Configurations (...) whose pose is nearest to seen poses (..., 4, 4) or positions (..., 3).

        A turn of 1 rad weighs as much as a shift of a hand's length. When it turns, the answer lies within half a turn
        of configuration 0, but for a screw whose rise along the axis says which turn it is.
        """
        seen = np.asarray(seen, dtype=float)
        whole = seen.ndim >= 2 and seen.shape[-2:] == (4, 4)
        p = seen[..., :3, 3] if whole else seen
        if self.kind == "rigid":
            return np.zeros(p.shape[:-1])
        if self.kind == "prismatic":
            return (p - self.start[:3, 3]) @ self.axis
        return self._angle(p, seen[..., :3, :3] if whole and self.oriented else None)

    def _angle(self, p: Array, R: Array | None) -> Array:
        arm = self.start[:3, 3] - self.point
        rise0 = float(arm @ self.axis)
        arm = arm - rise0 * self.axis
        r = math.sqrt(arm @ arm)
        across = crossed(self.axis, arm)
        x = p - self.point
        a = np.arctan2(x @ across, x @ arm)
        weight = 0.0
        if R is not None:
            # the turn about the axis that brings start nearest to R: its sine and cosine are linear in R
            S = self.start[:3, :3]
            sine, cosine = (self.axis @ HAT).reshape(3, 3) @ S, S - self.axis[:, None] * (self.axis @ S)
            flat = R.reshape(*R.shape[:-2], 9)
            turned = np.arctan2(flat @ sine.ravel(), flat @ cosine.ravel())
            weight = _LENGTH**2 / (_LENGTH**2 + r * r)
            a = turned + (1.0 - weight) * wrapped(a - turned) if r > 0.0 else turned
        a = wrapped(a)
        if self.kind == "screw" and self.pitch != 0.0:
            a = self._on_the_thread(a, x, rise0, r, weight)
        return a

    def _on_the_thread(self, a0: Array, x: Array, rise0: float, r: float, weight: float) -> Array:
        """Configurations nearest to a point beside the helix: the right turn of it, then Newton's method."""
        angle, rise = a0, x @ self.axis - rise0
        turns = np.round((rise / self.pitch - angle) / (2.0 * np.pi))
        # Another turn only where it lies much nearer: half a thread is otherwise what play and noise may do.
        far = np.abs(rise - self.pitch * angle) > 1.5 * np.pi * abs(self.pitch)
        angle = angle + 2.0 * np.pi * np.where(far, turns, 0.0)
        out = np.hypot(np.linalg.norm(x - (x @ self.axis)[..., None] * self.axis, axis=-1), 1e-9)
        stiff = r * out + weight / (1.0 - weight + 1e-12) * r * r + 1e-12
        a = angle.copy()
        for _ in range(6):  # minimise stiff (1 − cos(a − angle)) + (rise − pitch a)² / 2
            gradient = stiff * np.sin(a - angle) - self.pitch * (rise - self.pitch * a)
            a = a - gradient / (stiff * np.maximum(np.cos(a - angle), 0.2) + self.pitch**2)
        return a


def wrapped(angle: ArrayLike) -> Array:
    """Angles [rad] brought into (−π, π]."""
    angle = np.asarray(angle, dtype=float)
    return angle - 2.0 * np.pi * np.ceil((angle - np.pi) / (2.0 * np.pi))
