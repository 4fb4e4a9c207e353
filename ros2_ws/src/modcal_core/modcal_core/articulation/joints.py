"""A joint in its place, and the screw motions about one axis that most joints are.

``pose(a) = exp(ξ a) start`` with the space twist ξ = (v, ω) of the joint (Lynch and Park, Modern Robotics, 3.3).
All of it stands in the frame of the track, called world below: a robot's base link or a tracker's frame.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, crossed, se3

_EYE = np.eye(3)


@dataclass(frozen=True)
class JointModel:
    """How a handle moves about one axis: ``T_world_handle = pose(a)`` at configuration a [rad when it turns, else m].

    start: T_world_handle (4, 4) at configuration 0, with the identity rotation when only positions were seen.
    axis: unit vector (3,). point: on the axis (3,) [m], the one nearest to start when it turns, else zeros.
    pitch: advance along the axis [m/rad], 0 unless a screw. oriented: whether start's rotation was seen.
    Raises BadRobot when these are no joint.
    """

    start: Array
    axis: Array
    point: Array
    pitch: float = 0.0
    oriented: bool = True

    kind: ClassVar[str]
    moves: ClassVar[bool] = True
    turns: ClassVar[bool] = False
    rises: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name, shape in (("start", (4, 4)), ("axis", (3,)), ("point", (3,))):
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != shape or not np.isfinite(array).all():
                raise BadRobot(f"joint {self.kind}, {name}", f"is not {shape} finite numbers", "give finite numbers")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if abs(math.sqrt(self.axis @ self.axis) - 1.0) > 1e-6:
            raise BadRobot(
                f"joint {self.kind}, axis", f"has length {np.linalg.norm(self.axis):g}, not 1", "normalise it"
            )
        if not np.isfinite(self.pitch) or (self.pitch != 0.0 and not self.rises):
            raise BadRobot(f"joint {self.kind}, pitch", f"is {self.pitch:g} m/rad", "only a screw has a finite pitch")
        R = self.start[:3, :3]
        if np.abs(R @ R.T - _EYE).max() > 1e-6 or crossed(R[:, 0], R[:, 1]) @ R[:, 2] < 0.0:
            raise BadRobot(f"joint {self.kind}, start", "is not a rigid transform", "give a rotation and a position")

    @classmethod
    def trusted(cls, start: Array, axis: Array, point: Array, pitch: float = 0.0, oriented: bool = True) -> Self:
        """A joint from valid numbers, without checks, because one is made with every pose."""
        joint = cls.__new__(cls)
        for name, value in (("start", start), ("axis", axis), ("point", point)):
            value.flags.writeable = False
            object.__setattr__(joint, name, value)
        for name, other in (("pitch", pitch), ("oriented", oriented)):
            object.__setattr__(joint, name, other)
        return joint

    @property
    def unit(self) -> str:
        """Unit of configurations: rad or m."""
        return "rad" if self.turns else "m"

    @property
    @abstractmethod
    def radius(self) -> float:
        """Distance [m] from the handle to the axis; inf when it slides, 0 when nothing moves."""

    @property
    @abstractmethod
    def length_per_unit(self) -> float:
        """Path of the handle [m] per unit of configuration: 1 when it slides, about the radius when it turns."""

    def twist(self) -> Array:
        """Space twist (6,), (v, ω), per unit of configuration: (point × axis + pitch axis, axis) where it turns."""
        if not self.turns:
            return np.concatenate([float(self.moves) * self.axis, np.zeros(3)])
        return np.concatenate([np.cross(self.point, self.axis) + self.pitch * self.axis, self.axis])

    @abstractmethod
    def configuration(self, seen: ArrayLike) -> Array:
        """Configurations (...) whose pose is nearest to seen poses (..., 4, 4) or positions (..., 3).

        A turn of 1 rad weighs as much as a shift of a hand's length. When it turns, the answer lies within half a turn
        of configuration 0, but for a screw whose rise along the axis says which turn it is.
        """

    @abstractmethod
    def sentence(self, a: Array, extent: float, std: Mapping[str, float]) -> str:
        """What a person is told. a (k,): configurations of sound samples. extent: of the track [m]. std: by name."""

    def pose(self, a: ArrayLike) -> Array:
        """T_world_handle (..., 4, 4) at configurations a (...)."""
        return se3.exp(np.asarray(a, dtype=float)[..., None] * self.twist()) @ self.start

    def position(self, a: ArrayLike) -> Array:
        """Positions of the handle (..., 3) [m] at configurations a (...)."""
        return self.pose(a)[..., :3, 3]

    def centre(self) -> Array | None:
        """The point on the axis (3,) [m] next to the handle, where it lies within two metres."""
        return self.point if self.turns and self.radius < 2.0 else None

    def data(self, a: Array, std: Mapping[str, float]) -> dict[str, Any]:
        """Numbers for JSON: the start; axis, point, radius and pitch, each None where it does not apply."""
        return {
            "axis": self.axis.tolist() if self.moves else None,
            "point": self.point.tolist() if self.turns else None,
            "radius": self.radius if self.turns else None,
            "pitch": self.pitch if self.rises else None,
            "start": se3.to_pose(self.start).tolist(),
        }


@dataclass(frozen=True)
class PathJoint:
    """A shape in its place: ``T_world_handle = pose(a)`` at the shape's own configuration a.

    kind: name of the joint type. values: by parameter. T_world_object (4, 4). oriented: whether rotations were seen.
    unit: of a.
    """

    kind: str
    values: dict[str, float]
    T_world_object: Array
    oriented: bool
    unit: str
    motion: Any = field(repr=False)

    def pose(self, a: Array) -> Array:
        """T_world_handle (n, 4, 4) at configurations a (n,)."""
        return np.asarray(self.motion.poses(np.asarray(a, dtype=float)))

    def position(self, a: Array) -> Array:
        """Positions of the handle (n, 3) [m] at configurations a (n,)."""
        return self.pose(a)[:, :3, 3]

    def centre(self) -> None:
        """It has no axis."""

    def sentence(self, a: Array, extent: float, std: Mapping[str, float]) -> str:
        """How far it moved along its path, and its parameters."""
        path = self.position(np.sort(a))
        way = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        said = ", ".join(f"{name} {value:.3g} ± {std[name]:.2g}" for name, value in self.values.items())
        return f"moved {1e2 * way:.0f} cm along its path; {said}"

    def data(self, a: Array, std: Mapping[str, float]) -> dict[str, Any]:
        """Numbers for JSON: the start, the place of the object, and the parameters; it has no axis."""
        units = {p.name: p.unit for p in self.motion.model.parameters}
        return {
            **dict.fromkeys(("axis", "point", "radius", "pitch")),
            "start": se3.to_pose(self.pose(a[:1])[0]).tolist(),
            "object": se3.to_pose(self.T_world_object).tolist(),
            "parameters": {
                name: {"value": value, "std": std[name], "unit": units[name]} for name, value in self.values.items()
            },
        }


def span(a: Array) -> float:
    """From the least to the largest of configurations (k,); 0 where there are none."""
    return float(np.ptp(a)) if len(a) else 0.0


def placed(seen: ArrayLike) -> tuple[Array, Array | None]:
    """Positions (..., 3), and rotations (..., 3, 3) or None, of poses (..., 4, 4) or positions (..., 3)."""
    seen = np.asarray(seen, dtype=float)
    whole = seen.ndim >= 2 and seen.shape[-2:] == (4, 4)
    return (seen[..., :3, 3], seen[..., :3, :3]) if whole else (seen, None)


def wrapped(angle: ArrayLike) -> Array:
    """Angles [rad] brought into (−π, π]."""
    angle = np.asarray(angle, dtype=float)
    return angle - 2.0 * np.pi * np.ceil((angle - np.pi) / (2.0 * np.pi))


def followed(angle: Array, sound: np.ndarray) -> Array:
    """Angles (n,) [rad] without jumps by whole turns from one sample to the next. sound (n,): which are no outliers.

    As they are where neighbours are a quarter turn apart or more, as in a track that is not in order of time.
    """
    rows = np.flatnonzero(sound)
    steps = wrapped(np.diff(angle[rows]))
    if not len(steps) or np.abs(steps).max() > 0.5 * np.pi:
        return angle
    turns = (angle[rows[0]] + np.r_[0.0, np.cumsum(steps)] - angle[rows]) / (2.0 * np.pi)
    return angle + 2.0 * np.pi * np.round(np.interp(np.arange(len(angle)), rows, turns))
