"""A joint type whose path is a function of the configuration: what most packages that add one derive from.

A package derives from :class:`ParametricModel` and states the shape alone; where the object stands and how it is
grasped is found here. Every answer of a shape is looked at; what is none is refused with the package's name.

    T_world_handle(a) = T_world_object · pose(values, a),   R_world_handle(a) = R_world_object · R_pose(a) · R_grasp

What was seen at configuration a is unwound into the frame that the model moves along:

    e = B(a)ᵀ (p_seen − p(a)),   φ = log(B(a)ᵀ R_seen R_graspᵀ),   B = R_world_object R_pose(a)

Parameters are small changes: a shift of the object [m] and a turn of it about the middle of the track [rad], with
rotations a turn of the grasp [rad], and the shape in standard deviations of its prior. First guesses place a shape
where three samples lie as far apart as three points of the path.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.joint_motion import (
    ROUGH,
    ArticulationModel,
    Motion,
    best_of,
    few,
    middle_rotation,
    quick_log,
)
from modcal_core.articulation.joints import PathJoint
from modcal_core.articulation.track import Track
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3, so3, turned

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
        """``count`` configurations over the whole range, and the poses there. Raises BadTable where nothing moves."""
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


_GRID = 128  # configurations among which the nearest is looked for first
_NEWTON = 3  # steps from there
_SMALL = 1e-5  # of the range of configurations, for differences
_SMALL_VALUE = 1e-4  # standard deviations, likewise
# Curvatures at which Laplace's method gives what is bounded, where the track says nothing: all rotations of the object
# (8π²), and one metre of path along which it may lie, the unit in which all kinds count configurations.
_ALL_TURNS = 2.0 * math.pi / (8.0 * math.pi**2) ** (2.0 / 3.0)
_ONE_METRE = 2.0 * math.pi


@dataclass(frozen=True)
class ParametricMotion(Motion):
    """model: the shape. values (P,). T: T_world_object (4, 4). R: of the grasp (3, 3), None without rotations.

    middle: about which the object turns (3,) [m], the middle of the track.
    """

    model: PathShape
    values: Array
    T: Array
    R: Array | None
    middle: Array

    @property
    def kind(self) -> str:
        """Name of the joint type."""
        return self.model.name

    @property
    def size(self) -> int:
        """How many parameters it has."""
        return 6 + 3 * (self.R is not None) + self.model.size

    @property
    def start_turn(self) -> int:
        """Which parameter is the first of the three by which the grasp is turned."""
        return 6

    def moved(self, z: Array) -> ParametricMotion:
        """The motion with its parameters changed by z (size,), the shape kept within what its prior allows."""
        turn = turned(z[3:6])
        p = self.middle + z[:3] + turn @ (self.T[:3, 3] - self.middle)
        T = se3.transform(turn @ self.T[:3, :3], p)
        grasp = None if self.R is None else turned(z[6:9]) @ self.R
        mean, std = self.model.prior
        values = np.clip(
            self.values + std * z[self.size - self.model.size :], mean - FARTHEST * std, mean + FARTHEST * std
        )
        return ParametricMotion(self.model, values, T, grasp, self.middle)

    @cached_property
    def _path(self) -> tuple[Array, Array]:
        """Configurations (g,) over the whole range, and T_world_body (g, 4, 4) there."""
        a, T = self.model.checked_path(self.values, _GRID)
        return a, self.T @ T

    def bodies(self, a: Array) -> Array:
        """T_world_body (n, 4, 4) at configurations a (n,): the handle's, before it is grasped."""
        return self.T @ self.model.checked_pose(self.values, a)

    def poses(self, a: Array) -> Array:
        """T_world_handle (n, 4, 4) at configurations a (n,)."""
        T = self.bodies(a)
        if self.R is not None:
            T[:, :3, :3] = T[:, :3, :3] @ self.R
        return T

    def configurations(self, track: Track, sigma: tuple[float, float] = (1.0, 1.0)) -> Array:
        """Latent configurations (n,) that are most likely where noise is sigma, (m, rad): of all, then by Newton."""
        grid, T = self._path
        seen = track.positions
        cost = ((seen[:, None] - T[None, :, :3, 3]) ** 2).sum(axis=2) / sigma[0] ** 2
        oriented = self.R is not None and track.rotations is not None and sigma[1] < 1e6
        if oriented:
            assert track.rotations is not None
            assert self.R is not None
            # |log Q|² ≈ 3 − tr Q, the trace as a product of flat matrices
            bare = (track.rotations @ self.R.T).reshape(-1, 9)
            cost += (3.0 - bare @ T[:, :3, :3].reshape(-1, 9).T) / sigma[1] ** 2
        scale = np.array([1.0 / sigma[0]] * 3 + [1.0 / sigma[1]] * 3 * oriented)
        a, cell = grid[cost.argmin(axis=1)], grid[1] - grid[0]
        low, high = np.maximum(a - cell, grid[0]), np.minimum(a + cell, grid[-1])
        for _ in range(_NEWTON):
            e, by_a = (scale * x for x in self._seen(track, a, oriented))
            step = (e * by_a).sum(axis=1) / np.maximum((by_a * by_a).sum(axis=1), 1e-30)
            a = np.clip(a - step, low, high)
        return a

    def residuals(self, track: Track, a: Array) -> Array:
        """Residuals (n, 3) [m], or (n, 6) [m, rad] with rotations, unwound, at configurations a (n,)."""
        return self._unwound(track, self.bodies(a), self.R is not None and track.rotations is not None)

    def expanded(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array]:
        """Residuals and, beside them, their derivatives by the parameters (n, m, 1 + size); derivatives by a (n, m)."""
        oriented = self.R is not None and track.rotations is not None
        e, by_a = self._seen(track, a, oriented)
        both = np.zeros((*e.shape, 1 + self.size * derivatives))
        both[:, :, 0] = e
        if not derivatives:
            return both, by_a
        B = np.swapaxes(self.bodies(a)[:, :3, :3], 1, 2)
        both[:, :3, 1:4] = -B
        both[:, :3, 4:7] = B @ so3.hat(track.positions - self.middle)
        if oriented:
            both[:, 3:, 4:7] = -so3.left_jacobian_inverse(e[:, 3:]) @ B
            both[:, 3:, 7:10] = -so3.left_jacobian_inverse(-e[:, 3:])
        _, std = self.model.prior
        for i in range(self.model.size):
            ends = []
            for side in (1.0, -1.0):
                values = self.values.copy()
                values[i] += side * _SMALL_VALUE * std[i]
                ends.append(self._unwound(track, self.T @ self.model.checked_pose(values, a), oriented))
            both[:, :, 1 + self.size - self.model.size + i] = (ends[0] - ends[1]) / (2.0 * _SMALL_VALUE)
        return both, by_a

    def _seen(self, track: Track, a: Array, oriented: bool) -> tuple[Array, Array]:
        """Residuals (n, m) and their derivatives by the configuration (n, m)."""
        grid, _ = self._path
        small = _SMALL * (grid[-1] - grid[0])
        after, before = np.minimum(a + small, grid[-1]), np.maximum(a - small, grid[0])
        n = len(a)
        T = self.bodies(np.concatenate([a, after, before]))
        e = [self._unwound(track, part, oriented) for part in (T[:n], T[n : 2 * n], T[2 * n :])]
        return e[0], (e[1] - e[2]) / (after - before)[:, None]

    def _unwound(self, track: Track, T: Array, oriented: bool) -> Array:
        B = np.swapaxes(T[:, :3, :3], 1, 2)
        e = (B @ (track.positions - T[:, :3, 3])[:, :, None])[:, :, 0]
        if not oriented:
            return e
        assert track.rotations is not None
        assert self.R is not None
        return np.concatenate([e, quick_log(B @ track.rotations @ self.R.T)[0]], axis=1)

    def prior_terms(self) -> tuple[float, Array, Array]:
        """Half the squared distance from the prior, its gradient (size,) and its curvature (size,), diagonal."""
        mean, std = self.model.prior
        z = (self.values - mean) / std
        gradient, curvature = np.zeros(self.size), np.zeros(self.size)
        gradient[self.size - len(z) :] = z
        curvature[:3], curvature[3:6], curvature[self.size - len(z) :] = _ONE_METRE, _ALL_TURNS, 1.0
        return 0.5 * float(z @ z), gradient, curvature

    def log_prior(self) -> float:
        """What the prior's density has beside its exponent, in these coordinates."""
        return -math.log(8.0 * math.pi**2) - 0.5 * self.model.size * math.log(2.0 * math.pi)

    def joint(self, a: float = 0.0) -> PathJoint:
        """The shape in its place; configurations are the shape's own."""
        names = [p.name for p in self.model.parameters]
        values = dict(zip(names, self.values.tolist(), strict=True))
        return PathJoint(self.kind, values, self.T, self.R is not None, self.model.unit, self)

    def covariance(self, parameters: Array) -> dict[str, Array]:
        """Variance (1, 1) of each parameter of the shape."""
        _, std = self.model.prior
        own = (std**2 * np.diag(parameters)[self.size - self.model.size :]).tolist()
        return {p.name: np.array([[c]]) for p, c in zip(self.model.parameters, own, strict=True)}


