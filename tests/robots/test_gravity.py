"""Gravity's loads against Pinocchio, whose mechanics are its own."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from robots.test_inertias import reduced
from robots.test_kinematics import ARMS, chain_of, urdf

from modcal_core.robots.bodies import STANDARD_GRAVITY, chain_gravity_wrench, payload_wrench
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.mechanism import random_postures
from modcal_core.robots.urdf_inertias import read_inertias


@pytest.mark.parametrize("arm", ARMS)
def test_torques_about_the_joints(arm: str) -> None:
    """What gravity does to a joint is the opposite of what holds it up."""
    chain, model = chain_of(arm), reduced(urdf(arm), chain_of(arm))
    model.gravity.linear = np.array([0.0, 0.0, -STANDARD_GRAVITY])
    data = model.createData()
    q = random_postures(chain, 50, np.random.default_rng(1))
    order = [model.joints[model.getJointId(name)].idx_q for name in chain.names]
    held = []
    for posture in q:
        configuration = np.zeros(model.nq)
        configuration[order] = posture
        held.append(pin.computeGeneralizedGravity(model, data, configuration)[order])
    rows = np.where(chain.revolute, 5, 2)
    found = chain_gravity_wrench(chain, read_inertias(urdf(arm), chain), q)[np.arange(chain.n), rows].T
    assert np.abs(found + np.array(held)).max() < 1e-10


def test_a_payload_pulls_with_its_lever() -> None:
    """Torques of a mass at the tip are minus the slope of its height."""
    chain = chain_of("ur10")
    q = random_postures(chain, 20, np.random.default_rng(2))
    found = payload_wrench(chain, q)[:, 5].T
    for j in range(chain.n):
        d = np.zeros(chain.n)
        d[j] = 1e-6
        rise = (chain_forward(chain, q + d)[:, 2, 3] - chain_forward(chain, q - d)[:, 2, 3]) / 2e-6
        assert np.abs(found[:, j] + STANDARD_GRAVITY * rise).max() < 1e-7
