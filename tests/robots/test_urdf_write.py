"""Writing a URDF: reloading gives the calibrated arm, and every other byte is as it was."""

from __future__ import annotations

import re

import numpy as np
import pytest
from robots.test_kinematics import ARMS, chain_of, urdf
from robots.test_tables import assert_same as same

from modcal_core.errors import BadRobot, NotRepresentable
from modcal_core.geometry import se3, so3
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import joint_origins, read_chain
from modcal_core.robots.urdf_write import calibrated_urdf, write_origins

AWKWARD = """<?xml version="1.0" encoding="ISO-8859-1"?>\r
<!-- <joint name="a"><origin xyz="9 9 9"/></joint> is only a comment -->\r
<!DOCTYPE robot [<!ENTITY far "0.3">]>
<robot name='odd' xmlns:xacro="http://www.ros.org/wiki/xacro" xmlns="urn:x"><?keep <origin xyz="7 7 7"/>?>
  <link name="base"><inertial><origin xyz="1 2 3"/><mass value="1"/></inertial></link>
  <link name="one"/><link name="two"/><link name="three"/><link name="größe"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="one"/><axis xyz='0 0 1'/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint type="continuous"   name="b &gt; c">
    <!-- calibrated by hand
    <origin xyz="8 8 8"/> -->
    <origin
        rpy = "0 1.5707963267948966 0"
        xyz="0.1 0 0"
    ></origin>   <parent link="one"/><child link="two"/><axis xyz="0 1 0"/></joint>
\t<joint name="d" type="prismatic">\r
\t\t<parent link="two"/><child link="three"/><origin   note='xyz="5 5 5" > 0'  xyz='0 0 &far;'/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
  <joint name="end" type="fixed">\r
    <parent link="three"/><child link="größe"/></joint>
  <ros2_control name="x" type="system"><joint name="a"><origin xyz="6 6 6"/></joint></ros2_control>
</robot>
<!-- end -->"""
# The same with every number that may change as #, and the attributes that have to be added.
MASKED = (
    AWKWARD.replace('"0 1.5707963267948966 0"', '"#"')
    .replace('"0.1 0 0"', '"#"')
    .replace("<origin   note='xyz=\"5 5 5\" > 0'  xyz='0 0 &far;'/>", "<origin rpy=\"#\"   note='xyz=\"5 5 5\" > 0'  xyz='#'/>")
    .replace('name="a" type="revolute">', 'name="a" type="revolute"><origin xyz="#" rpy="#"/>')
    .replace('name="end" type="fixed">\r\n    ', 'name="end" type="fixed">\r\n    <origin xyz="#" rpy="#"/>\r\n    ')
)  # fmt: skip


def same_arm(a: Chain, b: Chain) -> None:
    same(a, b, 1e-12)


def moved(chain: Chain, size: float = 0.01, seed: int = 0, tool: bool = True) -> Chain:
    xi = size * np.random.default_rng(seed).normal(size=(chain.n + 1, 6))
    xi[-1] *= tool
    return chain.with_origins(chain.origins @ se3.exp(xi))


def test_awkward_text_keeps_every_other_byte() -> None:
    chain = read_chain(AWKWARD)
    text = calibrated_urdf(AWKWARD, chain, moved(chain))
    same_arm(read_chain(text), moved(chain))
    number = r"-?\d+(?:\.\d+)?(?:e-?\d+)?"
    pattern = re.escape(MASKED).replace(r"\#", "#").replace("#", f"{number} {number} {number}")
    assert re.fullmatch(pattern, text)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "start", "ending"),
    [("ur10", "", "\n"), ("panda", "\ufeff", "\r\n"), ("xarm7", "\n\n  ", "\n"), ("iiwa14", "", "\r\n")],
)
def test_calibrated_arms_reload(arm: str, start: str, ending: str) -> None:
    text = start + urdf(arm).replace("\n", ending)
    chain = read_chain(text)
    assert calibrated_urdf(text, chain, chain) == text
    result = calibrated_urdf(text, chain, moved(chain))
    same_arm(read_chain(result), moved(chain))
    before, after = text.split(ending), result.split(ending)
    changed = [i for i, (a, b) in enumerate(zip(before, after, strict=True)) if a != b]
    assert len(changed) == chain.n + 1
    assert all(before[i].strip().startswith("<origin ") for i in changed)


@pytest.mark.parametrize("k", [0, 3])
def test_one_correction_changes_one_line(k: int) -> None:
    """A correction of position alone leaves rpy as it is written, and that of a joint leaves every other joint."""
    chain, text = chain_of("ur10"), urdf("ur10")
    origins = np.array(chain.origins)
    origins[k, :3, 3] += [1e-3, -2e-3, 5e-4]
    result = calibrated_urdf(text, chain, chain.with_origins(origins))
    lines = [(a, b) for a, b in zip(text.splitlines(), result.splitlines(), strict=True) if a != b]
    assert len(lines) == 1
    before, after = (line.split("rpy=") for line in lines[0])
    assert before[1] == after[1] or k == 0  # the turn of base_link_inertia is undone and done again before the first
    same_arm(read_chain(result), chain.with_origins(origins))


def test_writing_what_is_there_changes_nothing() -> None:
    for text in (AWKWARD.replace("&far;", "0.3"), *map(urdf, ARMS)):
        assert write_origins(text, joint_origins(text)) == text


@pytest.mark.slow
@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, 1.5708, np.pi / 2 - 1e-8, np.pi / 2 + 1e-12])
def test_origins_at_gimbal_lock(pitch: float, rng: np.random.Generator) -> None:
    for roll, yaw in rng.uniform(-np.pi, np.pi, (20, 2)):
        T = se3.transform(so3.from_rpy([roll, pitch, yaw]), rng.normal(size=3))
        written = joint_origins(write_origins(urdf("ur10"), {"elbow_joint": T}))["elbow_joint"]
        assert np.abs(written - T).max() < 1e-15 * 4


def test_what_follows_the_last_joint_goes_to_the_last_fixed_one() -> None:
    chain, text = chain_of("panda"), urdf("panda")
    only_tool = np.array(chain.origins)
    only_tool[-1] = only_tool[-1] @ se3.exp([1e-3, 0, 0, 0, 1e-3, 0])
    result = calibrated_urdf(text, chain, chain.with_origins(only_tool))
    same_arm(read_chain(result), chain.with_origins(only_tool))
    old, new = joint_origins(text), joint_origins(result)
    assert [name for name in old if not np.array_equal(old[name], new[name])] == ["panda_hand_tcp_joint"]


def test_a_change_with_nowhere_to_go_is_refused() -> None:
    chain = read_chain(urdf("ur10"), tip="wrist_3_link")
    with pytest.raises(NotRepresentable, match="link 'wrist_3_link': no fixed joint lies between joint wrist_3_joint"):
        calibrated_urdf(urdf("ur10"), chain, moved(chain))
    same_arm(read_chain(calibrated_urdf(urdf("ur10"), chain, moved(chain, tool=False)), tip="wrist_3_link"),
                moved(chain, tool=False))  # fmt: skip


def test_another_robots_urdf_is_refused() -> None:
    with pytest.raises(BadRobot, match="'elbow': is not in the robot description"):
        write_origins(urdf("ur10"), {"elbow": np.eye(4)})
    chain = chain_of("ur10")
    renamed = urdf("ur10").replace("elbow_joint", "elbow")
    with pytest.raises(BadRobot, match="moves by .*elbow, .* and not by .*elbow_joint"):
        calibrated_urdf(renamed, chain, moved(chain))
    with pytest.raises(BadRobot, match="is not XML"):
        write_origins("<robot", {})
