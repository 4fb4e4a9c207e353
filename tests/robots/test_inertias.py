"""Lumped inertias against Pinocchio, which reads and lumps by itself."""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin
import pytest
from robots.random_arms import Pinocchio
from robots.test_kinematics import ARMS, chain_of, urdf

from modcal_core.errors import BadRobot
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias


@pytest.mark.parametrize("arm", ARMS)
def test_against_pinocchio(arm: str) -> None:
    chain = chain_of(arm)
    model = Pinocchio(urdf(arm), chain).model
    inertias = read_inertias(urdf(arm), chain)
    assert inertias.known
    for k, name in enumerate(chain.names):
        body = model.inertias[model.getJointId(name)]
        assert inertias.mass[k] == pytest.approx(body.mass, rel=1e-14)
        assert np.abs(inertias.com[k] - body.lever).max() < 1e-14
        assert np.abs(inertias.inertia[k] - body.inertia).max() < 1e-14


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


def test_inertia_written_in_a_turned_frame() -> None:
    text = urdf("ur10").replace(
        '<origin xyz="-0.232 0 0.158" rpy="0 0 0"/>', '<origin xyz="-0.232 0 0.158" rpy="0.1 0.2 0.3"/>'
    )
    chain = read_chain(text)
    body = pin.buildModelFromXML(text).inertias[2]
    assert np.abs(read_inertias(text, chain).inertia[1] - body.inertia).max() < 1e-14
    assert np.abs(body.inertia - np.diag(np.diag(body.inertia))).max() > 1e-3


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
