"""URDF in and out: defaults that people expect, refusals by name, and every byte kept but the corrected origins."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from robots.test_kinematics import ARMS, chain_of, urdf

from modcal_core.errors import BadRobot, NotRepresentable
from modcal_core.geometry import se3
from modcal_core.robots.kinematics import forward
from modcal_core.robots.urdf import joint_origins, read_chain
from modcal_core.robots.urdf_write import calibrated_urdf, write_origins
from modcal_core.robots.vendor import kinematics_yaml_data

AWKWARD = """<?xml version="1.0" encoding="UTF-8"?>\r
<!-- <joint name="a"><origin xyz="9 9 9"/></joint> is only a comment -->\r
<robot name='odd' xmlns:xacro="http://www.ros.org/wiki/xacro">
  <link name="base"/><link name="one"/><link name="two"/><link name="three"/><link name="tip"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="one"/><axis xyz='0 0 1'/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint type="continuous"   name="b &gt; c">
    <origin
        rpy="0 1.5707963267948966 0"
        xyz="0.1 0 0"
    ></origin>   <parent link="one"/><child link="two"/><axis xyz="0 1 0"/></joint>
  <joint name="d" type="prismatic"><origin xyz='0 0 0.2' note="1 > 0"/><parent link="two"/><child link="three"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
  <joint name="end" type="fixed"><parent link="three"/><child link="tip"/></joint>
  <ros2_control name="x" type="system"><joint name="a"><command_interface name="position"/></joint></ros2_control>
</robot>
"""


def test_awkward_text_keeps_every_byte_but_the_origins() -> None:
    chain = read_chain(AWKWARD)
    rng = np.random.default_rng(0)
    moved = chain.with_origins(chain.origins @ se3.exp(0.01 * rng.normal(size=(4, 6))))
    text = calibrated_urdf(AWKWARD, chain, moved)
    q = rng.normal(size=(20, 3))
    assert np.abs(forward(read_chain(text), q) - forward(moved, q)).max() < 1e-12
    masked = re.compile(r"(?<=xyz=[\"'])[-+.e 0-9]*|(?<=rpy=[\"'])[-+.e 0-9]*")
    expected = masked.sub("#", AWKWARD)
    for joint in ('name="a" type="revolute">', 'name="end" type="fixed">'):
        expected = expected.replace(joint, joint + '<origin xyz="#" rpy="#"/>')
    expected = expected.replace("<origin xyz='#' note", "<origin rpy=\"#\" xyz='#' note")
    assert masked.sub("#", text) == expected
    assert '<!-- <joint name="a"><origin xyz="9 9 9"/></joint> is only a comment -->\r\n' in text
    assert text.count("<origin") == 5


@pytest.mark.parametrize("arm", ARMS)
def test_only_changed_origins_change(arm: str) -> None:
    chain, text = chain_of(arm), urdf(arm)
    assert calibrated_urdf(text, chain, chain) == text
    origins = np.array(chain.origins)
    origins[3] = origins[3] @ se3.exp([1e-3, 0, 0, 0, 1e-3, 0])
    changed = calibrated_urdf(text, chain, chain.with_origins(origins))
    lines = [(a, b) for a, b in zip(text.splitlines(), changed.splitlines(), strict=True) if a != b]
    assert len(lines) == 1
    q = np.random.default_rng(1).uniform(-1, 1, (20, chain.n))
    assert np.abs(forward(read_chain(changed), q) - forward(chain.with_origins(origins), q)).max() < 1e-12


def test_a_change_with_nowhere_to_go_is_refused() -> None:
    chain = read_chain(urdf("ur10"), tip="wrist_3_link")
    origins = np.array(chain.origins)
    origins[-1, 0, 3] = 0.1
    with pytest.raises(NotRepresentable, match="wrist_3_link"):
        calibrated_urdf(urdf("ur10"), chain, chain.with_origins(origins))
    with pytest.raises(BadRobot, match="'elbow': is not in"):
        write_origins(urdf("ur10"), {"elbow": np.eye(4)})


def test_default_tips(shared_data: Path) -> None:
    assert [chain_of(arm).tip for arm in ARMS] == ["tool0", "panda_hand_tcp", "link_eef", "iiwa_link_ee"]
    with_fingers = (shared_data / "mukca" / "urdf" / "panda.urdf").read_text()
    assert read_chain(with_fingers).tip == "ball_link"
    every = {f"panda_joint{k}" for k in range(1, 8)} | {"panda_finger_joint1", "panda_finger_joint2"}
    assert read_chain(with_fingers, recorded=every).n == 7


def test_a_joint_that_was_not_recorded_does_not_shorten_the_arm() -> None:
    recorded = set(chain_of("ur10").names) - {"wrist_3_joint"}
    assert read_chain(urdf("ur10"), recorded=recorded).n == 6


BAD = {
    "is not XML": "",
    "is not XML (": "<robot",
    "is <sdf>, not <robot>": "<sdf/>",
    "holds xacro commands": '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="y"/></robot>',
    "has 0 root links": '<robot name="x"/>',
    "has 2 root links": '<robot name="x"><link name="a"/><link name="b"/></robot>',
    "no moving joint": '<robot name="x"><link name="a"/></robot>',
    "looks like millimetres": urdf("ur10").replace("-0.612 0 0", "-612 0 0"),
    "<origin xyz>": urdf("ur10").replace("-0.612 0 0", "-0.612 nan 0"),
    "its axis has no length": urdf("ur10").replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', 1),
}


@pytest.mark.parametrize("said", BAD)
def test_bad_descriptions(said: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BadRobot, match=re.escape(said)) as caught:
        read_chain(BAD[said])
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_unknown_links_are_named_with_their_neighbours() -> None:
    with pytest.raises(BadRobot, match="choose one such as .*wrist_3_link"):
        read_chain(urdf("ur10"), tip="wrist3_link")
    with pytest.raises(BadRobot, match="not behind link"):
        read_chain(urdf("ur10"), base="tool0", tip="base_link")


def test_forms_of_the_makers() -> None:
    ur = kinematics_yaml_data(chain_of("ur10"))["kinematics"]
    assert list(ur) == ["shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3", "hash"]
    assert ur["forearm"] == {"x": -0.612, "y": 0.0, "z": 0.0, "roll": 0.0, "pitch": 0.0, "yaw": 0.0}
    assert re.fullmatch(r"calib_\d{20}", ur["hash"])
    franka = kinematics_yaml_data(chain_of("panda"))
    assert list(franka) == [f"joint{k}" for k in range(1, 8)]
    assert franka["joint3"]["kinematic"]["y"] == -0.316
    other = kinematics_yaml_data(chain_of("iiwa14"))
    origins = joint_origins(urdf("iiwa14"))
    for name, values in other.items():
        assert np.allclose([values[k] for k in "xyz"], origins[name][:3, 3])
