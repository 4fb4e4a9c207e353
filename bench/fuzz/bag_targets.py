"""Bags that are fuzzed: MCAP and SQLite files, and what metadata.yaml says of them."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from data_cases import case as data_case
from data_cases import places
from mcap_cases import case as mcap_case
from mcap_cases import parts, spoilt_bytes
from target import Target, yaml_text

from modcal_core.errors import ModcalError
from modcal_core.geometry import se3
from modcal_core.measurements.inspection import inspect
from modcal_core.measurements.recording import Recording
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.choosing import Topics
from modcal_msgs_py.mcap_read import read_bag
from modcal_msgs_py.mcap_repair import repair_bag
from modcal_msgs_py.mcap_walk import McapFile
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.recording_write import write_recording
from modcal_msgs_py.types import message_class


def recording() -> Recording:
    """A short recording of everything that a bag may hold."""
    from modcal_core.measurements.recording import JointTrack, ReadingTrack, SignalTrack

    t = 1.7e9 + np.arange(6.0)
    q = 0.1 * np.arange(36.0).reshape(6, 6)
    names = (
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    )
    poses = se3.to_pose(se3.exp(0.1 * np.arange(36.0).reshape(6, 6)))
    return Recording(
        (JointTrack(names, t, q, q, q, t),),
        (
            ReadingTrack("pose", "tracker", t, poses, t),
            ReadingTrack("range", "wire", t, poses[:, :1], t, "/tracker/range"),
        ),
        (SignalTrack("temperature:base_link", t, poses[:, :1], "/temperature"),),
        "<robot name='r'><link name='a'/><link name='b'/><joint name='elbow_joint' type='revolute'><parent link='a'/>"
        "<child link='b'/><limit lower='-1' upper='1' effort='1' velocity='1'/></joint></robot>",
        "made",
    )


def _others(bag: BagWriter) -> None:
    """Transforms, odometry and a type that only the bag defines."""
    header, stamp = message_class("std_msgs/msg/Header"), message_class("builtin_interfaces/msg/Time")
    vector, quaternion = message_class("geometry_msgs/msg/Vector3"), message_class("geometry_msgs/msg/Quaternion")
    turn = quaternion(0.0, 0.0, 0.0, 1.0)
    one = message_class("geometry_msgs/msg/TransformStamped")(
        header(stamp(1_700_000_000, 5), "tracker"), "tool",
        message_class("geometry_msgs/msg/Transform")(vector(1.0, 2.0, 3.0), turn),
    )  # fmt: skip
    battery = message_class("sensor_msgs/msg/Imu")
    imu = battery(header(stamp(1_700_000_000, 0), "imu"), turn, np.zeros(9), vector(0.0, 0.0, 0.0), np.zeros(9),
                  vector(0.0, 0.0, 9.8), np.zeros(9))  # fmt: skip
    two = replace(one, transform=message_class("geometry_msgs/msg/Transform")(vector(1.0, 2.0, 3.5), turn))
    for topic, kind, message in (
        ("/tf", "tf2_msgs/msg/TFMessage", message_class("tf2_msgs/msg/TFMessage")([two, one])),
        ("/tf", "tf2_msgs/msg/TFMessage", message_class("tf2_msgs/msg/TFMessage")([one])),
        ("/vrpn/pose", "geometry_msgs/msg/TransformStamped", one),
        ("/imu", "sensor_msgs/msg/Imu", imu),
    ):
        bag.write(topic, kind, message, 1_700_000_000_000_000_000 + len(str(message)))


def bag_bytes(folder: Path) -> bytes:
    """A whole file with all of it."""
    made = recording()
    write_recording(made, folder / "first")
    with BagWriter(folder / "second") as bag:
        for topic, kind, data, ns in _messages_of(folder / "first"):
            bag.add_topic(topic, kind)
            bag.write_raw(topic, data, ns)
        _others(bag)
    return next((folder / "second").glob("*.mcap")).read_bytes()


def _messages_of(folder: Path) -> list[tuple[str, str, bytes, int]]:
    file = McapFile(next(folder.glob("*.mcap")))
    return [(m.topic, m.type_name, bytes(m.cdr), m.received_ns) for m in file.messages()]


def mcap_target(folder: Path) -> Target:
    """Bags, read, inspected, and one in four repaired."""
    raw = bag_bytes(folder)
    base = parts(raw)
    file, counter = folder / "case.mcap", [0]
    wishes = (Topics(), Topics(tf=("tracker", "tool")), Topics.of(["tracker/pose=/vrpn/pose"], ["/imu"]))

    def run(data: bytes) -> None:
        file.write_bytes(data)
        counter[0] += 1
        if counter[0] % 4 == 0:
            out = folder / f"repaired{counter[0]}"
            repair_bag(file, out)
            shutil.rmtree(out, ignore_errors=True)
        seen = read_bag(file, topics=wishes[counter[0] % 3])
        chain = None
        if seen.robot_description is not None:
            with contextlib.suppress(ModcalError):
                chain = read_chain(seen.robot_description, None, None)
        inspect(seen, chain)

    return Target("mcap", lambda rng: mcap_case(base, raw, rng), run)


def sqlite_target(folder: Path) -> Target:
    """SQLite bags with bytes changed, and with messages changed."""
    made, file = folder / "made.db3", folder / "case.db3"
    with contextlib.closing(sqlite3.connect(made)) as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
            "offered_qos_profiles TEXT); CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data BLOB);"
        )
        (folder / "for_sqlite").mkdir()
        write_recording(recording(), folder / "for_sqlite" / "bag")
        known: dict[str, int] = {}
        for topic, kind, data, ns in _messages_of(folder / "for_sqlite" / "bag"):
            if topic not in known:
                known[topic] = len(known) + 1
                base.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", (known[topic], topic, kind))
            base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", (known[topic], ns, data))
        base.commit()
    raw = made.read_bytes()

    def make(rng: np.random.Generator) -> bytes:
        out = raw
        for _ in range(int(rng.integers(1, 6))):
            out = spoilt_bytes(out, rng)
        return out

    def run(data: bytes) -> None:
        file.write_bytes(data)
        inspect(read_bag(file))

    return Target("sqlite", make, run)


def metadata_target(folder: Path) -> Target:
    """metadata.yaml of a folder, read and repaired by."""
    bag = folder / "described"
    write_recording(recording(), bag)
    base = yaml.safe_load((bag / "metadata.yaml").read_text())
    ways = places(base)
    counter = [0]

    def run(case: Any) -> None:
        (bag / "metadata.yaml").write_text(yaml_text(case), encoding="utf-8")
        counter[0] += 1
        with contextlib.suppress(ModcalError):
            repair_bag(bag, folder / f"anew{counter[0]}")
        shutil.rmtree(folder / f"anew{counter[0]}", ignore_errors=True)
        read_bag(bag)

    return Target("metadata", lambda rng: data_case(base, ways, rng), run)
