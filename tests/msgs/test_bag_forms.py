"""Bags in the forms that are met in public, and what modcal says of each; the table of docs/bags.md lists them all."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.writer import CompressionType
from msgs import bag_forms as forms
from msgs.bag_forms import Cell, Message
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from modcal_core.geometry import se3
from modcal_msgs_py.layout import definition, jazzy, message_class
from modcal_nodes.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
GOOD = "can be used for calibration from 40 finished stations (poses)"
POINTS = "can be used for calibration from 40 finished stations (points)"
SEPARATOR = "=" * 80 + "\n"
EVENT = "std_srvs/srv/SetBool_Event"


def plain(c: Cell) -> list[Message]:
    return [*forms.joints(c), *forms.described(c), *forms.readings(c)]


def without(c: Cell) -> list[Message]:
    """No tracker's topic under the contract's name."""
    return [*forms.joints(c), *forms.described(c)]


def stored(storage: StoragePlugin, packed: CompressionMode) -> Callable[[Cell, Path], Path]:
    return lambda c, folder: forms.write(folder / "bag", plain(c), storage, packed)


def with_others(make: Callable[[Cell], list[Message]]) -> Callable[[Cell, Path], Path]:
    return lambda c, folder: forms.write(folder / "bag", make(c))


def bare(storage: StoragePlugin, suffix: str) -> Callable[[Cell, Path], Path]:
    return lambda c, folder: next(forms.write(folder / "bag", plain(c), storage).glob(f"*{suffix}"))


def split(storage: StoragePlugin) -> Callable[[Cell, Path], Path]:
    """Three files, as `ros2 bag record --max-bag-duration` leaves them."""

    def make(c: Cell, folder: Path) -> Path:
        messages = sorted(plain(c), key=lambda m: m[3])
        third = len(messages) // 3
        names, stated = [], {}
        for k in range(3):
            part = forms.write(folder / f"part{k}", messages[k * third : None if k == 2 else (k + 1) * third], storage)
            (file,) = (f for f in part.iterdir() if f.name != "metadata.yaml")
            names.append(f"bag_{k}{file.suffix}")
            (folder / "bag").mkdir(exist_ok=True)
            shutil.move(file, folder / "bag" / names[-1])
            stated = yaml.safe_load((part / "metadata.yaml").read_text())
        stated["rosbag2_bagfile_information"]["relative_file_paths"] = names
        (folder / "bag" / "metadata.yaml").write_text(yaml.safe_dump(stated))
        return folder / "bag"

    return make


def by_mcap(
    encoding: str,
    kind: str,
    text: str,
    data: bytes,
    packed: CompressionType = CompressionType.ZSTD,
    chunked: bool = True,
) -> Callable[[Cell, Path], Path]:
    """A bare MCAP file with one topic more, of this type and definition."""

    def make(c: Cell, folder: Path) -> Path:
        messages = [*plain(c), *(("/other", kind, data, ns) for ns in c.stamps)]
        how = {"compression": packed, "use_chunking": chunked}
        return forms.mcap_file(folder / "bag.mcap", messages, {kind: (encoding, text)}, **how)

    return make


def spoiled_joint_state(c: Cell) -> list[Message]:
    """One of many is cut in the middle."""
    messages = plain(c)
    topic, kind, message, ns = messages[7]
    messages[7] = topic, kind, bytes(jazzy().serialize_cdr(message, kind))[:-30], ns
    return messages


def gripper(c: Cell) -> list[Message]:
    return [
        *plain(c),
        *(("/joint_states", forms.JOINT_STATE, forms.joint_state(ns, ["finger"], []), ns) for ns in c.stamps),
    ]


def nan_joint(c: Cell) -> list[Message]:
    q = c.q.copy()
    q[7, 2] = np.nan
    return plain(Cell(c.stamps, c.names, q, c.poses, c.urdf))


def lost_target(c: Cell) -> list[Message]:
    poses = c.poses.copy()
    poses[3] = np.nan
    poses[4:6] = 0.0
    readings = [
        ("/tracker/pose", forms.POSE, forms.reading(forms.POSE, ns, p), ns)
        for ns, p in zip(c.stamps, poses, strict=True)
    ]
    return [*without(c), *readings]


def two_robots(c: Cell) -> list[Message]:
    other = Cell(c.stamps, c.names, c.q[::-1].copy(), c.poses, c.urdf.replace('"-0.612 0 0"', '"-0.5 0 0"'))
    return [
        *forms.joints(c, "/arm_1/joint_states"), *forms.described(c, "/arm_1/robot_description"),
        *forms.joints(other, "/arm_2/joint_states"), *forms.described(other, "/arm_2/robot_description"),
        *forms.readings(c),
    ]  # fmt: skip


ARM_1 = ["--topic", "joint_states=/arm_1/joint_states", "--topic", "robot_description=/arm_1/robot_description"]
OBJECT = "<robot name='cup'><link name='cup'/></robot>"
IMU = "sensor_msgs/msg/Imu"
IDL = (
    f"{SEPARATOR}IDL: my_msgs/msg/Heat\nmodule my_msgs {{\n  module msg {{\n    struct Heat {{\n      double celsius;\n"
    "    };\n  };\n};\n"
)
HEAT = b"\0\1\0\0" + struct.pack("<d", 21.5)


def rosbag_1(c: Cell, folder: Path) -> Path:
    (folder / "old.mcap").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    return folder / "old.mcap"


def unknown_storage(c: Cell, folder: Path) -> Path:
    bag = forms.write(folder / "bag", plain(c))
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("bag.mcap", "bag.roahm"))
    (bag / "bag.mcap").rename(bag / "bag.roahm")
    return bag


Make = Callable[[Cell, Path], Path]
MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
# form: (bag, options, what is said)
FORMS: dict[str, tuple[Make, list[str], str]] = {
    "MCAP": (stored(MCAP, CompressionMode.NONE), [], GOOD),
    "MCAP, the file packed with zstd": (stored(MCAP, CompressionMode.FILE), [], GOOD),
    "MCAP, every message packed with zstd": (stored(MCAP, CompressionMode.MESSAGE), [], GOOD),
    "MCAP, chunks packed by the storage": (stored(MCAP, CompressionMode.STORAGE), [], GOOD),
    "MCAP, chunks packed with lz4": (by_mcap("ros2msg", IMU, "", b"", CompressionType.LZ4), [], GOOD),
    "MCAP without chunks": (by_mcap("ros2msg", IMU, "", b"", chunked=False), [], GOOD),
    "MCAP, the bare file": (bare(MCAP, ".mcap"), [], GOOD),
    "MCAP, split into three files": (split(MCAP), [], GOOD),
    "SQLite (`.db3`)": (stored(SQLITE, CompressionMode.NONE), [], GOOD),
    "SQLite, the file packed with zstd": (stored(SQLITE, CompressionMode.FILE), [], GOOD),
    "SQLite, every message packed with zstd": (stored(SQLITE, CompressionMode.MESSAGE), [], GOOD),
    "SQLite, the bare file": (bare(SQLITE, ".db3"), [], GOOD),
    "SQLite, split into three files": (split(SQLITE), [], GOOD),
    "a storage plugin of somebody's own": (unknown_storage, [], "is neither MCAP nor SQLite: convert it: ros2 bag convert"),
    "a bag of ROS 1": (rosbag_1, [], "it is a bag of ROS 1: convert it with rosbags-convert"),
    "a type defined in IDL": (by_mcap("ros2idl", "my_msgs/msg/Heat", IDL, HEAT), [], "signal:/other"),
    "service events (introspection)": (
        by_mcap("ros2msg", EVENT, "service_msgs/ServiceEventInfo info\nSetBool_Request[<=1] request\n", bytes(40)), [], GOOD
    ),
    "a type that refers to itself": (
        by_mcap("ros2msg", "my_msgs/msg/Node", f"Node next\n{SEPARATOR}MSG: my_msgs/Node\nNode next\n", bytes(40)), [], GOOD
    ),
    "a malformed message on another topic": (
        by_mcap("ros2msg", IMU, definition(IMU)[0], bytes(9)), [], "40 messages on /other were left out: they are not of type sensor_msgs/msg/Imu"
    ),
    "the tracker under a name of its own, the only one": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/vrpn/tool/pose")]), [],
        "/vrpn/tool/pose (PoseStamped) is used as tracker/pose: the only possible topic",
    ),
    "joint states under a name of their own, the only ones": (
        with_others(lambda c: [*forms.joints(c, "/arm/joints"), *forms.described(c), *forms.readings(c)]), [],
        "/arm/joints (JointState) is used as joint_states: the only possible topic",
    ),
    "the tracker, stated": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/vrpn/tool/pose")]), ["--topic", "tracker/pose=/vrpn/tool/pose"], GOOD
    ),
    "two topics that could be the tracker": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/left/pose"), *forms.readings(c, "/right/pose")]), [],
        "state which it is, if one of these measures it: --topic tracker/pose=/left/pose, --topic tracker/pose=/right/pose",
    ),
    "two such topics, one of them ignored": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/left/pose"), *forms.readings(c, "/right/pose")]),
        ["--ignore", "/right/pose"], "/left/pose (PoseStamped) is used as tracker/pose",
    ),
    "a topic that is not there is stated": (
        with_others(plain), ["--topic", "tracker/pose=/vrpn/pose"],
        "topic /vrpn/pose: is not in bag: there are /joint_states (JointState), /robot_description (String), /tracker/pose (PoseStamped)",
    ),
    "a topic of another type is stated": (
        with_others(plain), ["--topic", "tracker/pose=/joint_states"], "topic /joint_states: is a sensor_msgs/msg/JointState; tracker/pose is",
    ),
    "a pose in a frame of the robot (a TCP broadcaster)": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/arm/pose", frame="base_link")]), [],
        "/arm/pose is in base_link, a link of the robot: it looks computed from the joints and is not used",
    ),
    "a commanded pose": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/desired_pose")]), [], "tracker: no message on tracker/pose or tracker/point",
    ),
    "PoseWithCovarianceStamped": (
        with_others(lambda c: [*without(c), *forms.readings(c, kind=forms.WITH_COVARIANCE)]), [], GOOD
    ),
    "TransformStamped": (with_others(lambda c: [*without(c), *forms.readings(c, kind=forms.TRANSFORM)]), [], GOOD),
    "Odometry": (with_others(lambda c: [*without(c), *forms.readings(c, kind=forms.ODOMETRY)]), [], GOOD),
    "poses of which only the position counts": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/mocap/tool")]), ["--topic", "tracker/point=/mocap/tool"], POINTS
    ),
    "the tracker in /tf": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/tf", forms.TF)]), ["--tf", "tracker:tool"], GOOD
    ),
    "the tracker in /tf, without --tf": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/tf", forms.TF)]), [],
        "/tf (TFMessage) could be the tracker, by --tf PARENT:CHILD",
    ),
    "/tf of other frames": (
        with_others(lambda c: [*without(c), *forms.readings(c, "/tf", forms.TF)]), ["--tf", "tracker:hand"],
        "tf tracker:hand: are not connected: name two frames that are; there are tracker:tool",
    ),
    "a gripper whose joint states hold no positions": (
        with_others(gripper), [], "40 messages on /joint_states were left out: it holds names without positions"
    ),
    "one joint state that was cut": (
        with_others(spoiled_joint_state), [], "1 messages on /joint_states were left out: they are not of type sensor_msgs/msg/JointState"
    ),
    "one joint position that is NaN": (
        with_others(nan_joint), [], "/joint_states: no finite position of elbow_joint in 1 of 40 messages, first at 1700000014.000 s: left out"
    ),
    "a motion capture that loses its target": (
        with_others(lost_target), [], "/tracker/pose (tracker): without a target in 2 of 40 messages"
    ),
    "a later robot_description of something else": (
        with_others(lambda c: [*plain(c), forms.text("/robot_description", OBJECT, c.stamps[9])]), [],
        "/robot_description was published with 2 different contents: the one with most recorded joints was used",
    ),
    "two robots, one of them stated": (with_others(two_robots), ARM_1, GOOD),
    "no robot_description": (
        with_others(lambda c: [*forms.joints(c), *forms.readings(c)]), [], "holds no robot_description: give --urdf or --delta FILE"
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def c() -> Cell:
    return forms.cell()


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_what_is_said_of_a_form(form: str, c: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    make, options, said = FORMS[form]
    code = run(["info", str(make(c, tmp_path)), *options])
    out, err = capfd.readouterr()
    assert code in (0, 2)
    assert "Traceback" not in err
    assert said in " ".join((out + err).split())


def test_the_page_lists_every_form() -> None:
    page = (ROOT / "docs" / "bags.md").read_text()
    for form, (_, options, said) in FORMS.items():
        asked = f" `{' '.join(options)}`" if options else ""
        assert f"| {form}{asked} | {'read' if said in (GOOD, POINTS) else said} |" in page, form


def test_info_lists_every_topic_that_could_play_a_role(
    c: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    messages = [*plain(c), *forms.readings(c, "/other/odometry", forms.ODOMETRY), *forms.readings(c, "/tf", forms.TF)]
    assert run(["info", str(forms.write(tmp_path / "bag", messages)), "--json"]) == 0
    listed = {one["topic"]: one for one in json.loads(capfd.readouterr().out)["listed"]}
    assert listed["/tracker/pose"] == {
        "topic": "/tracker/pose", "type_name": forms.POSE, "count": 40, "role": "tracker/pose",
        "could": ["tracker/pose", "tracker/point"],
    }  # fmt: skip
    assert listed["/other/odometry"]["role"] is None
    assert listed["/other/odometry"]["could"] == ["tracker/pose", "tracker/point"]
    assert listed["/tf"]["could"] == ["tf"]


def test_a_way_through_tf_is_put_together(c: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A tracker on a mount, a target on a plate: two fixed parts and the one that is measured."""
    from modcal_msgs_py.mcap_read import read_recording
    from modcal_msgs_py.topics import Topics

    mount, plate = se3.exp([0.1, 0.2, 0.3, 0.1, 0.0, 0.2]), se3.exp([0.0, 0.05, 0.0, 0.0, 0.3, 0.0])
    fixed = [
        ("room", "tracker", se3.to_pose(mount)),
        ("tool", "plate", se3.to_pose(plate)),
    ]  # fmt: skip
    transforms = []
    for parent, child, values in fixed:
        one = forms.reading(forms.TRANSFORM, c.stamps[0], values, parent)
        one.child_frame_id = child
        transforms.append(one)
    latched = ("/tf_static", forms.TF, message_class(forms.TF)(transforms), c.stamps[0])
    bag = forms.write(tmp_path / "bag", [*without(c), latched, *forms.readings(c, "/tf", forms.TF)])
    (track,) = read_recording(bag, topics=Topics.of(tf="room:plate")).readings
    assert track.frame == "room"
    assert np.abs(se3.from_pose(track.values) - mount @ se3.from_pose(c.poses) @ plate).max() < 1e-9
    (back,) = read_recording(bag, topics=Topics.of(tf="plate:room")).readings
    assert np.abs(se3.from_pose(back.values) @ se3.from_pose(track.values) - np.eye(4)).max() < 1e-9


