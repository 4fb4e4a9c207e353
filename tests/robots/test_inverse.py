"""Inverse kinematics: what it finds is there, within the limits; what is not there it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cells import slider_arm
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot, NotReachable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robot import Robot
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.mechanism import inverse, inverse_batch
from modcal_core.robots.urdf import read_chain

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
ARMS = {name: read_chain((ROBOTS / f"{name}.urdf").read_text()) for name in ("ur10", "panda")}
arms = pytest.mark.parametrize("chain", ARMS.values(), ids=ARMS)


def postures(chain: Chain, count: int, rng: np.random.Generator) -> Array:
    return rng.uniform(np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi), (count, chain.n))


def drawn(joints: int, rng: np.random.Generator) -> Chain:
    """An arm of right angles, or of any, with unequal limits; every third one has a sliding joint."""
    square = rng.random() < 0.5
    turns = (
        0.5 * np.pi * rng.choice([-1, 0, 1], (joints + 1, 1)) * [1, 0, 0]
        if square
        else rng.normal(size=(joints + 1, 3))
    )
    origins = se3.transform(so3.exp(turns), rng.uniform(0.0, 0.3, (joints + 1, 3)) * ([1, 0, 1] if square else 1))
    revolute = np.ones(joints, bool)
    revolute[rng.integers(3 * joints, size=1) % joints] = rng.random() < 0.7
    low, high = (np.where(revolute, rng.uniform(0.8, 3.0, joints), s) for s in (0.0, 0.5))
    return Chain.build([f"j{k}" for k in range(joints)], origins, None, revolute, -low, high)


@pytest.mark.slow
def test_no_reachable_pose_is_called_unreachable() -> None:
    """Every other pose is asked for without one of its six parts."""
    rng = np.random.default_rng(2)
    for chain in (*(drawn(5 + k % 4, rng) for k in range(6)), *ARMS.values()):
        robot = Robot.from_chain(chain)
        for k, q in enumerate(rng.uniform(chain.lower, chain.upper, (12, chain.n))):
            T, mask = chain_forward(chain, q), np.ones(6, bool)
            mask[rng.integers(6)] = k % 2 == 0
            found = robot.inverse(T, mask=mask)
            assert ((found >= chain.lower) & (found <= chain.upper)).all()
            assert np.abs(se3.error(chain_forward(chain, found)[None], T[None])[0, mask]).max() < 1e-9


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


def test_what_is_out_of_reach_is_missed_by_the_least(rng: np.random.Generator) -> None:
    chain = ARMS["ur10"]
    goal = chain_forward(chain, postures(chain, 1, rng)[0])
    goal[:3, 3] = [0.0, 0.0, 3.0]
    with pytest.raises(NotReachable, match="mm") as refusal:
        inverse(chain, goal, np.zeros(chain.n), rng=rng, restarts=3)
    assert 3.0 - chain.reach() - 0.5 < refusal.value.position < 3.0
    found = inverse_batch(chain, goal, postures(chain, 40, rng), (1, 1, 1, 0, 0, 0)).best()
    assert not found.met
    assert found.error[3:] == pytest.approx(0.0)
    nearest = np.linalg.norm(chain_forward(chain, postures(chain, 2000, rng))[:, :3, 3] - goal[:3, 3], axis=1).min()
    assert np.linalg.norm(found.error[:3]) < nearest


def test_limits_are_kept_where_they_are_the_only_obstacle(rng: np.random.Generator) -> None:
    """Poses that the same arm without limits reaches: within the limits an answer keeps them, or there is none."""
    chain = ARMS["ur10"]
    free = Chain.build(chain.names, chain.origins, chain.axes, chain.revolute)
    narrow = chain.with_limits(0.3 * chain.lower, 0.3 * chain.upper)
    refused = 0
    for q in postures(chain, 6, rng):
        T = chain_forward(chain, q)
        assert np.abs(chain_forward(chain, inverse(free, T, q + 0.02)) - T).max() < 1e-9
        try:
            found = inverse(narrow, T, 0.1 * q, rng=rng, restarts=2)
        except NotReachable:
            refused += 1
        else:
            assert ((found >= narrow.lower) & (found <= narrow.upper)).all()
            assert np.abs(chain_forward(chain, found) - T).max() < 1e-9
    assert refused > 0


def test_an_arm_of_five_joints_reaches_positions_and_not_every_pose(rng: np.random.Generator) -> None:
    arm = slider_arm()
    T = chain_forward(arm, np.zeros(5)) @ se3.transform(so3.exp([0.02, 0.03, 0.01]), [0.01, 0.0, 0.0])
    only_position = (True, True, True, False, False, False)
    assert np.abs(chain_forward(arm, inverse(arm, T, np.zeros(5), only_position))[:3, 3] - T[:3, 3]).max() < 1e-9
    with pytest.raises(NotReachable):
        inverse(arm, T, np.zeros(5), rng=rng, restarts=3)


def test_turns_are_counted_from_the_seed() -> None:
    chain = ARMS["ur10"]
    q = np.array([4.0, -1.0, 1.2, -0.7, 0.9, 5.5])
    for turns in (0.0, -2.0 * np.pi):
        start = q + 0.05
        start[5] += turns
        assert inverse(chain, chain_forward(chain, q), start)[5] == pytest.approx(5.5 + turns, abs=1e-8)


def test_many_starts_for_each_pose(rng: np.random.Generator) -> None:
    chain = slider_arm()
    q = postures(chain, 20, rng)
    goals = chain_forward(chain, q)
    found = inverse_batch(chain, goals[:, None], postures(chain, 60, rng))
    assert found.q.shape == (20, 60, chain.n)
    assert np.abs(chain_forward(chain, found.best().q) - goals).max() < 1e-9
    assert ((found.q >= chain.lower) & (found.q <= chain.upper)).all()
    # what it says of itself is what the arm does
    distance = np.linalg.norm(chain_forward(chain, found.q)[..., :3, 3] - goals[:, None, :3, 3], axis=-1)
    assert np.abs(np.linalg.norm(found.error[..., :3], axis=-1) - distance).max() < 1e-12
    assert (found.met == (np.abs(found.error).max(axis=-1) <= 1e-10)).all()
    there = inverse_batch(chain, goals, q)  # a posture that is there already stays
    assert there.met.all()
    assert np.array_equal(there.q, q)


def _pose(R: ArrayLike, p: ArrayLike = (0.4, 0.1, 0.3)) -> Array:
    return se3.transform(np.asarray(R, dtype=float), np.asarray(p))


@pytest.mark.parametrize(
    ("pose", "options", "match"),
    [
        (_pose(np.eye(3), (np.nan, 0.0, 0.0)), {}, "not finite"),
        (_pose(np.diag([1.0, 1.0, -1.0])), {}, "no rigid motion"),
        (_pose(1.01 * np.eye(3)), {}, "no rigid motion"),
        (2.0 * _pose(np.eye(3)), {}, "no rigid motion"),
        (np.eye(3), {}, "shape"),
        (_pose(np.eye(3)), {"mask": (0,) * 6}, "mask"),
        (_pose(np.eye(3)), {"mask": (1, 1, 1)}, "mask"),
        (_pose(np.eye(3)), {"near": (0.0, np.nan) * 3}, "near"),
    ],
)
def test_what_is_no_pose_is_refused_as_such(pose: Array, options: dict[str, ArrayLike], match: str) -> None:
    with pytest.raises(BadRobot, match=match):
        Robot.from_chain(ARMS["ur10"]).inverse(pose, **options)  # type: ignore[arg-type]
