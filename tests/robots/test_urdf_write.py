"""Writing a URDF changes the arm and no other byte; the nearest DH table says what it loses."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from robots.test_kinematics import ARMS, chain_of, urdf
from robots.test_tables import PUBLISHED, table_of
from robots.test_tables import assert_same as same
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadRobot, NotRepresentable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.dh import from_dh, to_dh
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.tables import nearest_dh
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


HERE = {"xyz": [0.0] * 3, "rpy": [0.0] * 3}


def step(axis: str, angle: float, length: float) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    T["xyz".index(axis), 3] = length
    return T


def end(values: dict[str, list[float]]) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", values["rpy"]).as_matrix(), values["xyz"]
    return T


def by_hand(table: dict[str, Any], q: Array) -> Array:
    """The tip's pose by a table, multiplied out as textbooks do, without our chain."""
    T = end(table.get("base", HERE))
    for row, angle in zip(table["joints"], q, strict=True):
        z, x = step("z", row["theta"] + angle, row["d"]), step("x", row["alpha"], row["a"])
        T = T @ (z @ x if table["convention"] == "dh" else x @ z)
    return T @ end(table.get("tool", HERE))


def bent_ur10(angle: float) -> tuple[Chain, str]:
    """A UR10 whose links are displaced and turned in every direction, as a chain and as its URDF."""
    text = urdf("ur10")
    nominal = read_chain(text)
    rng = np.random.default_rng(2)
    xi = rng.normal(size=(nominal.n + 1, 6)) * ([3e-4] * 3 + [angle] * 3)
    bent = calibrated_urdf(text, nominal, nominal.with_origins(nominal.origins @ se3.exp(xi)))
    return read_chain(bent), bent


def test_an_arm_that_dh_holds_is_met() -> None:
    """Lengths, twists and zeros other than drawn, the parallel axes exactly parallel."""
    table = table_of("dh", PUBLISHED["ur10"][1])
    rng = np.random.default_rng(1)
    for row in table["joints"]:
        for key in ("theta", "d", "a"):
            row[key] += 1e-3 * rng.normal()
    for row in (table["joints"][0], *table["joints"][3:]):
        row["alpha"] += 1e-3 * rng.normal()
    found = nearest_dh(from_dh(table))
    assert found.largest < 1e-9
    assert found.angle < 1e-9
    assert found.parallel == (("j1", "j2"), ("j2", "j3"))


@pytest.mark.slow
@pytest.mark.parametrize("convention", ["dh", "mdh"])
def test_what_it_says_of_a_bent_arm_is_what_pinocchio_sees(convention: str) -> None:
    chain, text = bent_ur10(5e-4)
    with pytest.raises(NotRepresentable):
        to_dh(chain)
    found = nearest_dh(chain, convention)
    assert max(abs(row[key]) for row in found.table["joints"] for key in ("d", "a")) < 1.0
    model = pin.buildModelFromXML(text)
    data, tip = model.createData(), model.getFrameId("tool0")
    missed, nominal = [], []
    published = {"convention": "dh", "joints": table_of("dh", PUBLISHED["ur10"][1])["joints"]}
    drawn = {**to_dh(read_chain(urdf("ur10"))), "joints": published["joints"]}
    for q in np.random.default_rng(3).uniform(-np.pi, np.pi, (300, 6)):
        pin.framesForwardKinematics(model, data, q)
        true = data.oMf[tip].translation
        missed.append(np.linalg.norm(by_hand(found.table, q)[:3, 3] - true))
        nominal.append(np.linalg.norm(by_hand(drawn, q)[:3, 3] - true))
    rms = np.sqrt(np.mean(np.square(missed)))
    assert abs(rms - found.rms) < 0.1 * found.rms
    assert max(missed) < 1.1 * found.largest
    assert rms < 0.6 * np.sqrt(np.mean(np.square(nominal)))


@pytest.mark.slow
def test_it_is_nearest() -> None:
    """No small change of any length or angle of the table brings tip and tool nearer."""
    chain, _ = bent_ur10(5e-4)
    found = nearest_dh(chain)
    q = np.random.default_rng(4).uniform(-np.pi, np.pi, (60, 6))
    true = chain_forward(chain, q)

    def missed(table: dict[str, Any]) -> float:
        """RMS of the tip's distance and of what its turn moves at 0.2 m, the length of a tool."""
        off = np.array([by_hand(table, row) for row in q]) - true
        return float(
            np.mean(np.sum(off[:, :3, 3] ** 2, axis=1) + 0.5 * 0.2**2 * np.sum(off[:, :3, :3] ** 2, axis=(1, 2)))
        )

    best = missed(found.table)
    for k in range(6):
        for key in ("theta", "a", "alpha"):
            for sign in (-1.0, 1.0):
                other = {**found.table, "joints": [dict(row) for row in found.table["joints"]]}
                other["joints"][k][key] += sign * 5e-4
                assert missed(other) > best, (k, key)
