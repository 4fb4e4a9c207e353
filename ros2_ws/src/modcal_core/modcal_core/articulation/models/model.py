"""What a joint type is: how often it is met, what it begins a fit with, and which motion is fitted.

A type is an instance of a class derived from :class:`ArticulationModel`; most packages derive from
:class:`~modcal_core.articulation.models.parametric.ParametricModel`, for which a function of the configuration is
enough. The built-in types and a package's are registered, fitted and weighed in the same way.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np

from modcal_core.articulation.joint_motion import Motion
from modcal_core.articulation.track import Track

Kind: TypeAlias = str  # name of a joint type


@dataclass(frozen=True)
class InUrdf:
    """How URDF writes a joint. type: of its element. reach: configurations either way that are stated where none are
    known [rad or m]. rises: whether a second joint mimics the first along the same axis.
    """

    type: str
    reach: float = 0.0
    rises: bool = False


class ArticulationModel(ABC):
    """A joint type. name: in reports. share: how often it is met among all that moves.

    moves: whether a handle on it moves at all. usual: whether nothing can be said before it was weighed. slots: which
    of four rounds of an incremental selection begin with a new guess of it; none: it is weighed on whole tracks only.
    urdf: how URDF writes it, None where it cannot.
    """

    name: str
    share: float
    moves: ClassVar[bool] = True
    usual: ClassVar[bool] = False
    slots: ClassVar[Sequence[int]] = ()
    urdf: ClassVar[InUrdf | None] = None

    @abstractmethod
    def guesses(self, track: Track, rng: np.random.Generator) -> Sequence[Motion]:
        """The best few first guesses, best first, robust to gross outliers. rng: picks samples."""

    def quick_guess(self, track: Track, known: Mapping[Kind, Motion], turn: int) -> Motion | None:
        """One quick guess, None where there is none. known: results of other types. turn: number of the attempt."""
        return None
