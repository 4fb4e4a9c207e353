"""Inertia matrices and torques against Pinocchio and MuJoCo, each with its own parser and its own mechanics."""

from __future__ import annotations

import numpy as np
import pytest
from robots.random_arms import GRAVITY, Mujoco, Pinocchio, inertial_link, random_body, random_urdf

from modcal_core.errors import BadRobot
from modcal_core.robots.acceleration import bias_torque, torque
from modcal_core.robots.bodies import Payload, chain_gravity_wrench, equivalent_inertia, mass_matrix, with_payload
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias

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
