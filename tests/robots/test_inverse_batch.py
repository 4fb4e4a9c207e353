"""Many starts at once: what is met is met, and what is not is missed by the least."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cells import slider_arm

from modcal_core.robots.chain import Chain
from modcal_core.robots.inverse_kinematics import inverse_batch
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
ARMS = {name: read_chain((ROBOTS / f"{name}.urdf").read_text()) for name in ("ur10", "panda")} | {
    "sliders": slider_arm()
}
arms = pytest.mark.parametrize("chain", ARMS.values(), ids=ARMS)


def drawn(chain: Chain, count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi), (count, chain.n))


@pytest.mark.slow
@arms
def test_many_starts_for_each_pose(chain: Chain, rng: np.random.Generator) -> None:
    q = drawn(chain, 20, rng)
    goals = chain_forward(chain, q)
    found = inverse_batch(chain, goals[:, None], drawn(chain, 60, rng))
    assert found.q.shape == (20, 60, chain.n)
    assert found.met.shape == (20, 60)
    best = found.best()
    assert best.met.all()
    assert np.abs(chain_forward(chain, best.q) - goals).max() < 1e-9
    assert (found.q >= chain.lower).all()
    assert (found.q <= chain.upper).all()
    # what it says of itself is what the arm does
    left = chain_forward(chain, found.q)
    distance = np.linalg.norm(left[..., :3, 3] - goals[:, None, :3, 3], axis=-1)
    assert np.abs(np.linalg.norm(found.error[..., :3], axis=-1) - distance).max() < 1e-12
    assert (found.met == (np.abs(found.error).max(axis=-1) <= 1e-10)).all()


@pytest.mark.slow
@arms
def test_what_cannot_be_reached_is_missed_by_the_least(chain: Chain, rng: np.random.Generator) -> None:
    goal = chain_forward(chain, drawn(chain, 1, rng)[0])
    goal[:3, 3] = [0.0, 0.0, 1.5 * chain.reach()]
    only_position = (True,) * 3 + (False,) * 3
    found = inverse_batch(chain, goal, drawn(chain, 40, rng), only_position).best()
    assert not found.met
    assert found.error[3:] == pytest.approx(0.0)
    nearest = np.linalg.norm(chain_forward(chain, drawn(chain, 2000, rng))[:, :3, 3] - goal[:3, 3], axis=1).min()
    assert np.linalg.norm(found.error[:3]) < nearest


def test_a_posture_that_is_there_already_stays(rng: np.random.Generator) -> None:
    chain = ARMS["ur10"]
    q = drawn(chain, 5, rng)
    found = inverse_batch(chain, chain_forward(chain, q), q)
    assert found.met.all()
    assert np.array_equal(found.q, q)
