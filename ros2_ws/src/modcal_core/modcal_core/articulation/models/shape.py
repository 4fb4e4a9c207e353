"""The shape of a path along which a handle moves, as a function of the configuration, in a frame of the object's own.

Most packages that add a joint type derive from :class:`~modcal_core.articulation.models.parametric.ParametricModel`,
which is such a shape. Where the object stands and how it is grasped is not the shape's business. Every answer of a
shape is looked at; what is none is refused with the package's name.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.articulation.track import Track
from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array

FARTHEST = 5.0  # standard deviations of its prior: no value is tried beyond
REMEDY = "fix the package that provides it, or uninstall it"
_UNITS = ("rad", "m", "1")


@dataclass(frozen=True)
class ShapeParameter:
    """A number of a model's shape, before any object is seen: normal about mean with std, in the model's own unit."""

    name: str
    mean: float
    std: float
    unit: str = "1"


class PathShape(ABC):
    """A path with the orientation along it.

    name: of the joint type. parameters: with what is known of them beforehand. lower, upper: between which
    configurations lie; unit: theirs, "rad", "m" or "1".
    """

    name: str
    parameters: Sequence[ShapeParameter]
    lower: float
    upper: float
    unit: str = "1"

    @abstractmethod
    def pose(self, values: Array, a: Array) -> Array:
        """T_object_handle (n, 4, 4) at configurations a (n,), in a frame of the object's own.

        values: the parameters (P,), none farther than five standard deviations from its mean. Must be finite, and
        smooth in values and in a.
        """

    def begin(self, track: Track) -> Sequence[Array]:
        """Values (P,) to begin with, a few. Where not stated: the mean, and each parameter off it by one std."""
        mean, std = (np.array([getattr(p, part) for p in self.parameters]) for part in ("mean", "std"))
        return [mean, *(mean + side * row for row in np.diag(std) for side in (1.0, -1.0))]

    def fault(self) -> str:
        """What it does not state as it must; empty where it does."""
        try:
            stated = [(str(p.name), float(p.mean), float(p.std)) for p in self.parameters]
            ends = float(self.lower), float(self.upper)
        except (AttributeError, TypeError, ValueError) as error:
            return f"does not state parameters, lower, upper and share ({error})"
        if len({word for word, _, _ in stated}) < len(stated):
            return "two parameters have one name"
        for word, mean, std in stated:
            if not (math.isfinite(mean) and math.isfinite(std) and std > 0.0):
                return f"the prior of {word} is {mean:g} ± {std:g}"
        if not (all(map(math.isfinite, ends)) and ends[0] < ends[1]):
            return f"its configurations lie between {ends[0]:g} and {ends[1]:g}"
        return "" if self.unit in _UNITS else f"its unit {self.unit!r} is not one of {', '.join(_UNITS)}"

    @property
    def offender(self) -> str:
        """What messages call it."""
        return f"articulation model {self.name} of package {type(self).__module__}"

    @property
    def size(self) -> int:
        """How many parameters its shape has."""
        return len(self.parameters)

    @cached_property
    def prior(self) -> tuple[Array, Array]:
        """Means and standard deviations (P,)."""
        given = self.parameters
        return np.array([float(p.mean) for p in given]), np.array([float(p.std) for p in given])

    def checked_pose(self, values: Array, a: Array) -> Array:
        """T_object_handle (n, 4, 4). Raises BadTable for what is no pose, or when the package raises."""
        a = np.asarray(a, dtype=float)
        try:
            out = np.asarray(self.pose(values.copy(), a.copy()), dtype=float)
        except Exception as error:  # whatever a package may do
            raise self._refused("pose", values, f"raises {type(error).__name__} ({error})") from error
        if out.shape != (len(a), 4, 4):
            raise self._refused("pose", values, f"has shape {out.shape}, not ({len(a)}, 4, 4)")
        if not np.isfinite(out).all():
            raise self._refused("pose", values, f"is not finite at a = {a[~np.isfinite(out).all(axis=(1, 2))][0]:.6g}")
        R = out[:, :3, :3]
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() > 1e-6 or np.linalg.det(R).min() < 0.0
        if off or np.abs(out[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
            raise self._refused("pose", values, "is not a rigid transform")
        return out

    def checked_path(self, values: Array, count: int) -> tuple[Array, Array]:
        """``count`` configurations over the whole range, and the poses there. Raises BadTable where the handle does not
        move.
        """
        a = np.linspace(self.lower, self.upper, count)
        T = self.checked_pose(values, a)
        if float(np.ptp(T[:, :3, 3], axis=0).max()) < 1e-6:
            raise self._refused("pose", values, "does not move")
        return a, T

    def checked_begin(self, track: Track) -> list[Array]:
        """First values (P,). Raises BadTable for what is none, or when the package raises."""
        try:
            given = [np.asarray(values, dtype=float) for values in self.begin(track)]
        except Exception as error:  # whatever a package may do
            raise self._refused("begin", None, f"raises {type(error).__name__} ({error})") from error
        if not given or any(v.shape != (self.size,) or not np.isfinite(v).all() for v in given):
            raise self._refused("begin", None, f"is not a list of {self.size} finite numbers each")
        mean, std = self.prior
        return [np.clip(v, mean - FARTHEST * std, mean + FARTHEST * std) for v in given]

    def _refused(self, method: str, values: Array | None, said: str) -> BadTable:
        at = "" if values is None else " at " + ", ".join(
            f"{p.name} = {v:.6g}" for p, v in zip(self.parameters, values, strict=True)
        )  # fmt: skip
        return BadTable(f"{self.offender}, {method}{at}", said, REMEDY)
