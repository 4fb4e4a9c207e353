"""The modules that arms are put together from: what each is, how long it may be, and where its output flange is.

Every module has an input frame (0) and an output frame (1), z along the way through the flange. A joint acts along z of
its input frame. Which modules there are, and all their figures, are data: see ``published.yaml`` and
:func:`modcal_core.modules.library_data.library_from_data`.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

BASE, JOINT, LINK, GRIPPER = "base", "joint", "link", "gripper"
ROLES = (BASE, JOINT, LINK, GRIPPER)
SIZES = 8  # a length is one of eight, of three bits in the published code
TURNS = 4  # and neighbours are bolted at one of four quarter turns


@dataclass(frozen=True)
class ModulePoint:
    """A point that moves with the module's length: ``xyz + length · along``, each (3,) [m, 1], in the input frame."""

    xyz: Array
    along: Array

    def at(self, length: float) -> Array:
        """Where it is for a length [m], (3,) [m]."""
        return self.xyz + length * self.along


@dataclass(frozen=True)
class ModuleType:
    """One kind of module.

    name: such as "LR-I". role: base, joint, link or gripper. revolute: whether a joint turns; of no meaning elsewhere.
    code: of a joint's or link's kind in the published code. first, step: length of code n is ``first + n · step`` [m];
    step 0: there is one length only. output: position of the output frame; R: its orientation (3, 3). elbows: corners
    of the body. lower, upper, velocity, effort: of a joint [rad or m, per second, N m or N]. radius: of the body [m].
    mass: [kg], mass_per_metre [kg/m] of length on top.
    """

    name: str
    role: str
    output: ModulePoint
    R: Array
    revolute: bool = True
    code: int = 0
    first: float = 0.0
    step: float = 0.0
    elbows: tuple[ModulePoint, ...] = ()
    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = 1.0
    effort: float = 100.0
    radius: float = 0.03
    mass: float = 0.0
    mass_per_metre: float = 0.0

    @property
    def sizes(self) -> int:
        """How many lengths there are."""
        return SIZES if self.step else 1

    def length(self, size: int) -> float:
        """Its length [m] for a code 0 … 7."""
        return self.first + size * self.step

    @cached_property
    def T_in_out(self) -> Array:
        """Output frame in the input frame, the joint at zero, for every code, (sizes, 4, 4) [m]."""
        T = se3.transform(self.R, np.stack([self.output.at(self.length(n)) for n in range(self.sizes)]))
        T.flags.writeable = False
        return T


@dataclass(frozen=True)
class ModuleTolerance:
    """Standard deviations of a physical thing about its drawing: per axis [m, rad], and of a joint's zero [rad]."""

    length: float
    angle: float
    zero: float = 0.0


@dataclass(frozen=True)
class Library:
    """Kinds of modules by name, and how exactly they are made and bolted."""

    name: str
    types: Mapping[str, ModuleType]
    module: ModuleTolerance = ModuleTolerance(3e-4, 1e-3, 3e-3)
    interface: ModuleTolerance = ModuleTolerance(3e-5, 2e-4)

    def type(self, name: str, what: str = "module") -> ModuleType:
        """The kind with this name. Raises BadTable with the names that come close."""
        found = self.types.get(name)
        if found is None:
            close = difflib.get_close_matches(str(name), self.types, n=3, cutoff=0.4) or list(self.types)
            raise BadTable(f"{what} '{name}'", f"is not in the module library '{self.name}'", f"use {', '.join(close)}")
        return found

    def of_role(self, role: str) -> tuple[ModuleType, ...]:
        """The kinds of one role, in the order of their codes."""
        return tuple(sorted((t for t in self.types.values() if t.role == role), key=lambda t: t.code))

    @property
    def base(self) -> ModuleType:
        """The first kind of base."""
        return self.of_role(BASE)[0]

    @property
    def gripper(self) -> ModuleType:
        """The first kind of gripper."""
        return self.of_role(GRIPPER)[0]
