"""Kinematics, inertias and torques against differences, Pinocchio and MuJoCo, each with its own parser and mechanics."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from cells import slider_arm
from finite_differences import assert_jacobian
from robots.random_arms import GRAVITY, Mujoco, Pinocchio, inertial_link, random_body, random_urdf

from modcal_core.errors import BadRobot
from modcal_core.geometry import se3
from modcal_core.geometry.single import pose_error
from modcal_core.robots.acceleration import bias_torque, torque
from modcal_core.robots.bodies import Payload, chain_gravity_wrench, equivalent_inertia, mass_matrix, with_payload
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import (
    body_jacobian,
    chain_forward,
    frames,
    pose_and_jacobian,
    spatial_jacobian,
)
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias

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


EXACT = 1e-10
SEEDS = range(6)


def arm(text: str) -> tuple[Chain, Inertias]:
    chain = read_chain(text)
    return chain, read_inertias(text, chain)


def postures(chain: Chain, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (count, chain.n))


@pytest.mark.parametrize("seed", SEEDS)
def test_random_arms(seed: int) -> None:
    """Diagonal by the plain sum, matrix by composite bodies, torques of any motion: three mechanics, one answer."""
    rng = np.random.default_rng(seed)
    text = random_urdf(rng, int(rng.integers(1, 9)))
    chain, inertias = arm(text)
    q = postures(chain, 8, seed)
    v, a = rng.normal(size=q.shape), 3.0 * rng.normal(size=q.shape)
    M, J, tau = (
        mass_matrix(chain, inertias, q),
        equivalent_inertia(chain, inertias, q),
        torque(chain, inertias, q, v, a),
    )
    for other in (Pinocchio(text, chain), Mujoco(text, chain)):
        for i in range(len(q)):
            expected = other.matrix(q[i])
            assert np.abs(M[i] - expected).max() < EXACT
            assert np.abs(J[i] - np.diag(expected)).max() < EXACT
            assert np.abs(tau[i] - other.torque(q[i], v[i], a[i])).max() < EXACT


@pytest.mark.parametrize("seed", range(3))
def test_a_payload_is_one_more_link(seed: int) -> None:
    """Folded into the last body it is what a link bolted to the tip is, for parsers that were given that link."""
    rng = np.random.default_rng(100 + seed)
    text = random_urdf(rng, 5)
    chain, inertias = arm(text)
    mass, centre, six = random_body(rng)
    payload = Payload.checked(mass, centre, six)
    link = inertial_link("load", mass, centre, (0.0, 0.0, 0.0), six)
    bolt = f'<joint name="bolt" type="fixed"><parent link="{chain.tip}"/><child link="load"/></joint>'
    loaded = text.replace("</robot>", link + bolt + "</robot>")
    q = postures(chain, 5, seed)
    v, a = rng.normal(size=q.shape), rng.normal(size=q.shape)
    folded = with_payload(inertias, chain, payload)
    M, tau = mass_matrix(chain, folded, q), torque(chain, folded, q, v, a)
    assert np.abs(M - mass_matrix(chain, inertias, q)).max() > 1e-2
    for other in (Pinocchio(loaded, chain), Mujoco(loaded, chain)):
        for k in range(len(q)):
            assert np.abs(M[k] - other.matrix(q[k])).max() < EXACT
            assert np.abs(tau[k] - other.torque(q[k], v[k], a[k])).max() < EXACT


def test_laws_of_the_inertia_matrix(rng: np.random.Generator) -> None:
    """Symmetric, positive, and twice the kinetic energy; torques at rest are the slope of the potential energy."""
    chain, inertias = arm(random_urdf(rng, 7))
    q = postures(chain, 20)
    M = mass_matrix(chain, inertias, q)
    assert np.array_equal(M, np.swapaxes(M, 1, 2))
    assert np.linalg.eigvalsh(M).min() > 0.0
    held = bias_torque(chain, inertias, q, 0.0 * q)
    rows = np.where(chain.revolute, 5, 2)
    assert np.abs(held + chain_gravity_wrench(chain, inertias, q)[np.arange(chain.n), rows].T).max() < EXACT
    # power: the torques' work goes into kinetic and potential energy, whatever the speed
    v = rng.normal(size=q.shape)

    def energy(q: np.ndarray) -> np.ndarray:
        return 0.5 * np.einsum("ni,nij,nj->n", v, mass_matrix(chain, inertias, q), v)

    h = 1e-6
    rise = (energy(q + h * v) - energy(q - h * v)) / (2.0 * h)
    work = np.sum(v * (bias_torque(chain, inertias, q, v) - held), axis=1)
    # at constant q̇ the energy rises by q̇ᵀ Ṁ q̇ / 2, and Ṁ − 2 C is skew, so that is the work of C q̇
    assert np.abs(work - rise).max() < 1e-6


def test_gravity_may_point_anywhere(rng: np.random.Generator) -> None:
    """An arm on the wall, or under the ceiling."""
    text = random_urdf(rng, 5)
    chain, inertias = arm(text)
    q = postures(chain, 4)
    model = Pinocchio(text, chain)
    pull = np.array([GRAVITY, -2.0, 3.0])
    model.model.gravity.linear = pull
    for k in range(len(q)):
        found = bias_torque(chain, inertias, q[k : k + 1], 0.0 * q[:1], pull)[0]
        assert np.abs(found - model.torque(q[k], 0.0 * q[k], 0.0 * q[k])).max() < EXACT


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ((-1.0,), "payload: mass: -1 kg is not 0 or more"),
        ((float("nan"),), "payload: mass"),
        ((1.0, (100.0, 0.0, 0.0)), "payload: centre: .* within 10 m"),
        ((1.0, (0.0, float("nan"), 0.0)), "payload: centre"),
        ((1.0, (0.0, 0.0, 0.0), (1.0, 1.0, 3.0, 0.0, 0.0, 0.0)), "payload: inertia: .* is not physical"),
        ((1.0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), "payload: inertia: .* six numbers"),
    ],
)
def test_payloads_that_are_none(numbers: tuple, said: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(BadRobot, match=said):
        Payload.checked(*numbers)


def test_a_shorter_chain_carries_the_rest_with_its_last_joint() -> None:
    """The wrist and the hand, with its fingers, hang on the elbow of a chain that ends there."""
    text = urdf("panda")
    chain = read_chain(text, base="panda_link1", tip="panda_link4")
    model = Pinocchio(text, chain).model
    inertias = read_inertias(text, chain)
    for k, name in enumerate(chain.names):
        body = model.inertias[model.getJointId(name)]
        assert np.abs(inertias.com[k] - body.lever).max() < 1e-14
        assert np.abs(inertias.inertia[k] - body.inertia).max() < 1e-13
    assert inertias.mass[-1] == pytest.approx(2.2037 + 2.2855 + 1.353 + 0.35973 + 0.73 + 2 * 0.015)


def test_a_follower_stands_off_by_its_offset() -> None:
    text = urdf("panda").replace(
        '<mimic joint="panda_finger_joint1"/>', '<mimic joint="panda_finger_joint1" offset="0.02"/>'
    )
    chain = chain_of("panda")
    shift = read_inertias(text, chain).com[6] - read_inertias(urdf("panda"), chain).com[6]
    total = 0.35973 + 0.73 + 2 * 0.015
    assert np.linalg.norm(shift) == pytest.approx(0.02 * 0.015 / total, rel=1e-9)


def test_no_masses_stated() -> None:
    text = re.sub(r"<inertial>.*?</inertial>", "", urdf("ur10"), flags=re.DOTALL)
    inertias = read_inertias(text, read_chain(text))
    assert not inertias.known
    for array in (inertias.mass, inertias.com, inertias.inertia):
        assert not array.any()
        assert not array.flags.writeable


def test_another_robots_chain_is_refused() -> None:
    with pytest.raises(BadRobot, match="joint panda_joint1: is not in robot 'ur10'"):
        read_inertias(urdf("ur10"), chain_of("panda"))
