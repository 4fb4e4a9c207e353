"""What a bag must hold besides the bytes of its messages, captures of others, and a calibration as a message."""

from __future__ import annotations

import json
import struct
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from types import SimpleNamespace as S
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from modcal_interfaces.msg import Calibration, Checked, ObjectState, Verdict
from msgs import bag_forms as forms
from rcl_interfaces.msg import Parameter

from modcal_core.errors import BadCommand, BadRecording, BadTable, ModcalError
from modcal_core.geometry import Array, se3
from modcal_msgs_py.layout import definition, learn, message_class, serialise
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.mcap_repair import repair_bag
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.messages import RecordingBuilder
from modcal_msgs_py.readings import seconds, set_seconds
from modcal_msgs_py.tables import import_tables
from modcal_msgs_py.topics import Joints, Reading, added_topics, role_of
from modcal_msgs_py.typed import calibration_data, fill_calibration

STRING, JOINTS = "std_msgs/msg/String", "sensor_msgs/msg/JointState"


def joint_state(names: list[str], sec: int) -> Any:
    return forms.joint_state(sec * 10**9, names, np.arange(float(len(names))))


def test_a_stamp_is_the_nearest_nanosecond(rng: np.random.Generator) -> None:
    for nanoseconds in rng.integers(0, 10**12, 300).tolist():
        stamp = SimpleNamespace(sec=0, nanosec=0)
        for part, nearest in ((0.0, 0), (0.4, 0), (0.6, 1)):
            set_seconds(stamp, (nanoseconds + part) * 1e-9)
            assert stamp.sec * 10**9 + stamp.nanosec == nanoseconds + nearest
        assert seconds(stamp) == pytest.approx(nanoseconds * 1e-9, abs=2e-9)


def test_when_a_message_was_published_is_kept_beside_when_it_came(tmp_path: Path) -> None:
    cdr = serialise(message_class(STRING)(data="x"), STRING)
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/said", STRING)
        bag.write_raw("/said", cdr, 2000, 1500)
        bag.write_raw("/said", cdr, 3000)
    with bag.file.open("rb") as stream:
        times = [(m.log_time, m.publish_time) for _, _, m in make_reader(stream).iter_messages()]
    assert times == [(2000, 1500), (3000, 3000)]


def bag_with_a_silent_topic(folder: Path) -> Path:
    cdr = serialise(message_class(STRING)(data="x"), STRING)
    with BagWriter(folder) as bag:
        bag.add_topic("/said", STRING)
        bag.add_topic("/silent", STRING)
        for k in range(5):
            bag.write_raw("/said", cdr, 1000 + k)
    return bag.file


