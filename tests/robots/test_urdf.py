"""Reading a URDF: the tip that people expect, the way there, and refusals by name."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from robots.test_kinematics import ARMS, chain_of, urdf

from modcal_core.articulation.urdf import read
from modcal_core.errors import BadRobot, ModcalError
from modcal_core.robot import Robot
from modcal_core.robots import Follower, inverse, random_postures
from modcal_core.robots.acceleration import LoadedArm
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain


def robot(*parts: str) -> str:
    return f'<robot name="r">{"".join(parts)}</robot>'


def links(*names: str) -> str:
    return "".join(f'<link name="{name}"/>' for name in names)


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def serial(kinds: str, prefix: str = "l", start: str = "l0") -> str:
    """Links and joints in a row behind a link: r turns, p slides, f is fixed."""
    words = {"r": "revolute", "p": "prismatic", "f": "fixed"}
    names = [start, *(f"{prefix}{i + 1}" for i in range(len(kinds)))]
    return links(*names[1:]) + "".join(
        joint(f"{prefix}j{i + 1}", names[i], names[i + 1], words[kind]) for i, kind in enumerate(kinds)
    )


# -- the tip ----------------------------------------------------------------------------------------------------------


def test_default_tips_of_known_arms() -> None:
    assert [chain_of(arm).tip for arm in ARMS] == ["tool0", "panda_hand_tcp", "link_eef", "iiwa_link_ee"]
    assert [chain_of(arm).base for arm in ARMS] == ["base_link", "panda_link0", "link_base", "iiwa_link_0"]


def test_default_tips_of_real_files(shared_data: Path) -> None:
    folder = shared_data / "mukca" / "urdf"
    if not folder.is_dir():
        pytest.skip("no ../shared/data/mukca/urdf")
    assert read_chain((folder / "iiwa14.urdf").read_text()).tip == "ball_link"
    panda = (folder / "panda.urdf").read_text()
    every = {f"panda_joint{k}" for k in range(1, 8)} | {"panda_finger_joint1", "panda_finger_joint2"}
    for recorded in (None, every):
        chain = read_chain(panda, recorded=recorded)
        assert (chain.n, chain.tip) == (7, "ball_link")
    assert read_chain(panda, tip="panda_leftfinger").n == 8
    assert read_chain(panda, tip="panda_rightfinger").follows == (Follower(7, "panda_finger_joint1", 1.0, 0.0),)


ARM = links("l0") + serial("rrrrrr")
HAND = links("hand") + joint("h", "l6", "hand", "fixed")
FINGERS = links("left", "right") + joint("left", "hand", "left", "prismatic")
TIPS = {
    "most joints": (links("l0") + serial("rrr") + serial("r", "a", "l1"), "l3"),
    "then a tool's name": (ARM + links("sensor", "tool0") + joint("s", "l6", "sensor", "fixed") + joint("t", "l6", "tool0", "fixed"), "tool0"),
    "tool0 before tcp": (ARM + links("a_tcp", "b_tool0") + joint("s", "l6", "a_tcp", "fixed") + joint("t", "l6", "b_tool0", "fixed"), "b_tool0"),
    "a knee is no ee": (ARM + links("knee", "z_ee_link") + joint("s", "l6", "knee", "fixed") + joint("t", "l6", "z_ee_link", "fixed"), "z_ee_link"),
    "then the longest way": (ARM + links("a") + joint("a", "l6", "a", "fixed") + serial("ff", "b", "l6"), "b2"),
    "then the name": (ARM + links("b", "a") + joint("b", "l6", "b", "fixed") + joint("a", "l6", "a", "fixed"), "a"),
    "fingers that mimic": (ARM + HAND + FINGERS + joint("right", "hand", "right", "prismatic", '<mimic joint="left"/>'), "hand"),
    "a finger with its pad": (ARM + HAND + FINGERS + joint("right", "left", "right", "prismatic", '<mimic joint="left"/>'), "hand"),
    "fingers that do not": (ARM + HAND + FINGERS + joint("right", "hand", "right", "prismatic"), "hand"),
    "the palm of a hand": (ARM + HAND + serial("rrrr", "i", "hand") + serial("rrrr", "m", "hand") + serial("rrr", "t", "hand"), "hand"),
    "a tool beside fingers": (ARM + HAND + FINGERS + joint("right", "hand", "right", "prismatic") + serial("ff", "x", "hand"), "x2"),
    "a jaw that nothing mimics": (ARM + HAND + links("frame", "moving_jaw") + joint("f", "hand", "frame", "fixed") + joint("6", "hand", "moving_jaw"), "frame"),
    "a gripper's motor": (ARM + HAND + links("bar", "prop") + joint("b", "hand", "bar", "fixed") + joint("gripper", "hand", "prop", "continuous"), "bar"),
    "a finger on the last link": (ARM + links("left_finger") + joint("slide", "l6", "left_finger", "prismatic"), "l6"),
    "a joint that carries the gripper": (links("l0") + serial("rr") + links("gripper") + joint("gripper_z", "l2", "gripper", "prismatic"), "gripper"),
    "a hand by itself": (links("palm", "finger1", "finger2") + joint("a", "palm", "finger1") + joint("b", "finger1", "finger2"), "finger2"),
    "one arm of two": (links("l0") + serial("r") + serial("rrrrrr", "b", "l1") + serial("rrrrrr", "a", "l1"), "a6"),
    "a cylinder that balances a link": (ARM + links("rod", "tool0") + joint("c", "l1", "rod", inside='<mimic joint="lj2"/>') + joint("t", "l6", "tool0", "fixed"), "tool0"),
    "a cylinder beside the last joint": (ARM + links("rod", "tool0") + joint("c", "l4", "rod", inside='<mimic joint="lj6"/>') + joint("t", "l6", "tool0", "fixed"), "tool0"),
    "a gripper's motor behind the tool's frame": (ARM + links("tool0", "base", "slider") + joint("t", "l6", "tool0", "fixed") + joint("b", "l6", "base", "fixed") + joint("gripper_main", "base", "slider", "prismatic"), "tool0"),
    "a parallelogram's joint": (ARM + links("rod", "level", "z_tcp") + joint("r", "l1", "rod", inside='<mimic joint="lj2"/>') + joint("p", "l6", "level", inside='<mimic joint="lj5" multiplier="-1"/>') + joint("s", "level", "z_tcp"), "z_tcp"),
    "a camera on the arm": (links("l0") + serial("rrrrrr") + serial("rr", "c", "l3"), "l6"),
}  # fmt: skip


@pytest.mark.parametrize("case", TIPS)
def test_default_tip(case: str) -> None:
    parts, tip = TIPS[case]
    assert read_chain(robot(parts)).tip == tip


def test_arms_that_might_have_been_meant_as_well() -> None:
    two = (links("base"), serial("r", "t", "base"), serial("rrrrrrf", "right_", "t1"), serial("rrrrrrf", "left_", "t1"))
    both = robot(*two, serial("rr", "head_", "t1"))
    assert Robot.from_urdf(both).tip == "left_7"
    assert Robot.from_urdf(both).other_tips == ("right_7",)
    assert Robot.from_urdf(both, tip="right_7").other_tips == ()
    one = {"tj1", *(f"right_j{k}" for k in range(1, 7))}
    assert (Robot.from_urdf(both, recorded=one).tip, Robot.from_urdf(both, recorded=one).other_tips) == ("right_7", ())
    assert Robot.from_urdf(urdf("panda")).other_tips == ()


def test_a_joint_that_was_not_recorded_does_not_shorten_the_arm() -> None:
    recorded = set(chain_of("ur10").names) - {"wrist_3_joint"}
    assert read_chain(urdf("ur10"), recorded=recorded).n == 6


def test_a_joint_that_mimics_inside_the_chain_follows() -> None:
    """A hand held level by a rod: its joint mimics one that mimics another; inverse, postures and limits follow."""
    text = robot(
        links("l0") + serial("rrrr"),
        links("twin", "hand", "z"),
        joint("twin", "l1", "twin", inside='<mimic joint="lj3" multiplier="2" offset="0.1"/>'),
        joint("level", "l4", "hand", inside='<mimic joint="twin" multiplier="-0.5" offset="0.3"/>'),
        joint("z", "hand", "z"),
    )
    chain = read_chain(text)
    assert chain.names == ("lj1", "lj2", "lj3", "lj4", "level", "z")
    assert chain.own_names == ("lj1", "lj2", "lj3", "lj4", "z")
    rng = np.random.default_rng(4)
    q = random_postures(chain, 20, rng)
    assert np.allclose(q[:, 4], 0.25 - q[:, 2])
    goal = chain_forward(chain, q[0])
    found = inverse(chain, goal, q[0] + [0.1, -0.1, 0.2, 0.1, 0.5, 0.1], rng=rng)
    assert found[4] == pytest.approx(0.25 - found[2], abs=1e-12)
    assert np.abs(chain_forward(chain, found) - goal).max() < 1e-6
    notes = Robot.from_urdf(text).notes
    assert notes == ("Joint level follows lj3: -1 times its position, plus 0.25.",)
    with pytest.raises(BadRobot, match="joint level: mimics nobody, which leads nothing"):
        read_chain(text.replace('mimic joint="twin"', 'mimic joint="nobody"'))


def test_a_mass_without_a_value_is_noted() -> None:
    text = urdf("ur10").replace('mass value="7.1"', "mass", 1)
    (note,) = Robot.from_urdf(text).notes
    assert note.endswith("has an <inertial> without mass: it weighs nothing.")


# -- the chain --------------------------------------------------------------------------------------------------------


def test_kinds_limits_and_axes() -> None:
    chain = read_chain(
        robot(
            links("a", "b", "c", "d", "e", "f"),
            joint("turn", "a", "b", "revolute", '<limit lower="-1" upper="2" effort="0" velocity="0"/>'),
            joint("spin", "b", "c", "continuous", '<axis xyz="0 3 4"/><limit effort="0" velocity="0"/>'),
            joint("slide", "c", "d", "prismatic", '<axis xyz="0 0 -2"/><limit upper="0.5"/>'),
            joint("free", "d", "e", "revolute"),
            joint("unlimited", "e", "f", "revolute", '<limit effort="1" velocity="1"/>'),
        )
    )
    assert chain.names == ("turn", "spin", "slide", "free", "unlimited")
    assert chain.axes.tolist() == [[1, 0, 0], [0, 0.6, 0.8], [0, 0, -1], [1, 0, 0], [1, 0, 0]]
    assert chain.revolute.tolist() == [True, True, False, True, True]
    assert chain.lower.tolist() == [-1, -np.inf, 0, -np.inf, -np.inf]
    assert chain.upper.tolist() == [2, np.inf, 0.5, np.inf, np.inf]


def test_what_is_not_kinematics_does_not_matter(capfd: pytest.CaptureFixture[str]) -> None:
    """Meshes, colours, simulators' tags, vendor attributes, a declared encoding, a namespace, leading blank lines."""
    plain = read_chain(urdf("ur10"))
    junk = """<material name="odd"/><gazebo><x/></gazebo><transmission name="t"><joint name="elbow_joint"/></transmission>
        <ros2_control name="ur"><joint name="elbow_joint"><param name="p">1</param></joint></ros2_control>
        <link name="ö"><visual><geometry><mesh/><teapot/></geometry></visual><sensor/></link>
        <joint name="ö" type="fixed" odd="1"><parent link="tool0"/><child link="ö"/><origin quality="good"/></joint>"""
    text = urdf("ur10").replace('<link name="tool0"/>', '<link name="tool0"/>' + junk)
    text = text.replace('<?xml version="1.0"?>', '\n <?xml version="1.0" encoding="ISO-8859-1"?>')
    text = text.replace(
        '<robot name="ur10">', '<robot name="ur10" xmlns="urn:x" xmlns:g="urn:g"><g:link name="tool0"/>'
    )
    chain = read_chain(text, tip="tool0")
    assert np.array_equal(chain.origins, plain.origins)
    assert read_chain("\ufeff" + text).tip == "ö"
    assert capfd.readouterr() == ("", "")


