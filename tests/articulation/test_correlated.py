"""What a fit says of its own accuracy where neighbours in time share their noise, and what a turn weighs beside a shift."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import ideal
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from modcal_core.articulation.fit import fit
from modcal_core.articulation.models.registry import joint
from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array


def shared(n: int, rho: float, rng: np.random.Generator) -> Array:
    """Noise (n, 3) of unit size, of which each sample keeps so much from the one before."""
    out = rng.normal(size=(n, 3))
    for k in range(1, n):
        out[k] = rho * out[k - 1] + np.sqrt(1.0 - rho * rho) * out[k]
    return out


@pytest.mark.slow
def test_noise_that_neighbours_share_is_not_counted_as_independent() -> None:
    # n samples with correlation ρ from one to the next say as much as n (1 − ρ) / (1 + ρ) independent ones
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        seen = ideal("prismatic", np.linspace(0.0, 0.4, 160), rng)
        found = fit(Track(seen.positions + 1e-3 * shared(160, 0.7, rng)), "prismatic", rng, prior=False)
        away = found.model.axis * np.sign(found.model.axis @ seen.axis) - seen.axis
        squares.append(float(away @ np.linalg.pinv(found.covariance["axis"], rcond=1e-6) @ away))
    # two directions across the axis, so 2 on the average; the mean of 60 scatters by 13 %, and the correlation that each
    # track shows by a fifth. Counted once instead of twice it would give 6
    assert 1.2 < np.mean(squares) < 3.2


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.03, 0.4, 1.5])
def test_position_and_rotation_agree_on_the_nearest_configuration(radius: float) -> None:
    """A turn of 1 rad weighs as much as a shift of a hand's length, 0.1 m."""
    hinge = joint("revolute", np.array([[1, 0, 0, radius], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
                       np.array([0.0, 0.0, 1.0]), np.zeros(3))  # fmt: skip
    by_place, by_turn = 0.50, 0.56
    seen = np.eye(4)
    seen[:3, 3] = radius * np.cos(by_place), radius * np.sin(by_place), 0.0
    seen[:3, :3] = Rotation.from_rotvec([0.0, 0.0, by_turn]).as_matrix()

    def apart(a: float) -> float:
        place = radius * np.array([np.cos(a), np.sin(a), 0.0])
        turn = Rotation.from_matrix(seen[:3, :3]) * Rotation.from_rotvec([0.0, 0.0, -a])
        return float(np.sum((place - seen[:3, 3]) ** 2) + (0.1 * turn.magnitude()) ** 2)

    nearest = minimize_scalar(apart, bounds=(0.4, 0.7), method="bounded", options={"xatol": 1e-9}).x
    assert float(hinge.configuration(seen)) == pytest.approx(nearest, abs=1e-4)
