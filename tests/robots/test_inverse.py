"""Inverse kinematics: what it finds is there, within the limits; what is not there it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cells import slider_arm

from modcal_core.errors import NotReachable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.inverse_kinematics import ALL_SIX, inverse
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
ARMS = {name: read_chain((ROBOTS / f"{name}.urdf").read_text()) for name in ("ur10", "panda")}
arms = pytest.mark.parametrize("chain", ARMS.values(), ids=ARMS)


def postures(chain: Chain, count: int, rng: np.random.Generator) -> Array:
    return rng.uniform(np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi), (count, chain.n))


def within(chain: Chain, q: Array) -> bool:
    return bool((q >= chain.lower).all() and (q <= chain.upper).all())


@pytest.mark.slow
@arms
def test_it_undoes_forward_kinematics_from_anywhere(chain: Chain) -> None:
    missed = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        q, start = postures(chain, 2, rng)
        T = chain_forward(chain, q)
        try:
            found = inverse(chain, T, start, rng=rng, restarts=200)
        except NotReachable:
            missed += 1
            continue
        assert np.abs(chain_forward(chain, found) - T).max() < 1e-9
        assert within(chain, found)
    assert missed <= 1  # seldom no try ends at a pose that only postures close to a limit reach


@pytest.mark.slow
@arms
def test_a_step_away_stays_near(chain: Chain, rng: np.random.Generator) -> None:
    near = 0
    for q in 0.9 * postures(chain, 50, rng) + 0.1 * np.clip(0.0, chain.lower, chain.upper):
        start = np.clip(q + rng.uniform(-0.05, 0.05, chain.n), chain.lower, chain.upper)
        T = chain_forward(chain, q)
        found = inverse(chain, T, start, rng=rng)
        assert np.abs(chain_forward(chain, found) - T).max() < 1e-9
        near += int(np.abs(found - start).max() < 0.5)
    # at a singularity joints travel far for nothing, or another start is needed: seldom
    assert near >= 47


@pytest.mark.slow
@arms
def test_what_is_out_of_reach_is_refused_with_what_is_missing(chain: Chain, rng: np.random.Generator) -> None:
    T = chain_forward(chain, postures(chain, 1, rng)[0])
    T[:3, 3] = [0.0, 0.0, 3.0]
    with pytest.raises(NotReachable, match="mm") as refusal:
        inverse(chain, T, np.clip(np.zeros(chain.n), chain.lower, chain.upper), rng=rng, restarts=3)
    assert 3.0 - chain.reach() - 0.5 < refusal.value.position < 3.0


@pytest.mark.slow
@arms
def test_limits_are_kept_where_they_are_the_only_obstacle(chain: Chain, rng: np.random.Generator) -> None:
    """Poses that the same arm without limits reaches: within the limits an answer keeps them, or there is none."""
    free = Chain.build(chain.names, chain.origins, chain.axes, chain.revolute)
    narrow = Chain.build(chain.names, chain.origins, chain.axes, chain.revolute, 0.3 * chain.lower, 0.3 * chain.upper)
    refused = 0
    for q in postures(chain, 12, rng):
        T = chain_forward(chain, q)
        assert np.abs(chain_forward(chain, inverse(free, T, q + 0.02)) - T).max() < 1e-9
        try:
            found = inverse(narrow, T, 0.1 * q, rng=rng, restarts=2)
        except NotReachable:
            refused += 1
        else:
            assert within(narrow, found)
            assert np.abs(chain_forward(chain, found) - T).max() < 1e-9
    assert refused > 0


def test_a_mask_leaves_a_direction_free(rng: np.random.Generator) -> None:
    chain = ARMS["ur10"]
    mask = (True, True, True, True, True, False)
    for q in postures(chain, 10, rng):
        T = chain_forward(chain, q)
        found = chain_forward(chain, inverse(chain, T, q + 0.3, mask=mask, rng=rng))
        assert np.abs(found[:3, 2:] - T[:3, 2:]).max() < 1e-9  # position, and the direction of z
    # an arm of five joints reaches positions, and says so where six are asked for
    arm = slider_arm()
    T = chain_forward(arm, np.zeros(5))
    T = T @ se3.transform(so3.exp([0.02, 0.03, 0.01]), [0.01, 0.0, 0.0])
    only_position = (True, True, True, False, False, False)
    assert np.abs(chain_forward(arm, inverse(arm, T, np.zeros(5), only_position))[:3, 3] - T[:3, 3]).max() < 1e-9
    with pytest.raises(NotReachable):
        inverse(arm, T, np.zeros(5), ALL_SIX, rng=rng, restarts=3)


def test_turns_are_counted_from_the_seed() -> None:
    chain = ARMS["ur10"]
    q = np.array([4.0, -1.0, 1.2, -0.7, 0.9, 5.5])
    for turns in (0.0, -2.0 * np.pi):
        start = q + 0.05
        start[5] += turns
        assert inverse(chain, chain_forward(chain, q), start)[5] == pytest.approx(5.5 + turns, abs=1e-8)