def test_what_the_parsers_of_ros_take() -> None:
    """An undeclared prefix, an axis of a fixed joint, a mass of no value, limits the wrong way round off the arm."""
    finger = joint("f", "tool0", "finger", inside='<limit lower="1" upper="-1"/>')
    junk = f"""<gazebo><sensor:camera n:name="x"><link name="y"/></sensor:camera></gazebo><link name="finger"/>{finger}
        <link name="e"><inertial><mass/></inertial></link>{joint("e", "tool0", "e", "fixed", '<axis xzy="1 0 0"/>')}"""
    chain = read_chain(urdf("ur10").replace("</robot>", f"{junk}</robot>"), tip="tool0")
    assert np.array_equal(chain.origins, read_chain(urdf("ur10")).origins)
    with pytest.raises(BadRobot, match="is not XML .*mismatch"):
        read_chain(urdf("ur10").replace("</robot>", "<sensor:camera></robot>"))
    with pytest.raises(BadRobot, match="joint f: its limits run from 1 to -1"):
        read_chain(urdf("ur10").replace("</robot>", f"{junk}</robot>"), tip="finger")


# -- refusals ---------------------------------------------------------------------------------------------------------

TWO = links("a", "b")
BAD = {
    "is not XML (it is empty)": " \n",
    "is not XML (Start tag expected": "elbow_joint: 0.1",
    "holds xacro commands": '<robot name="x" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="y"/></robot>',
    "holds xacro commands: expand it first": robot(TWO, joint("j", "a", "b", inside='<origin xyz="${d} 0 0"/>')),
    "robot description: <robot>: has no name": '<robot><link name="a"/></robot>',
    "only 1.0 is supported": '<robot name="x" version="2.0"><link name="a"/></robot>',
    "has 2 root links (a, b)": robot(TWO),
    "link 'b': no moving joint": robot(links("b", "c"), joint("j", "b", "c", "fixed")),
    "link 'a': occurs 2 times": robot(links("a", "a")),
    "joint j: names link 'c', which does not exist": robot(TWO, joint("j", "a", "c")),
    "link 'b': is the child of joints i and j": robot(links("a", "b"), joint("i", "a", "b"), joint("j", "a", "b")),
    "joint i: closes a loop": robot(links("r", "a", "b"), joint("i", "a", "b"), joint("j", "b", "a")),
    "joint j: has no <child>": robot(TWO, '<joint name="j" type="revolute"><parent link="a"/></joint>'),
    "joint j: Invalid joint type: hinge": robot(TWO, joint("j", "a", "b", "hinge")),
    "joint j: its limits run from 1 to -1": robot(TWO, joint("j", "a", "b", inside='<limit lower="1" upper="-1"/>')),
    "joint j: <origin xyz>: '1,5 0 0' holds what is not a number": robot(TWO, joint("j", "a", "b", inside='<origin xyz="1,5 0 0"/>')),
    "joint elbow_joint: <origin xyz>: needs 3 finite": urdf("ur10").replace("-0.612 0 0", "-0.612 nan 0"),
    "joint j: <axis>: has no xyz": robot(TWO, joint("j", "a", "b", inside='<axis xzy="1 0 0"/>')),
    "its axis has no length": urdf("ur10").replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', 1),
    "add up to 613 m, 20 m is the limit: it looks like millimetres": urdf("ur10").replace("-0.612 0 0", "-612 0 0"),
    "<origin rpy>: -90 rad is beyond 12.6: it looks like degrees": urdf("ur10").replace("-1.5707963267948966 0 0", "-90 0 0"),
    "<inertial> <mass>: -1 kg is below 0": urdf("ur10").replace('mass value="7.1"', 'mass value="-1"'),
}  # fmt: skip