__all__ = ["ParametricModel", "ShapeParameter"]
_TRIPLES = 6  # of samples that a guess is made from
_PLACES = 3  # of each three samples
_PARAMETRIC_GRID = 48  # points of the path among which they are looked for
_KEEP = 3  # guesses that are fitted
Rows: TypeAlias = NDArray[np.integer[Any]]


class ParametricModel(PathShape, ArticulationModel):
    """A joint type of one's own: derive from it, state name, parameters, lower, upper and unit, and write ``pose``.

    share: how often it is met among all that moves. As of screws, unless stated.
    """

    share: float = 0.02

    def guesses(self, track: Track, rng: np.random.Generator) -> Sequence[Motion]:
        """The best three of many shapes and places. Raises BadTable where an answer of the package is none."""
        some = few(track)
        return best_of(_places(some, self, rng), some, _KEEP)


def _places(track: Track, own: PathShape, rng: np.random.Generator) -> Iterator[ParametricMotion]:
    p = track.positions
    middle = np.median(p, axis=0)
    triples = list(_triples(p, rng))
    for values in own.checked_begin(track):
        _, T_path = own.checked_path(values, _PARAMETRIC_GRID)
        path = T_path[:, :3, 3]
        apart = np.linalg.norm(path[:, None] - path[None], axis=2)
        for rows in triples:
            for cells in _matches(apart, p[rows]):
                T = _laid(path[cells], p[rows])
                grasp = None
                if track.rotations is not None:
                    grasp = middle_rotation(
                        np.swapaxes(T[:3, :3] @ T_path[cells, :3, :3], 1, 2) @ track.rotations[rows]
                    )
                guess = ParametricMotion(own, values, T, grasp, middle)
                yield guess if grasp is None else _grasped(guess, track)


