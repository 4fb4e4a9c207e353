"""Kinematics against differences, and against an independent library that reads the same URDFs with its own parser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from cells import slider_arm
from finite_differences import assert_jacobian

from modcal_core.geometry import se3
from modcal_core.geometry.single import pose_error
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import (
    body_jacobian,
    chain_forward,
    frames,
    pose_and_jacobian,
    spatial_jacobian,
)
from modcal_core.robots.urdf import read_chain

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
ARMS = ("ur10", "panda", "xarm7", "iiwa14")


def urdf(arm: str) -> str:
    return (ROBOTS / f"{arm}.urdf").read_text()


def chain_of(arm: str) -> Chain:
    return slider_arm() if arm == "sliders" else read_chain(urdf(arm))


@pytest.mark.parametrize("arm", ARMS)
def test_against_pinocchio(arm: str, rng: np.random.Generator) -> None:
    chain = chain_of(arm)
    model = pin.buildModelFromXML(urdf(arm))
    data = model.createData()
    frame = model.getFrameId(chain.tip)
    ids = [model.getJointId(name) for name in chain.names]
    order = [model.joints[i].idx_q for i in ids]
    q = rng.uniform(chain.lower, chain.upper, (100, chain.n))
    T, J_space, J_body = chain_forward(chain, q), spatial_jacobian(chain, q), body_jacobian(chain, q)
    for i in range(len(q)):
        configuration = pin.neutral(model)
        configuration[order] = q[i]
        pin.computeJointJacobians(model, data, configuration)
        pin.updateFramePlacements(model, data)
        assert np.abs(T[i] - data.oMf[frame].homogeneous).max() < 1e-12
        world = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.WORLD)[:, order]
        local = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL)[:, order]
        assert np.abs(J_space[i] - world).max() < 1e-12
        assert np.abs(J_body[i] - local).max() < 1e-12
        if i < 20:  # the frame before each joint is where Pinocchio puts it
            before = [data.oMi[model.parents[j]] * model.jointPlacements[j] for j in ids]
            places = frames(chain, q[i : i + 1])
            for place, placed in enumerate([*before, data.oMf[frame]]):
                assert np.abs(places.transform(place)[0] - placed.homogeneous).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("arm", [*ARMS, "sliders"])
def test_jacobians_are_derivatives(arm: str, rng: np.random.Generator) -> None:
    chain = chain_of(arm)
    for q in rng.uniform(chain.lower, chain.upper, (5, chain.n)):
        T = chain_forward(chain, q)
        assert_jacobian(
            lambda x, T=T: se3.log(chain_forward(chain, x) @ se3.inverse(T)), spatial_jacobian(chain, q[None])[0], q
        )
        assert_jacobian(
            lambda x, T=T: se3.log(se3.inverse(T) @ chain_forward(chain, x)), body_jacobian(chain, q[None])[0], q
        )


@pytest.mark.parametrize("arm", [*ARMS, "sliders"])
def test_product_of_exponentials(arm: str, rng: np.random.Generator) -> None:
    chain = chain_of(arm)
    q = rng.uniform(chain.lower, chain.upper, (20, chain.n))
    T = np.tile(np.eye(4), (20, 1, 1))
    for k in range(chain.n):
        T = T @ se3.exp(chain.spatial_twists[k] * q[:, k, None])
    assert np.abs(T @ chain.home - chain_forward(chain, q)).max() < 1e-13


@pytest.mark.parametrize(("arm", "size"), [("panda", 0.0), ("sliders", 1e-4), ("ur10", 0.3)])
def test_frames_of_one_posture_are_those_of_many(arm: str, size: float, rng: np.random.Generator) -> None:
    """With motions of any size put in at some places, about the joint's axis alone at one of them."""
    chain = chain_of(arm)
    q = rng.uniform(-2.0, 2.0, (5, chain.n))
    twists = {k: size * rng.normal(size=(6, 5)) for k in (0, 2, chain.n)}
    twists[2][:5] = 0.0
    many, J, T = frames(chain, q, twists), body_jacobian(chain, q), chain_forward(chain, q)
    for i in range(5):
        tip, J_one = pose_and_jacobian(chain, q[i])
        assert np.abs(tip - T[i]).max() < 1e-12
        assert np.abs(J_one - J[i]).max() < 1e-12
        assert np.abs(pose_error(tip, T[0]) - se3.error(tip[None], T[:1])[0]).max() < 1e-9
        one = frames(chain, q[i : i + 1], {k: twist[:, i : i + 1] for k, twist in twists.items()})
        assert one.axes.shape == (chain.n + 1, 3, 3, 1)
        assert np.abs(one.axes[..., 0] - many.axes[..., i]).max() < 1e-14
        assert np.abs(one.p[..., 0] - many.p[..., i]).max() < 1e-14


def test_arrays_of_a_chain_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        chain_of("ur10").origins[0, 0, 0] = 2.0