def test_a_topic_without_a_message_is_in_the_repaired_bag_too(tmp_path: Path) -> None:
    file = bag_with_a_silent_topic(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    repair_bag(tmp_path / "bag", tmp_path / "new")
    with (tmp_path / "new" / "new_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert {channel.topic for channel in summary.channels.values()} == {"/said", "/silent"}
    assert file.exists()


def test_an_index_that_counts_other_messages_is_a_fault(tmp_path: Path) -> None:
    data = bytearray(bag_with_a_silent_topic(tmp_path / "bag").read_bytes())
    # the record of statistics: opcode 0x0b, its length, then the count of messages
    at = next(
        i
        for i in range(len(data) - 1, 0, -1)
        if data[i] == 0x0B and 46 <= struct.unpack_from("<Q", data, i + 1)[0] <= 100
        and struct.unpack_from("<Q", data, i + 9)[0] == 5
    )  # fmt: skip
    struct.pack_into("<Q", data, at + 9, 7)
    (tmp_path / "alone.mcap").write_bytes(data)
    done = repair_bag(tmp_path / "alone.mcap", tmp_path / "new")
    assert done.saved["/said"] == 5
    assert any("counts 7 messages, it holds 5" in reason for reason in done.reasons)


def test_a_name_that_stands_twice_is_refused() -> None:
    with pytest.raises(BadRecording, match="2 positions for 2 names, 1 of them distinct"):
        RecordingBuilder().add("/joint_states", JOINTS, joint_state(["a", "a"], 1))


def test_a_message_without_a_stamp_is_of_when_it_came() -> None:
    builder = RecordingBuilder()
    for k in range(3):
        builder.add("/joint_states", JOINTS, joint_state(["a", "b"], 0), 100.0 + k)
    recording = builder.recording()
    assert recording.joints[0].stamps.tolist() == [100.0, 101.0, 102.0]
    assert "3 messages on /joint_states had no stamp" in recording.warnings[0]


def test_the_plain_topic_is_preferred_to_one_in_a_namespace() -> None:
    builder = RecordingBuilder()
    builder.add("/left/joint_states", JOINTS, joint_state(["a", "b"], 1))
    assert [track.topic for track in builder.recording().joints] == ["/left/joint_states"]
    builder.add("/joint_states", JOINTS, joint_state(["a", "b"], 2))
    assert [track.topic for track in builder.recording().joints] == ["/joint_states"]


def test_tables_that_have_lost_their_clock_follow_one_another(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("j,x,y,z\n0.1,1,2,3\n0.2,1,2,4\n0.3,1,2,5\n")
    entry = {
        "files": "*.csv",
        "time": {"order": {"period_s": 10.0}},
        "joints": {"unit": "rad", "columns": {"j": "j"}},
        "point": {"frame": "tracker", "unit": "m", "position": ["x", "y", "z"]},
    }
    recording = import_tables({"tables": [entry]}, tmp_path, "mapping")
    (joints,) = recording.joints
    assert len(joints.stamps) == 6
    assert (np.diff(joints.stamps) > 0.0).all()


def test_logs_stamps_and_counters_are_no_signals(tmp_path: Path) -> None:
    time = message_class("builtin_interfaces/msg/Time")(sec=5, nanosec=7)
    header = message_class("std_msgs/msg/Header")(stamp=time, frame_id="")
    told = {
        "sensor_msgs/msg/TimeReference": {"header": header, "time_ref": time, "source": "gps"},
        "rcl_interfaces/msg/Log": {
            "stamp": time, "level": 20, "name": "n", "msg": "m", "file": "f", "function": "g", "line": 12
        },
        "std_msgs/msg/Float64": {"data": 1.5},
    }  # fmt: skip
    with BagWriter(tmp_path / "bag") as bag:
        for k, (type_name, values) in enumerate(told.items()):
            bag.write(f"/topic_{k}", type_name, message_class(type_name)(**values), 10**18 + k)
    recording = read_recording(tmp_path / "bag")
    assert [signal.name for signal in recording.signals] == ["signal:/topic_2"]


GRID = np.array([(0.03 * x, 0.03 * y, 0.0) for x in range(4) for y in range(3)])
T = se3.exp(np.array([0.1, -0.2, 0.9, 0.4, 2.0, -0.3]))


def observation(frame: str, points: Array, focal: float) -> S:
    header = S(frame_id=frame)
    features = [S(header=header, point=S(x=x, y=y, z=z)) for x, y, z in points.tolist()]
    return S(features=features, ext_camera_info=S(camera_info=S(k=np.r_[focal, np.zeros(8)])))


def taken(*observations: S) -> list[Reading]:
    states = S(name=["a", "b"], position=[0.1, 0.2], velocity=[], effort=[])
    joints, *readings = added_topics()["calibration_data"].take(S(joint_states=states, observations=observations))
    assert joints == Joints(["a", "b"], [0.1, 0.2], [], [])
    return [reading for reading in readings if isinstance(reading, Reading)]


@pytest.mark.parametrize("camera_first", [True, False])
def test_features_of_arm_and_camera_are_a_pose(camera_first: bool) -> None:
    both = [observation("optical", se3.apply(T, GRID), 600.0), observation("tool0", GRID, 0.0)]
    (reading,) = taken(*(both if camera_first else both[::-1]))
    assert (reading.kind, reading.frame) == ("pose", "optical")
    x, y, z, qx, qy, qz, qw = reading.values
    assert np.allclose([x, y, z], T[:3, 3], atol=1e-12)
    assert abs(qx**2 + qy**2 + qz**2 + qw**2 - 1.0) < 1e-12
    assert np.degrees(2.0 * np.arccos(abs(qw))) == pytest.approx(np.degrees(np.linalg.norm(se3.log(T)[3:])), abs=1e-6)


def test_one_feature_is_a_point_and_what_no_camera_saw_is_nothing() -> None:
    (reading,) = taken(observation("optical", GRID[4:5], 600.0), observation("tool0", GRID[:1], 0.0))
    assert (reading.kind, list(reading.values)) == ("point", GRID[4].tolist())
    assert taken(observation("tool0", GRID, 0.0)) == []
    assert taken(observation("optical", GRID, 600.0)) == []  # nobody says where on the target the features are


def test_the_topic_in_any_namespace() -> None:
    assert role_of("/fetch/calibration_data", "robot_calibration_msgs/msg/CalibrationData") == "calibration_data"


NUMBERS = st.floats(allow_nan=False) | st.integers(-(2**63), 2**63 - 1)
WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=5)
KEYS = WORDS.map(str) | st.sampled_from(["a/b", "~1", "[0]", "~", "[", "x[1]/y~2"])
TREES = st.recursive(
    st.none() | st.booleans() | NUMBERS | WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=20,
)


@given(st.dictionaries(KEYS, TREES, min_size=1, max_size=5))
def test_what_comes_back_is_what_went_in(data: dict[str, Any]) -> None:
    assert calibration_data(fill_calibration(Calibration(), Parameter, data)) == data


def test_a_type_that_is_known_by_its_class_has_the_hash_that_ros_gives_it(install: Path) -> None:
    """So a bag holds it as `ros2 bag record` would."""
    for kind in (Calibration, Checked, ObjectState, Verdict):
        name = f"modcal_interfaces/msg/{kind.__name__}"
        assert learn(name, lambda n: getattr(import_module(n.replace("/", ".").rpartition(".")[0]), n.split("/")[-1]))
        told = json.loads((install / "modcal_interfaces/share" / f"{name}.json").read_text())
        assert not learn(f"{name}Missing", lambda _: None)
        assert definition(name)[1] == told["type_hashes"][0]["hash_string"]


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (Calibration(version=2), "has version 2, 1 is read"),
        (Calibration(values=[Parameter(name="a"), Parameter(name="a/b")]), "lies below a value"),
        (Calibration(values=[Parameter(name="[0]")]), "is a list"),
        (SimpleNamespace(version=1, values=range(10**9)), "is the limit"),
    ],
)
def test_what_is_none_is_refused(message: Calibration, said: str) -> None:
    with pytest.raises(ModcalError, match=said) as caught:
        calibration_data(message)
    assert isinstance(caught.value, BadCommand | BadTable)