def _triples(p: Array, rng: np.random.Generator) -> Iterator[Rows]:
    """Rows (3,) of samples: the farthest apart with one between, and random ones."""
    first = int(np.argmax(((p - np.median(p, axis=0)) ** 2).sum(axis=1)))
    away = np.linalg.norm(p - p[first], axis=1)
    last = int(np.argmax(away))
    yield np.array([first, int(np.argmin(np.abs(away - 0.5 * away[last]))), last])
    for _ in range(_TRIPLES - 1):
        yield rng.choice(len(p), 3, replace=False)


def _matches(apart: Array, p: Array) -> Iterator[Rows]:
    """Cells (3,) of a path whose distances (g, g) are those of three points (3, 3), the best few that differ."""
    d = np.linalg.norm(p - p[[1, 2, 0]], axis=1)  # 0 to 1, 1 to 2, 2 to 0
    off = (apart - d[0])[:, :, None] ** 2 + (apart - d[1])[None] ** 2 + (apart - d[2])[:, None] ** 2
    kept: list[Rows] = []
    some = min(400, off.size - 1)
    order = np.argpartition(off.ravel(), some)[:some]
    for flat in order[np.argsort(off.ravel()[order])]:
        cells = np.array(np.unravel_index(int(flat), off.shape))
        if all(np.abs(cells - other).max() > _PARAMETRIC_GRID // 12 for other in kept):
            kept.append(cells)
            yield cells
        if len(kept) == _PLACES:
            return


def _laid(q: Array, p: Array) -> Array:
    """The transform (4, 4) that brings points q (3, 3) nearest to points p (3, 3) (Kabsch 1976)."""
    mq, mp = q.mean(axis=0), p.mean(axis=0)
    R = so3.nearest_rotation((p - mp).T @ (q - mq))
    return se3.transform(R, mp - R @ mq)


def _grasped(guess: ParametricMotion, track: Track) -> ParametricMotion:
    """The guess with the grasp that most of the samples show, as positions alone place them."""
    assert track.rotations is not None
    bodies = guess.bodies(guess.configurations(track, (ROUGH[0], 1e9)))[:, :3, :3]
    grasp = middle_rotation(np.swapaxes(bodies, 1, 2) @ track.rotations)
    return ParametricMotion(guess.model, guess.values, guess.T, grasp, guess.middle)
