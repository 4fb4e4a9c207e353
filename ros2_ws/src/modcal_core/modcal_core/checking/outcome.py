"""What a check says: what changed, by how much, what may as well be the case, and what to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from modcal_core.geometry import Array

Status = Literal["unchanged", "changed", "ambiguous", "unexplained"]
# RMS, rad: six degrees, some teeth of a gear at an arm's joint. Angles that differ by more, by another amount at every
# station, are another joint's or no angles of the arm, and a model with them repaired would be nobody's
OF_A_GEAR = 0.1
# how alike two changes are at every recorded posture: not, in the positions that are read, or in poses
Alike = Literal["", "positions", "poses"]
Action = Literal["nothing", "use_repaired", "refit_base", "add_stations", "calibrate_again", "check_instrument"]


@dataclass(frozen=True)
class SizeFound:
    """One size of a change, with its 95 % interval, in the unit that people read."""

    name: str
    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class NamedChange:
    """One change. kind, place: as in :mod:`modcal_core.moves.rows`. label: for people. sizes: of it.

    moved_mm: how far it moves the tool over these stations, RMS, with its 95 % interval. turned_deg: how far it turns
    it, RMS; None where no orientation is read. probability: of this one
    among all that were looked for. same_as: other names of it, and others that explain the readings as well.
    alike: how far these make the same motion at every recorded posture, so that no such station can tell them apart.
    repairable: whether the sizes
    are enough to correct the model.
    """

    kind: str
    place: str
    label: str
    sentence: str
    sizes: tuple[SizeFound, ...]
    moved_mm: tuple[float, float, float]
    turned_deg: float | None
    probability: float
    same_as: tuple[str, ...]
    alike: Alike
    repairable: bool

    @property
    def likely(self) -> bool:
        """Whether angles are off by no more than a gear can be; a curve of any course may take up anything."""
        return all(s.name != "rms_over_stations" or s.value < 1e3 * OF_A_GEAR for s in self.sizes)


@dataclass(frozen=True)
class Noticed:
    """The smallest change of a kind that these stations show in 95 of 100 cases: RMS at the tool [mm], inf for none.

    unseen: changes of this kind that they do not show, such as the zero of a joint that turns as the base does.
    """

    label: str
    mm: float
    unseen: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recommendation:
    """action, and what it means here. stations: to be measured next (k, n); empty where none are needed."""

    action: Action
    sentence: str
    stations: Array = field(default_factory=lambda: np.empty((0, 0)))
