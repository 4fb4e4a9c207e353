"""A handle that slides along a line: a drawer, a sliding door."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.articulation.joint_motion import InUrdf, Kind, Motion, far_apart, few, frame, some_three
from modcal_core.articulation.joints import JointModel, placed, span
from modcal_core.articulation.models.axis import AxisModel, AxisMotion, robust
from modcal_core.articulation.track import Track
from modcal_core.geometry import Array


@dataclass(frozen=True)
class PrismaticJoint(JointModel):
    """ξ = (axis, 0)."""

    kind: ClassVar[str] = "prismatic"
    radius: ClassVar[float] = np.inf
    length_per_unit: ClassVar[float] = 1.0

    def configuration(self, seen: ArrayLike) -> Array:
        """How far along the axis (...) [m]."""
        return (placed(seen)[0] - self.start[:3, 3]) @ self.axis

    def sentence(self, a: Array, extent: float, std: Mapping[str, float]) -> str:
        """Sentence with the distance along the line."""
        return f"slid {1e2 * span(a):.0f} cm along a line"


@dataclass(frozen=True)
class PrismaticMotion(AxisMotion):
    """It goes along column 0 of G."""

    kind: ClassVar[str] = "prismatic"
    flat: ClassVar[bool] = True
    made: ClassVar[type[JointModel]] = PrismaticJoint
    frame_turns: ClassVar[int] = 2
    length_per_unit: ClassVar[float] = 1.0

    def along(self, y: Array, track: Track, sigma: tuple[float, float]) -> Array:
        """How far along (n,) [m]."""
        return y[:, 0]

    def unwind(self, part: Array, a: Array, both: Array, by_a: Array, derivatives: bool) -> None:
        """Write what positions leave."""
        part[:, 0, 0] -= a
        by_a[:, 0] = -1.0
        both[:, :3, : part.shape[2]] = part

    def at(self, a: float, R: Array) -> tuple[Array, Array, Array]:
        """The start, slid along."""
        return self.p + a * self.axis, np.zeros(3), R


class Prismatic(AxisModel):
    """Prismatic joint. Its prior probability equals that of a revolute joint."""

    name = "prismatic"
    share = 0.49
    usual = True
    slots = (3,)
    urdf = InUrdf("prismatic", 2.0)
    joint = PrismaticJoint

    def guesses(self, track: Track, rng: np.random.Generator) -> Sequence[Motion]:
        """Lines through two samples of three, beginning at the one between."""
        some = few(track)
        p, R = some.positions, some.rotations

        def lines() -> list[Motion]:
            out: list[Motion] = []
            for _, (i, j, k) in some_three(some, rng):
                d = p[k] - p[i]
                if np.linalg.norm(d) > 1e-9:
                    out.append(PrismaticMotion(p[j], frame(d), None if R is None else R[j]))
            return out

        return robust(lines(), some, PrismaticMotion)

    def quick_guess(self, track: Track, known: Mapping[Kind, Motion], turn: int) -> Motion | None:
        """Line through the two samples that are farthest apart."""
        return line(PrismaticMotion, track)


def line(motion: type[AxisMotion], track: Track) -> Motion | None:
    """A motion that begins along the line through the two samples that lie farthest apart; None where none moved."""
    first, between, last = far_apart(track)
    p, R = track.positions, track.rotations
    d = p[last] - p[first]
    return motion(p[between], frame(d), None if R is None else R[between]) if np.linalg.norm(d) > 1e-6 else None


MODEL = Prismatic()
