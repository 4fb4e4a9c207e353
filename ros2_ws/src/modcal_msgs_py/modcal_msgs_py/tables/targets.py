"""Several targets on one tool: points of a table that keep their distances while they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_msgs_py.tables.candidates import Body, Numbers
from modcal_msgs_py.tables.rigid import rigid_poses

_MOVES = 0.05  # of what the liveliest point moves; less is a target that stands
_RIGID = 2e-3  # of what the points move, by which their distance may scatter
_APART = 20.0  # times that scatter, that points and the line through them must be apart
_MIN = 3  # targets that make a pose
_MAD = 1.4826  # standard deviation of a Gaussian whose median absolute deviation is one


def rigid_bodies(numbers: Numbers, places: Sequence[Body]) -> list[Body]:
    """Bodies of three targets or more among labelled points, the largest first; none where no three are rigid."""
    triples = list(dict.fromkeys(body.position for body in places if body.named))
    if len(triples) < _MIN:
        return []
    points = {triple: numbers.values[:, list(triple)] for triple in triples}
    moves = {triple: _motion(p) for triple, p in points.items()}
    most = max(moves.values())
    alive = [triple for triple in triples if moves[triple] > _MOVES * most > 0.0]
    scatter = {pair: _scatter(points[pair[0]], points[pair[1]]) for pair in combinations(alive, 2)}
    near = _RIGID * most

    def rigid(a: tuple[int, int, int], b: tuple[int, int, int]) -> bool:
        distance, off = scatter[(a, b) if (a, b) in scatter else (b, a)]
        return off < near and distance > _APART * off

    found: list[Body] = []
    for i, first in enumerate(alive):
        group = [first]
        for other in alive[i + 1 :]:
            if all(rigid(known, other) for known in group):
                group.append(other)
        if len(group) < _MIN or any(set(group) <= {t for _, t in body.points} for body in found):
            continue
        rows = np.isfinite(np.concatenate([points[t] for t in group], axis=1)).all(axis=1)
        if rows.sum() < _MIN:
            continue
        shape = rigid_poses(np.stack([points[t][rows] for t in group], axis=1))[1]
        if np.linalg.svd(shape, compute_uv=False)[1] < _APART * max(
            scatter[pair][1] for pair in combinations(group, 2)
        ):
            continue  # on a line: turns about it do not show
        names = _names(numbers, group)
        found.append(replace(Body(first, None, True), points=tuple(zip(names, group, strict=True))))
    return sorted(found, key=lambda body: -len(body.points))


def _motion(p: Array) -> float:
    p = p[np.isfinite(p).all(axis=1)]
    return float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1))) if len(p) else 0.0


def _scatter(a: Array, b: Array) -> tuple[float, float]:
    """(distance, its scatter) of two points, medians."""
    d = np.linalg.norm(a - b, axis=1)
    d = d[np.isfinite(d)]
    if len(d) < _MIN:
        return 0.0, np.inf
    middle = float(np.median(d))
    return middle, _MAD * float(np.median(np.abs(d - middle)))


def _names(numbers: Numbers, group: Sequence[tuple[int, int, int]]) -> list[str]:
    out: list[str] = []
    for i, triple in enumerate(group):
        axis = numbers.labels[triple[0]].axis
        stem = "_".join(axis[1].split()) if axis is not None else ""
        name = stem or f"target_{i + 1}"
        out.append(name if name not in out else f"{name}_{i + 1}")
    return out
