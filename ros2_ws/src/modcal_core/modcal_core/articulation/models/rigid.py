"""A handle that does not move: it is fixed, or locked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.articulation.joint_motion import InUrdf, Motion, middle_rotation
from modcal_core.articulation.joints import JointModel, placed
from modcal_core.articulation.models.axis import AxisModel, AxisMotion
from modcal_core.articulation.track import Track
from modcal_core.geometry import Array


@dataclass(frozen=True)
class RigidJoint(JointModel):
    """ξ = 0."""

    kind: ClassVar[str] = "rigid"
    moves: ClassVar[bool] = False
    radius: ClassVar[float] = 0.0
    length_per_unit: ClassVar[float] = 0.0

    def configuration(self, seen: ArrayLike) -> Array:
        """Zeros (...)."""
        return np.zeros(placed(seen)[0].shape[:-1])

    def sentence(self, a: Array, extent: float, std: Mapping[str, float]) -> str:
        """How far it was moved at most."""
        return f"moved by no more than {1e3 * extent:.0f} mm"


@dataclass(frozen=True)
class RigidMotion(AxisMotion):
    """A start, which may shift in all directions."""

    kind: ClassVar[str] = "rigid"
    moves: ClassVar[bool] = False
    made: ClassVar[type[JointModel]] = RigidJoint
    frame_turns: ClassVar[int] = 0
    shifts: ClassVar[int] = 3
    length_per_unit: ClassVar[float] = 0.0

    @property
    def across(self) -> Array:
        """All directions (3, 3)."""
        return np.eye(3)

    def along(self, y: Array, track: Track, sigma: tuple[float, float]) -> Array:
        """Zeros (n,)."""
        return np.zeros(len(y))

    def unwind(self, part: Array, a: Array, both: Array, by_a: Array, derivatives: bool) -> None:
        """Write what positions leave."""
        both[:, :3, : part.shape[2]] = part

    def apart(self, both: Array, by_a: Array) -> Array:
        """All of what positions leave (k, 3, 1 + size)."""
        return both[:, :3]

    def zero(self, a: Array) -> float:
        """It has one configuration."""
        return 0.0


class Rigid(AxisModel):
    """Object that does not move. Its probability follows from how far the handle came."""

    name = "rigid"
    share = 0.0
    moves = False
    urdf = InUrdf("fixed")
    joint = RigidJoint

    def guesses(self, track: Track, rng: np.random.Generator) -> Sequence[Motion]:
        """The median position, and the rotation that is near most."""
        p = np.median(track.positions, axis=0)
        return [RigidMotion(p, np.eye(3), None if track.rotations is None else middle_rotation(track.rotations))]


MODEL = Rigid()
