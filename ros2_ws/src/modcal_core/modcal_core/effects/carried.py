"""Payloads of earlier recordings, as differences to the final one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class Carried:
    """Before each of some moments the load at the tip differed from the one in the end, which the arm's bodies contain.

    until: the moments, rising stamps [s]. mass: by how much, (k,) [kg]; of an arm whose masses nobody knows in units of
    what it carries in the end. moment: the same of mass times place in the tip link, (k, 3) [kg m].
    """

    until: tuple[float, ...]
    mass: Array
    moment: Array

    def at(self, stamps: Array) -> tuple[Array, Array]:
        """Differences of mass (N,) and of mass times place (3, N) at these stamps; none where a stamp is unknown."""
        k = np.searchsorted(np.array(self.until), stamps, side="right")
        mass, moment = np.append(self.mass, 0.0), np.concatenate([self.moment, np.zeros((1, 3))])
        return mass[k], moment[k].T
