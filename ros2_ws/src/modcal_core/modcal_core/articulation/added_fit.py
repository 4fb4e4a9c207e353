"""Maximum likelihood of a package's model: where its object stands, how it is grasped, and its shape.

First guesses: a shape from the model's own, and a place where three samples, far enough from each other, lie as far
apart as three points of the path do; the best of many such places by a likelihood that is cut off where an outlier
begins. From there ``fit`` climbs, as for the kinds of the house.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.added import Guarded
from modcal_core.articulation.added_motion import AddedMotion
from modcal_core.articulation.fit import climb, settled
from modcal_core.articulation.seeds import ROUGH, best_of, middle_rotation
from modcal_core.articulation.track import Track
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

_SCORED = 50  # samples that a guess is scored on
_TRIPLES = 6
_PLACES = 3  # of each three samples
_GRID = 48  # points of the path among which they are looked for
_KEEP = 3
Rows: TypeAlias = NDArray[np.integer[Any]]


@dataclass(frozen=True)
class AddedJoint:
    """A model of a package in its place: ``T_world_handle = pose(a)`` at the model's own configuration a.

    kind: its name. values: by parameter. T_world_object (4, 4). oriented: whether rotations were seen. unit: of a.
    """

    kind: str
    values: dict[str, float]
    T_world_object: Array
    oriented: bool
    unit: str
    motion: AddedMotion = field(repr=False)

    def pose(self, a: Array) -> Array:
        """T_world_handle (n, 4, 4) at configurations a (n,)."""
        return self.motion.poses(np.asarray(a, dtype=float))

    def position(self, a: Array) -> Array:
        """Positions of the handle (n, 3) [m] at configurations a (n,)."""
        return self.pose(a)[:, :3, 3]


@dataclass(frozen=True)
class AddedFit:
    """model; configurations (n,), the model's own; weights (n,), near 0 for an outlier; std: of each value.

    sigma_position [m], sigma_rotation [rad or nan], log_likelihood: as in ``fit.Fit``. parameters: covariance (size,
    size) of the motion's: shift, turn, turn of the grasp, shape in standard deviations of its prior.
    """

    model: AddedJoint
    configurations: Array
    std: dict[str, float]
    log_likelihood: float
    weights: Array
    sigma_position: float
    sigma_rotation: float
    motion: AddedMotion = field(repr=False)
    parameters: Array = field(repr=False)

    def data(self) -> dict[str, Any]:
        """Values, standard deviations and units, by parameter."""
        given = self.motion.own.model.parameters
        return {p.name: {"value": self.model.values[p.name], "std": self.std[p.name], "unit": p.unit} for p in given}


def fit_added(track: Track, own: Guarded, rng: np.random.Generator) -> AddedFit:
    """The most likely shape and place of a model. rng: picks samples for first guesses. Raises BadTable as it does."""
    rows = np.unique(np.linspace(0, len(track) - 1, _SCORED).round().astype(int))
    starts = best_of(_guesses(track.part(rows), own, rng), track.part(rows), _KEEP)
    best = min((climb(track, start, True) for start in starts), key=lambda state: state.cost)
    at, motion = settled(track, best, True), best.motion
    assert isinstance(motion, AddedMotion)
    names = [p.name for p in own.model.parameters]
    spread = own.prior[1] * np.sqrt(np.diag(at.parameters))[motion.size - own.size :]
    values = dict(zip(names, motion.values.tolist(), strict=True))
    joint = AddedJoint(own.name, values, motion.T, motion.R is not None, own.model.unit, motion)
    return AddedFit(joint, at.configurations, dict(zip(names, spread.tolist(), strict=True)), at.log_likelihood,
                    at.weights, at.sigma_position, at.sigma_rotation, motion, at.parameters)  # fmt: skip


def _guesses(track: Track, own: Guarded, rng: np.random.Generator) -> Iterator[AddedMotion]:
    p = track.positions
    middle = np.median(p, axis=0)
    triples = list(_triples(p, rng))
    for values in own.begin(track):
        _, T_path = own.path(values, _GRID)
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
                guess = AddedMotion.of(own, values, T, grasp, middle)
                yield guess if grasp is None else _grasped(guess, track)


def _triples(p: Array, rng: np.random.Generator) -> Iterator[Rows]:
    """Rows (3,) of samples: the farthest apart with one between, and others by chance."""
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


def _grasped(guess: AddedMotion, track: Track) -> AddedMotion:
    """The guess with the grasp that most of the samples show, as positions alone place them."""
    assert track.rotations is not None
    bodies = guess.bodies(guess.configurations(track, (ROUGH[0], 1e9)))[:, :3, :3]
    grasp = middle_rotation(np.swapaxes(bodies, 1, 2) @ track.rotations)
    return AddedMotion.of(guess.own, guess.values, guess.T, grasp, guess.middle)
