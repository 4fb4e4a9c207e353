"""A joint type whose path is a function of the configuration: what most packages that add one derive from.

First guesses: a shape from the model's own, and a place where three samples, far enough from each other, lie as far
apart as three points of the path do; the best of many such places by a likelihood that is cut off where an outlier
begins. From there ``fit`` climbs, as for every other type.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.guesses import ROUGH, best_of, few, middle_rotation
from modcal_core.articulation.models.model import ArticulationModel
from modcal_core.articulation.models.parametric_motion import ParametricMotion
from modcal_core.articulation.models.shape import PathShape, ShapeParameter
from modcal_core.articulation.motion import Motion
from modcal_core.articulation.track import Track
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

__all__ = ["ParametricModel", "ShapeParameter"]
_TRIPLES = 6  # of samples that a guess is made from
_PLACES = 3  # of each three samples
_GRID = 48  # points of the path among which they are looked for
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
        _, T_path = own.checked_path(values, _GRID)
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
        if all(np.abs(cells - other).max() > _GRID // 12 for other in kept):
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
