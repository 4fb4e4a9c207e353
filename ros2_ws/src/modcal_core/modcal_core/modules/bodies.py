"""What the modules look like and weigh: a tube from flange to flange, round every corner, as heavy as stated."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.modules.library import ModuleType

_SHORTEST = 1e-6  # m; a shorter tube is not drawn
_LIGHTEST = 1e-3  # kg; what a simulator takes for a body that states no mass


@dataclass(frozen=True)
class Tube:
    """A cylinder about z of its frame. T: its middle in the module's input frame, (4, 4) [m]; length, radius [m]."""

    T: Array
    length: float
    radius: float


@dataclass(frozen=True)
class ModuleBody:
    """Tubes of a module, and what they weigh. mass [kg]; centre (3,) [m]; inertia (3, 3) about it [kg m²]."""

    tubes: tuple[Tube, ...]
    mass: float
    centre: Array
    inertia: Array


def path(kind: ModuleType, size: int) -> Array:
    """Points of the body's middle line from the input to the output flange, (k, 3) [m], in the input frame."""
    length = kind.length(size)
    return np.stack([np.zeros(3), *(e.at(length) for e in kind.elbows), kind.output.at(length)])


def body(kind: ModuleType, size: int) -> ModuleBody:
    """The body of a module with this length code, its mass spread evenly along the tubes."""
    points = path(kind, size)
    tubes = []
    for a, b in pairwise(points):
        length = float(np.linalg.norm(b - a))
        if length > _SHORTEST:
            tubes.append(Tube(se3.transform(_along((b - a) / length), 0.5 * (a + b)), length, kind.radius))
    mass = max(kind.mass + kind.mass_per_metre * kind.length(size), _LIGHTEST)
    if not tubes:  # a plate without height
        tubes.append(Tube(np.eye(4), 0.005, kind.radius))
    share = mass * np.array([t.length for t in tubes]) / sum(t.length for t in tubes)
    middles = np.stack([t.T[:3, 3] for t in tubes])
    centre = share @ middles / mass
    inertia = np.zeros((3, 3))
    for m, tube, r in zip(share, tubes, middles - centre, strict=True):
        across = m * (3.0 * tube.radius**2 + tube.length**2) / 12.0
        R = tube.T[:3, :3]
        inertia += R @ np.diag([across, across, 0.5 * m * tube.radius**2]) @ R.T
        inertia += m * (r @ r * np.eye(3) - np.outer(r, r))  # Steiner
    return ModuleBody(tuple(tubes), mass, centre, inertia)


def _along(direction: Array) -> Array:
    """The least rotation (3, 3) that brings z to a unit direction."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine, cosine = float(np.linalg.norm(axis)), float(direction[2])
    if sine < 1e-12:
        return np.eye(3) if cosine > 0.0 else np.diag([1.0, -1.0, -1.0])
    return so3.exp(axis / sine * np.arctan2(sine, cosine))