@pytest.mark.parametrize("said", BAD)
def test_bad_descriptions(said: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BadRobot) as caught:
        read_chain(BAD[said])
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_joints_that_a_chain_cannot_hold(kind: str) -> None:
    text = robot(links("w", "l0"), joint("world", "w", "l0", kind), serial("rrr"))
    with pytest.raises(BadRobot, match=f"joint world: is {kind}, which a chain cannot hold: give another --base"):
        read_chain(text, tip="l3")
    assert read_chain(text, base="l0").n == 3


def test_outside_files_are_not_read(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.write_text('<link name="b"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/></joint>')
    text = f'<!DOCTYPE robot [<!ENTITY s SYSTEM "{outside.as_uri()}">]><robot name="r"><link name="a"/>&s;</robot>'
    with pytest.raises(BadRobot, match="no moving joint"):
        read_chain(text)


# -- what is too large ------------------------------------------------------------------------------------------------

MASS = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def row(count: int) -> str:
    """So many joints in a row, of which the first moves."""
    text = robot(links("l0") + serial("r" + "f" * (count - 1)))
    return text.replace('<link name="l1"/>', f'<link name="l1">{MASS}</link>')


LARGE: dict[str, Callable[[], str]] = {
    "has 251 joints in a row, 250 is the limit": lambda: row(251),
    "has 3001 links, 2000 is the limit": lambda: row(3000),
    "closes a loop": lambda: row(400).replace('<parent link="l0"/>', '<parent link="l400"/>'),
    "50 million characters, 5 million is the limit": lambda: row(3) + " " * 50_000_000,
}


@pytest.mark.slow
@pytest.mark.parametrize("said", LARGE)
def test_what_is_too_large_for_a_robot_is_refused_at_once(said: str) -> None:
    text = LARGE[said]()
    for reader in (read_chain, LoadedArm.read):
        begun = time.perf_counter()
        with pytest.raises(BadRobot, match=said):
            reader(text)
        assert time.perf_counter() - begun < 2.0


@pytest.mark.slow
def test_joints_in_a_row_up_to_the_limit_are_read() -> None:
    assert read_chain(row(250)).n == LoadedArm.read(row(250)).chain.n == 1


def test_a_description_of_an_object_is_bounded_too() -> None:
    begun = time.perf_counter()
    with pytest.raises(ModcalError, match="is the limit"):
        read("a" * 50_000_000)
    assert time.perf_counter() - begun < 0.5
