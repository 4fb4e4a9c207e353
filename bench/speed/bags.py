"""Reading bags into arrays, against rosbags; and cutting stations."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from cli.recordings import streams
from peers import ask
from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_typestore
from timing import Row, median_ms, pair_ms

from modcal_core.measurements.stations import cut_stations
from modcal_msgs_py.mcap_read import read_bag
from modcal_msgs_py.recording_write import write_recording


def rows(stations: int = 60) -> Iterator[Row]:
    """Of a stream of joint states and poses. All of them decode every message into numbers."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        recording = streams(stations)
        write_recording(recording, bag)
        store = get_typestore(Stores.ROS2_JAZZY)

        def peer(bag: Path = bag) -> Any:
            with Reader(bag) as reader:
                return [(c.topic, store.deserialize_cdr(raw, c.msgtype)) for c, _, raw in reader.messages()]

        read = peer()
        q = np.array([message.position for topic, message in read if topic == "/joint_states"])
        assert np.array_equal(q, read_bag(bag).joints[0].position), "other joint positions"
        ours, other = pair_ms(lambda: read_bag(bag), peer, 5, 3)
        rate = f"{len(read) / ours:.0f} k messages/s into arrays"
        yield Row("bags", f"{len(read)} messages", ours, "rosbags", other, rate)
        answer = ask("mcap-ros2-support", "mcap_decode", str(next(bag.glob("*.mcap"))))
        yield Row("bags", f"{len(read)} messages", ours, "mcap-ros2-support", answer.ms, answer.remark)
        sqlite = Path(folder) / "sqlite"
        with Reader(bag) as reader, Writer(sqlite, version=9) as writer:
            known = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
            for connection, stamp, raw in reader.messages():
                writer.write(known[connection.id], stamp, raw)
        assert np.array_equal(read_bag(sqlite).joints[0].position, q), "other joint positions"
        ours, other = pair_ms(lambda: read_bag(sqlite), lambda: peer(sqlite), 5, 3)
        rate = f"{len(read) / ours:.0f} k messages/s into arrays"
        yield Row("bags", f"{len(read)} messages, SQLite", ours, "rosbags", other, rate)
        names = recording.joints[0].names
        ms = median_ms(lambda: cut_stations(recording, names), 3)
        yield Row("bags", f"stations of {len(recording.joints[0].stamps)} joint states", ms)
