"""Three planes that the tool touches, and nothing else: the arm's shape comes out, its scale is left open and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from instruments import worlds
from instruments.test_recovery import PLANES
from instruments.worlds import Reading
from scipy.optimize import brentq

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability
from modcal_core.calibration.fit import identify
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_nodes.simulation.world import World


def touching(w: World, height: Reading, count: int, rng: np.random.Generator) -> Array:
    """Postures (count, n) in which MuJoCo's tool lies in a plane: one joint of a random posture turned until it does."""
    out: list[Array] = []
    while len(out) < count:
        q = worlds.postures(ur10(), 1, rng)[0]
        j = int(rng.integers(0, 5))

        def at(x: float, q: Array = q, j: int = j) -> float:
            turned = q.copy()
            turned[j] = x
            return float(height(w.tool_in_base(turned))[0])

        grid = np.linspace(-3.0, 3.0, 7)
        heights = [at(x) for x in grid]
        for k in range(6):
            if heights[k] * heights[k + 1] < 0.0:
                q[j] = brentq(at, grid[k], grid[k + 1], xtol=1e-10)
                out.append(q)
                break
    return np.array(out)


def recorded(w: World, rng: np.random.Generator) -> Samples:
    parts = []
    for k, plane in enumerate(PLANES):
        q = touching(w, plane.read, 60, rng)
        part = worlds.samples_of(ur10(), q, w.tool_in_base(q), plane.frame, "touch", lambda _: np.zeros(1), 3e-5, rng)
        parts.append(replace(part, stamps=part.stamps + 1000.0 * k))
    return parts[0].followed_by(parts[1]).followed_by(parts[2])


def apart(a: Array, b: Array) -> tuple[float, float]:
    """(by how much a must grow to be b, RMS distance then left), for points (N, 3), wherever they are placed."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    growth = float(S.sum() / np.sum(a**2))
    return growth, float(np.sqrt(np.mean(np.sum((b - growth * a @ (U @ Vt).T) ** 2, axis=1))))


@pytest.mark.slow
def test_contact_alone_shows_the_shape_of_the_arm() -> None:
    w = worlds.world(1)
    samples = recorded(w, np.random.default_rng(1))
    start = fit_cell(ur10(), samples, Cell()).model
    fit = identify(start, samples, choose_parameters(start, views_of(samples)).parameters)
    assert 2e-5 < fit.noise.others["touch"] < 4e-5
    q = worlds.postures(ur10(), 200, np.random.default_rng(9))
    true = w.tool_in_base(q)[:, :3, 3]
    growth, left = apart(fit.model.predict(q)[:, :3, 3], true)
    _, before = apart(start.predict(q)[:, :3, 3], true)
    assert left < 5e-5 < 0.05 * before
    assert abs(growth - 1.0) < 3e-3  # no better than the drawing's lengths, which is what is expected of them
    seen = identifiability(fit)
    assert (seen.parameters - seen.rank, len(seen.unobservable)) == (1, 1)
