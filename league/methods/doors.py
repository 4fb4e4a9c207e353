"""Joints of furniture from tracks of handles: Sturm's choice of an articulation model, and a line or a circle alone.

Sturm, Stachniss and Burgard (2011): rigid, prismatic, rotational, and a Gaussian process over the first principal
component; each by MLESAC with a stated σ, the one with the least BIC is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from league.arm import Array, pose
from league.task import Answer, Task

SIGMA = 5e-3  # m, of a reading, as stated by the authors for markers
APART = 0.02  # m: readings nearer to the last one that is kept say nothing new
OUTSIDE = 0.05  # share of readings that are gross, and the log density of where they lie [1/m³]
UNIFORM = np.log(1.0)
TRIES = 150  # samples for a first guess
REACH, POINTS = 3.0, 1441  # m of a line to both sides; of a path
LENGTHS = (0.05, 0.1, 0.2, 0.4)  # m, of the kernel


@dataclass(frozen=True)
class Path:
    """kind; points (K, 3) [m]; size: number of parameters; off: distances (N,) of readings from it [m]."""

    kind: str
    points: Array
    size: float
    off: Array


def sturm(task: Task) -> Answer:
    """The model of least BIC for each object."""
    return _each(task, _best)


def circle(task: Task) -> Answer:
    """Everything turns."""
    return _each(task, lambda p: _turning(p, np.random.default_rng(0)))


def line(task: Task) -> Answer:
    """Everything slides."""
    return _each(task, lambda p: _sliding(p, np.random.default_rng(0)))


def _each(task: Task, fit: Callable[[Array], Path]) -> Answer:
    paths = [fit(task.position[task.frame[task.train] == f]) for f in np.unique(task.frame)]
    named = tuple((path.kind, str(f)) for f, path in enumerate(paths))
    T = pose(np.eye(3), np.stack([path.points for path in paths]))
    return Answer(T, named=named, parameters=int(sum(path.size for path in paths)), oriented=False)


def _best(p: Array) -> Path:
    rng, kept = np.random.default_rng(0), [0]
    for k in range(1, len(p)):
        if np.linalg.norm(p[k] - p[kept[-1]]) > APART:
            kept.append(k)
    p = p[kept]
    found = [_still(p)]
    if len(p) > 3:
        found += [_sliding(p, rng), _turning(p, rng), _process(p)]
    return min(found, key=lambda one: -2.0 * _log_likelihood(one.off).sum() + one.size * np.log(len(p)))


def _log_likelihood(off: Array) -> Array:
    """Of distances (N,) [m]: a Gaussian, and a uniform share of gross readings."""
    good = np.log1p(-OUTSIDE) - 0.5 * (off / SIGMA) ** 2 - 3.0 * np.log(np.sqrt(2.0 * np.pi) * SIGMA)
    return np.logaddexp(good, np.log(OUTSIDE) + UNIFORM)


def _still(p: Array) -> Path:
    middle = np.median(p, axis=0)
    return Path("rigid", np.tile(middle, (POINTS, 1)), 3, np.linalg.norm(p - middle, axis=1))


def _refined(off: Callable[[Array], Array], starts: list[Array]) -> Array:
    """Parameters of the likeliest guess, improved with gross readings held down."""
    best = max(starts, key=lambda x: _log_likelihood(np.linalg.norm(off(x), axis=1)).sum())
    return least_squares(lambda x: off(x).ravel() / SIGMA, best, loss="cauchy", f_scale=2.0, max_nfev=60).x


def _sliding(p: Array, rng: np.random.Generator) -> Path:
    """x: a point of the line and its direction, whose length says nothing."""

    def unit(x: Array) -> Array:
        return x[3:] / np.maximum(np.linalg.norm(x[3:]), 1e-12)

    def off(x: Array) -> Array:
        return (p - x[:3]) - ((p - x[:3]) @ unit(x))[:, None] * unit(x)

    pairs = (p[rng.choice(len(p), 2, replace=False)] for _ in range(TRIES))
    x = _refined(off, [np.r_[a, b - a] for a, b in pairs if np.linalg.norm(b - a) > 1e-6])
    points = x[:3] + np.linspace(-REACH, REACH, POINTS)[:, None] * unit(x)
    return Path("prismatic", points, 6, np.linalg.norm(off(x), axis=1))


def _turning(p: Array, rng: np.random.Generator) -> Path:
    """x: the middle of the circle and an arm to it, the axis, and the radius."""

    def frame(x: Array) -> tuple[Array, Array]:
        axis = x[3:6] / np.linalg.norm(x[3:6])
        first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        first /= np.linalg.norm(first)
        return axis, np.stack([first, np.cross(axis, first)])

    def off(x: Array) -> Array:
        axis, plane = frame(x)
        across, high = (p - x[:3]) @ plane.T, (p - x[:3]) @ axis
        return np.stack([np.linalg.norm(across, axis=1) - x[6], high], axis=1)

    starts = []
    for _ in range(TRIES):
        a, b, c = p[rng.choice(len(p), 3, replace=False)]
        u, v = b - a, c - a
        n = np.cross(u, v)
        if n @ n < 1e-14:
            continue
        arm = (np.cross(n, u) * (v @ v) + np.cross(v, n) * (u @ u)) / (2.0 * n @ n)
        starts.append(np.r_[a + arm, n / np.linalg.norm(n), np.linalg.norm(arm)])
    x = _refined(off, starts)
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS)
    points = x[:3] + x[6] * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ frame(x)[1]
    return Path("revolute", points, 9, np.linalg.norm(off(x), axis=1))


def _process(p: Array) -> Path:
    """Positions over their first principal component, by a Gaussian process; straight on beyond what was seen. Its
    size as published: each reading that is kept counts.
    """
    middle = p.mean(axis=0)
    axis = np.linalg.svd(p - middle, full_matrices=False)[2][0]
    s = (p - middle) @ axis
    gap = s[:, None] - s[None]

    def weights(length: float) -> tuple[float, Array]:
        K = 0.05**2 * np.exp(-0.5 * (gap / length) ** 2) + SIGMA**2 * np.eye(len(s))
        alpha = np.linalg.solve(K, p - middle - np.outer(s, axis))
        cost = np.sum((p - middle - np.outer(s, axis)) * alpha) + 3.0 * np.linalg.slogdet(K)[1]
        return float(cost), alpha

    length = min(LENGTHS, key=lambda one: weights(one)[0])
    alpha = weights(length)[1]

    def at(t: Array) -> Array:
        k = 0.05**2 * np.exp(-0.5 * ((t[:, None] - s[None]) / length) ** 2)
        return middle + np.outer(t, axis) + k @ alpha

    points = at(np.linspace(s.min() - REACH, s.max() + REACH, POINTS))
    return Path("process", points, 2 + 3 * len(p), np.linalg.norm(p - at(s), axis=1))