def test_a_door_on_a_cart_that_rolls_is_a_door(c: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Both are seen by one camera, neither at the other's times; what moves the handle in the cart is its hinge."""
    start, messages = c.stamps[0], []
    arm = se3.exp([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    for child, rate in (("cart", 37.0), ("handle", 50.0)):
        for k in range(round(6.0 * rate)):
            t = k / rate
            T = se3.exp([0.15 * t, 0.05 * np.sin(t), 0.0, 0.0, 0.0, 0.1 * t])
            if child == "handle":
                T = T @ se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.2 * t]) @ arm
            ns = start + round(1e9 * t)
            one = forms.reading(forms.TRANSFORM, ns, se3.to_pose(T), "camera")
            one.child_frame_id = child
            messages.append(("/tf", forms.TF, message_class(forms.TF)([one]), ns))
    bag = forms.write(tmp_path / "bag", sorted(messages, key=lambda m: m[3]))
    out = tmp_path / "out"
    assert run(["articulate", str(bag), "--tf", "cart:handle", "--out", str(out), "--json"]) == 0
    data = json.loads(capfd.readouterr().out)
    assert data["kind"] == "revolute"
    assert data["joint"]["radius"] == pytest.approx(0.4, abs=2e-4)


def test_tf_along_the_robot_is_no_measurement(c: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    links = forms.readings(c, "/tf", forms.TF, frame="base_link")
    for _, _, message, _ in links:
        message.transforms[0].child_frame_id = "tool0"
    bag = forms.write(tmp_path / "bag", [*without(c), *links])
    assert run(["info", str(bag), "--tf", "base_link:tool0"]) == 2
    assert "it was computed from the joints and is not a measurement" in capfd.readouterr().err
