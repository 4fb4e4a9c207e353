"""Joints are screw motions, recovered from noisy tracks as well as they say, and survive their URDF."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy
from finite_differences import assert_jacobian
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from modcal_core.articulation.fit import JointFit, fit
from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.joints import JointModel
from modcal_core.articulation.models.prismatic import PrismaticMotion
from modcal_core.articulation.models.registry import axis_model
from modcal_core.articulation.models.revolute import RevoluteMotion
from modcal_core.articulation.models.rigid import RigidMotion
from modcal_core.articulation.models.screw import ScrewMotion
from modcal_core.articulation.track import Track
from modcal_core.articulation.urdf import describe, frames, read
from modcal_core.errors import BadRecording, BadRobot, ModcalError, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.urdf import read_chain

DEGREE = np.pi / 180.0


def tracked(seen: Seen, oriented: bool = True) -> Track:
    return Track(seen.positions, seen.rotations if oriented else None)


def errors(found: JointModel, seen: Seen) -> tuple[float, float]:
    """Distance between the axes [m] at the handle, and angle between them [rad]."""
    axis = found.axis * np.sign(found.axis @ seen.axis)
    away = found.point - seen.point
    away = away - seen.axis * (seen.axis @ away)
    return float(np.linalg.norm(away)), float(np.arccos(min(1.0, axis @ seen.axis)))


MOTIONS = {motion.kind: motion for motion in (RigidMotion, PrismaticMotion, RevoluteMotion, ScrewMotion)}


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("oriented", [True, False])
def test_derivatives(kind: Kind, oriented: bool, rng: np.random.Generator) -> None:
    R = so3.exp(rng.normal(size=3)) if oriented else None
    motion = MOTIONS[kind](rng.normal(size=3), so3.exp(rng.normal(size=3)), R, 0.4, 0.05 if kind == "screw" else 0.0)
    T = motion.joint().pose(rng.uniform(-1.0, 1.0, 8)) @ se3.exp(rng.normal(0.0, 0.05, (8, 6)))
    track = Track(T[:, :3, 3], T[:, :3, :3] if oriented else None)
    a = rng.uniform(-1.0, 1.0, 8)
    _, by_a, J = motion.linearise(track, a)
    here = np.zeros(motion.size)
    assert_jacobian(
        lambda z: motion.moved(z).residuals(track, a).ravel(), J.reshape(-1, motion.size), here, tolerance=1e-7
    )
    if kind != "rigid":
        assert_jacobian(
            lambda d: motion.residuals(track, a + d).ravel(), by_a.reshape(-1, 1), np.zeros(1), tolerance=1e-7
        )
    told = {
        "axis": lambda z: motion.moved(z).axis,
        "start": lambda z: motion.moved(z).p,
        "point": lambda z: motion.moved(z).joint().point,
        "pitch": lambda z: np.array([motion.moved(z).joint().pitch]),
    }
    for name, gradient in motion.gradients().items():
        assert_jacobian(told[name], gradient, here, tolerance=1e-7)


@pytest.mark.parametrize("kind", ["prismatic", "revolute", "screw"])
@pytest.mark.parametrize("oriented", [True, False])
def test_exact_tracks_give_the_joint_exactly(kind: Kind, oriented: bool, rng: np.random.Generator) -> None:
    seen = ideal(kind, np.linspace(0.0, 1.5, 40), rng, 0.5, 0.06)
    found = fit(tracked(seen, oriented), kind)
    model = found.model
    assert abs(abs(model.axis @ seen.axis) - 1.0) < 1e-8
    np.testing.assert_allclose(model.position(found.configurations), seen.positions, atol=2e-6)
    if kind != "prismatic":
        assert errors(model, seen)[0] < 1e-5
    if kind == "screw":
        assert model.pitch == pytest.approx(seen.pitch, abs=1e-5)
    if oriented:
        turned = so3.log(np.swapaxes(model.pose(found.configurations)[:, :3, :3], 1, 2) @ seen.rotations)
        assert np.abs(turned).max() < 2e-5
    assert model.configuration(seen.positions[0]) == pytest.approx(0.0, abs=1e-5)


def repeated(
    kind: Kind, oriented: bool, degrees: float, position: float, rotation: float, count: int, pitch: float = 0.0
):  # type: ignore[no-untyped-def]
    for seed in range(count):
        rng = np.random.default_rng(seed)
        seen = noisy(ideal(kind, np.linspace(0.0, degrees * DEGREE, 60), rng, 0.5, pitch), rng, position, rotation)
        yield seen, fit(tracked(seen, oriented), kind)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("oriented", "degrees", "position", "rotation", "centre", "axis"),
    [(True, 30.0, 1e-3, 0.2 * DEGREE, 8e-3, 1.2 * DEGREE), (False, 60.0, 3e-3, 0.0, 21e-3, 2.8 * DEGREE)],
)
def test_accuracy_of_a_hinge(
    oriented: bool, degrees: float, position: float, rotation: float, centre: float, axis: float
) -> None:
    found = [errors(f.model, s) for s, f in repeated("revolute", oriented, degrees, position, rotation, 30)]
    assert np.quantile([f[0] for f in found], 0.95) <= centre
    assert np.quantile([f[1] for f in found], 0.95) <= axis


def _chi(found: JointFit, seen: Seen) -> tuple[float, float]:
    """Squared errors of centre and axis, each over two dimensions, weighed by what the fit says of them."""
    B = np.linalg.svd(seen.axis[None])[2][1:]
    away = B @ (found.model.point - seen.point)
    tilt = B @ (found.model.axis * np.sign(found.model.axis @ seen.axis))
    return (
        float(away @ np.linalg.solve(B @ found.covariance["point"] @ B.T, away)),
        float(tilt @ np.linalg.solve(B @ found.covariance["axis"] @ B.T, tilt)),
    )


@pytest.mark.slow
@pytest.mark.parametrize(("oriented", "degrees"), [(True, 40.0), (False, 70.0)])
def test_the_truth_lies_within_the_stated_uncertainty(oriented: bool, degrees: float) -> None:
    """Over 40 tracks a mean of χ² with two degrees of freedom is 2 ± 0.32; three of those."""
    chi = [_chi(f, s) for s, f in repeated("revolute", oriented, degrees, 1e-3, 0.2 * DEGREE, 40)]
    for mean in np.mean(chi, axis=0):
        assert 1.0 < mean < 3.1


@pytest.mark.parametrize("oriented", [True, False])
def test_a_quarter_of_gross_outliers_does_no_harm(oriented: bool, rng: np.random.Generator) -> None:
    seen = noisy(ideal("revolute", np.linspace(0.0, 1.2, 120), rng, 0.5), rng, 1e-3, 0.2 * DEGREE)
    bad = rng.random(120) < 0.25
    p = seen.positions + bad[:, None] * rng.normal(0.0, 0.2, (120, 3))
    R = seen.rotations @ Rotation.from_rotvec(bad[:, None] * rng.normal(0.0, 1.0, (120, 3))).as_matrix()
    found = fit(Track(p, R if oriented else None), "revolute")
    assert errors(found.model, seen)[0] < (0.005 if oriented else 0.012)
    assert found.weights[bad].max() < 0.3
    assert np.median(found.weights[~bad]) > 0.5
    assert found.sigma_position == pytest.approx(1e-3, rel=0.4)


def test_another_frame_gives_the_same_joint_there(rng: np.random.Generator) -> None:
    seen = noisy(ideal("revolute", np.linspace(0.0, 1.0, 50), rng, 0.4), rng, 1e-3, 0.3 * DEGREE)
    T = se3.exp(rng.normal(size=6))
    poses = T @ se3.transform(seen.rotations, seen.positions)
    here, there = fit(tracked(seen), "revolute"), fit(Track(poses[:, :3, 3], poses[:, :3, :3]), "revolute")
    np.testing.assert_allclose(there.model.point, se3.apply(T, here.model.point), atol=1e-5)
    np.testing.assert_allclose(there.model.axis, T[:3, :3] @ here.model.axis, atol=1e-5)
    assert there.log_likelihood == pytest.approx(here.log_likelihood, abs=1e-3)


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
        found = fit(Track(seen.positions + 1e-3 * shared(160, 0.7, rng)), "prismatic", rng)
        away = found.model.axis * np.sign(found.model.axis @ seen.axis) - seen.axis
        squares.append(float(away @ np.linalg.pinv(found.covariance["axis"], rcond=1e-6) @ away))
    # two directions across the axis, so 2 on the average; the mean of 60 scatters by 13 %, and the correlation that each
    # track shows by a fifth. Counted once instead of twice it would give 6
    assert 1.2 < np.mean(squares) < 3.2


MOVING = ("prismatic", "revolute", "screw")


def some(kind: str, seed: int = 3, radius: float = 0.4, pitch: float = 0.05) -> tuple[JointModel, Array, Array, Array]:
    """A joint, configurations, and the poses there by plain trigonometry."""
    a = np.linspace(-1.2, 1.4, 9)
    seen = ideal(kind, a, np.random.default_rng(seed), radius, pitch if kind == "screw" else 0.0)
    zero = ideal(kind, np.zeros(1), np.random.default_rng(seed), radius, pitch if kind == "screw" else 0.0)
    start = se3.transform(zero.rotations[0], zero.positions[0])
    point = seen.point if kind in ("revolute", "screw") else np.zeros(3)
    return (
        axis_model(kind).joint(start, seen.axis, point, seen.pitch if kind == "screw" else 0.0),
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


@pytest.mark.slow
@pytest.mark.parametrize("kind", MOVING)
@given(seed=st.integers(0, 1000))
def test_configuration_undoes_pose_and_position(kind: str, seed: int) -> None:
    model, a, p, _ = some(kind, seed)
    np.testing.assert_allclose(model.configuration(model.pose(a)), a, atol=1e-9)
    np.testing.assert_allclose(model.configuration(p), a, atol=1e-9)
    np.testing.assert_allclose(model.configuration(p[3]), a[3], atol=1e-9)


@pytest.mark.parametrize("kind", ["rigid", *MOVING])
@pytest.mark.parametrize("oriented", [True, False])
def test_a_joint_survives_its_urdf(kind: str, oriented: bool) -> None:
    model, a, *_ = some(kind)
    if not oriented:
        model = type(model)(se3.transform(None, model.start[:3, 3]), model.axis, model.point, model.pitch, False)
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
        kept = {name: getattr(good, name) for name in ("start", "axis", "point", "pitch", "oriented")}
        with pytest.raises(BadRobot):
            axis_model(change.pop("kind", good.kind)).joint(**{**kept, **change})
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
