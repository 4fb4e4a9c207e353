"""What the live view draws, against MuJoCo's arm and the law of the normal distribution."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from cells import NOISE_M, samples_of, ur10
from correction.test_compensation import STEEP, calibration_of, moment, true_model

from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import NoiseModel
from modcal_core.correction.correction import Correction
from modcal_core.correction.picture import ellipsoid, enlarged_axes, joint_axes, known_to, residuals, tool_ellipsoid
from modcal_core.errors import BadCommand
from modcal_core.geometry import se3
from modcal_core.robots.kinematics import chain_forward
from modcal_nodes.simulation.mjcf import body_name
from modcal_nodes.simulation.world import World

SPREAD = NoiseModel(NOISE_M, 1e-4)
T_TIP_TOOL = se3.exp(np.array([0.05, 0.03, 0.12, 0.4, -0.2, 0.1]))


def test_misses_are_how_far_mujocos_tool_is_from_the_drawings(rng: np.random.Generator) -> None:
    """In the base link: from where the drawing has the tool to where MuJoCo has it, however the tracker stands."""
    chain = ur10()
    world = World(chain, rng, 5e-4, 1e-3, se3.exp(rng.normal(size=6)), T_TIP_TOOL)
    q = rng.uniform(-2.0, 2.0, (40, 6))
    seen = samples_of(chain, q, world.tool_in_tracker(q))
    drawn = Model(chain, ("tracker",), world.T_tracker_base[None], T_TIP_TOOL)
    of = residuals(drawn, seen, SPREAD)
    expected = (chain_forward(chain, q) @ T_TIP_TOOL)[:, :3, 3]
    assert np.abs(of.expected - expected).max() < 1e-12
    assert np.abs(of.residual - (world.tool_in_base(q)[:, :3, 3] - expected)).max() < 1e-12
    assert of.size.max() > 1e-3
    assert of.rejected.sum() > 20  # a millimetre is far outside this spread


def test_frames_are_known_by_their_names(rng: np.random.Generator) -> None:
    model, q = true_model(), rng.uniform(-2.0, 2.0, (4, 6))
    samples = samples_of(model.serial, q, model.predict(q))
    mixed = replace(samples, frames=("elsewhere", "tracker"), frame=np.array([1, 0, 0, 1]))
    kept = known_to(model, mixed)
    assert kept.frames == ("tracker",)
    assert kept.frame.tolist() == [0, 0]
    assert np.array_equal(kept.q, q[[0, 3]])


def test_axes_are_mujocos(rng: np.random.Generator) -> None:
    chain = ur10()
    world = World(chain, rng, 0.0, 0.0)
    q = rng.uniform(-2.0, 2.0, 6)
    world.tool_in_base(q)
    p, d = joint_axes(chain, q)
    ids = [world.model.body(body_name(name)).jntadr[0] for name in chain.names]
    assert np.abs(d - world.data.xaxis[ids]).max() < 1e-12
    gap = p - world.data.xanchor[ids]
    assert np.abs(np.cross(gap, d)).max() < 1e-12  # on one line
    assert isinstance(world.model, mujoco.MjModel)


def test_axes_stand_off_as_much_larger_as_is_said(rng: np.random.Generator) -> None:
    nominal, q = ur10(), rng.uniform(-2.0, 2.0, 6)
    calibrated = true_model().serial
    (p, d), (p_true, d_true) = joint_axes(nominal, q), joint_axes(calibrated, q)
    angle = np.linalg.norm(np.cross(d, d_true), axis=1)
    assert angle.min() > 1e-5
    for scale in (1.0, 20.0):
        at, along = enlarged_axes(nominal, calibrated, q, scale)
        assert np.abs(at - p - scale * (p_true - p)).max() < 1e-12
        assert np.allclose(np.linalg.norm(along, axis=1), 1.0)
        # a tangent for a sine: what is enlarged is the step across the axis
        assert np.tan(np.arccos(np.sum(along * d, axis=1))) == pytest.approx(scale * angle, rel=1e-5)
    _, along = enlarged_axes(nominal, calibrated, q, 1e9)
    assert (np.sum(along * d, axis=1) > 0.0).all()


def test_an_ellipsoid_holds_as_much_as_it_should(rng: np.random.Generator) -> None:
    """Of a normal distribution, the share within three deviations is that of a chi-square of three degrees below 9."""
    A = rng.normal(size=(3, 3)) * [1e-4, 3e-5, 1e-5]
    C = A @ A.T
    R, half = ellipsoid(C)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(R @ np.diag((half / 3.0) ** 2) @ R.T, C, rtol=1e-9, atol=1e-20)
    x = rng.multivariate_normal(np.zeros(3), C, 20_000)
    inside = np.mean(np.sum((x @ R / half) ** 2, axis=1) < 1.0)
    assert inside == pytest.approx(0.97071, abs=4.0 * np.sqrt(0.97071 * 0.02929 / 20_000))


def test_the_ellipsoid_is_about_the_predicted_tool(rng: np.random.Generator) -> None:
    model = true_model(STEEP.started(np.array([2e-4, 1e-4])))
    correction, q = Correction(calibration_of(model)), rng.uniform(-2.0, 2.0, 6)
    at = moment(q, rng)
    T, half = tool_ellipsoid(correction, at)
    assert np.abs(T[:3, 3] - correction.pose(q, at, "tool")[:3, 3]).max() < 1e-15
    assert half == pytest.approx(3.0 * correction.calibration.noise.position)
    unknown = replace(correction.calibration, noise=NoiseModel(np.nan, 1e-4))
    with pytest.raises(BadCommand):
        tool_ellipsoid(Correction(unknown), at)
