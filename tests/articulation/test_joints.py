"""Joints are screw motions, tracks are checked at the door, and a joint survives its URDF."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import ideal
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from modcal_core.articulation.joints import JointModel
from modcal_core.articulation.models.registry import joint as made
from modcal_core.articulation.track import Track
from modcal_core.articulation.urdf import describe, frames, read
from modcal_core.errors import BadRecording, BadRobot, ModcalError, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.robots.urdf import read_chain

Array = NDArray[np.float64]
MOVING = ("prismatic", "revolute", "screw")


def some(kind: str, seed: int = 3, radius: float = 0.4, pitch: float = 0.05) -> tuple[JointModel, Array, Array, Array]:
    """A joint, configurations, and the poses there by plain trigonometry."""
    a = np.linspace(-1.2, 1.4, 9)
    seen = ideal(kind, a, np.random.default_rng(seed), radius, pitch if kind == "screw" else 0.0)
    zero = ideal(kind, np.zeros(1), np.random.default_rng(seed), radius, pitch if kind == "screw" else 0.0)
    start = se3.transform(zero.rotations[0], zero.positions[0])
    point = seen.point if kind in ("revolute", "screw") else np.zeros(3)
    return (
        made(kind, start, seen.axis, point, seen.pitch if kind == "screw" else 0.0),
        a,
        seen.positions,
        seen.rotations,
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rigid", *MOVING])
@given(seed=st.integers(0, 1000))
def test_poses_are_those_of_trigonometry(kind: str, seed: int) -> None:
    model, a, p, R = some(kind, seed)
    np.testing.assert_allclose(model.pose(a)[:, :3, 3], p, atol=1e-12)
    np.testing.assert_allclose(model.pose(a)[:, :3, :3], R, atol=1e-12)
    np.testing.assert_allclose(model.position(a), p, atol=1e-12)


@pytest.mark.parametrize("kind", MOVING)
@given(seed=st.integers(0, 1000))
def test_configuration_undoes_pose_and_position(kind: str, seed: int) -> None:
    model, a, p, _ = some(kind, seed)
    np.testing.assert_allclose(model.configuration(model.pose(a)), a, atol=1e-9)
    np.testing.assert_allclose(model.configuration(p), a, atol=1e-9)
    np.testing.assert_allclose(model.configuration(p[3]), a[3], atol=1e-9)


def test_configuration_is_the_nearest_one(rng: np.random.Generator) -> None:
    for kind in MOVING:
        model, _, p, _ = some(kind)
        beside = p[4] + rng.normal(0.0, 0.02, 3)
        grid = np.linspace(-2.0, 2.0, 40001)
        nearest = grid[np.argmin(np.linalg.norm(model.position(grid) - beside, axis=1))]
        assert model.configuration(beside) == pytest.approx(nearest, abs=2e-4)


def test_a_long_thread_is_followed_over_many_turns() -> None:
    seen = ideal("screw", np.linspace(0.0, 40.0, 50), np.random.default_rng(5), 0.1, 0.02)
    model, *_ = some("screw", 5, 0.1, 0.02)
    np.testing.assert_allclose(model.configuration(seen.positions), seen.a, atol=1e-6)


@pytest.mark.parametrize("kind", ["rigid", *MOVING])
@pytest.mark.parametrize("oriented", [True, False])
def test_a_joint_survives_its_urdf(kind: str, oriented: bool) -> None:
    model, a, *_ = some(kind)
    if not oriented:
        model = made(model.kind, se3.transform(None, model.start[:3, 3]), model.axis, model.point, model.pitch, False)
    again = read(describe(model, "base_link", "handle"))
    assert (again.kind, again.oriented) == (model.kind, oriented)
    np.testing.assert_allclose(again.pose(a), model.pose(a), atol=1e-12)
    assert frames(describe(model, "base_link", "handle")) == ("base_link", "handle")


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
def test_the_urdf_moves_as_the_joint(kind: str) -> None:
    """Read by the reader of arms, which knows nothing of articulation."""
    model, a, *_ = some(kind)
    chain = read_chain(describe(model, "base_link", "handle"), "base_link", "handle")
    from modcal_core.robots.kinematics import chain_forward

    np.testing.assert_allclose(chain_forward(chain, a[:, None]), model.pose(a), atol=1e-9)


@pytest.mark.parametrize(
    "text", ["", "<robot/>", "<robot><joint name='object_joint' type='revolute'/></robot>", "not xml",
             "<robot><joint name='object_joint' type='prismatic'><origin xyz='nan 0 0'/></joint></robot>"]
)  # fmt: skip
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(BadRobot):
        read(text)


def test_joints_that_are_none_are_refused() -> None:
    good, *_ = some("revolute")
    for change in ({"axis": 2.0 * good.axis}, {"point": np.full(3, np.nan)}, {"pitch": 0.1}, {"kind": "spherical"},
                   {"start": 2.0 * good.start}):  # fmt: skip
        kept = {name: getattr(good, name) for name in ("kind", "start", "axis", "point", "pitch", "oriented")}
        with pytest.raises(BadRobot):
            made(**{**kept, **change})
    with pytest.raises(ValueError, match="read-only"):
        good.start[0, 0] = 2.0


@pytest.mark.parametrize(
    ("poses", "error"),
    [
        (np.zeros((3, 3)), NotEnoughData),
        (np.full((9, 3), np.nan), BadRecording),
        (np.full((9, 3), 700.0), BadRecording),
        (np.zeros((9, 5)), BadRecording),
        (np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.2], (9, 1)), BadRecording),
        (np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], (9, 1)), BadRecording),
    ],
)
def test_tracks_are_checked_at_the_door(poses: Array, error: type[ModcalError]) -> None:
    with pytest.raises(error) as caught:
        Track.of_poses(poses)
    assert len(str(caught.value).splitlines()) == 1


def test_stamps_that_go_back_are_refused() -> None:
    with pytest.raises(BadRecording, match="go back at sample 4"):
        Track(np.zeros((6, 3)), None, np.array([0.0, 1.0, 2.0, 3.0, 1.0, 4.0]))
