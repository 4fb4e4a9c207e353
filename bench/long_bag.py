"""An hour of an arm at 1 kHz, from the bag to the report: seconds of the processor, memory, messages a second.

    python bench/long_bag.py [--minutes 60] [--compression zstd|none]

The stations' truth is MuJoCo's; the joints run at 1 kHz, and a tracker reads at 30 Hz while the arm stands. Calibration
is the command itself, in a process of its own. rosbags reads the beginning of such a file in the same run.
Exits with 1 where it takes longer than 20 s of the processor for an hour, or more than 1 GB.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "bench" / "speed")]
import conftest  # noqa: E402, F401 (finds the install tree)
import numpy as np  # noqa: E402
from cells import record, ur10  # noqa: E402
from mcap.writer import CompressionType, Writer  # noqa: E402
from rosbags.rosbag2 import Reader  # noqa: E402
from timing import machine_scale, median_ms  # noqa: E402

from modcal_core.geometry import se3  # noqa: E402
from modcal_core.geometry.so3 import Array  # noqa: E402
from modcal_msgs_py.fields import fields_of  # noqa: E402
from modcal_msgs_py.layout import MessageLayout  # noqa: E402
from modcal_msgs_py.mcap_read import read_bag  # noqa: E402
from modcal_msgs_py.types import definition, jazzy, message_class, serialise  # noqa: E402

RATE, EVERY = 1000, 33  # joint states a second, of which each 33rd has a reading
STAND, TRAVEL = 2.5, 1.0  # s
START = 1_700_000_000  # s
MAX_SECONDS, MAX_MB = 20.0, 1000.0
PEER = 60_000  # messages that the other one reads
JOINTS, POSE, TEXT = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/String"


class Stamped:
    """Messages of one type that differ in stamps and numbers only."""

    def __init__(self, type_name: str, sample: object) -> None:
        self._bytes = serialise(sample, type_name)
        schema, _ = definition(type_name)
        fields = fields_of(type_name, {type_name: schema})
        layout = MessageLayout.of(fields, self._bytes) if fields is not None else None
        assert layout is not None
        self._at = {path: (column.at, column.dtype) for path, column in layout.columns.items()}

    def all(self, stamps: Array, columns: dict[str, Array]) -> np.ndarray:
        """The messages as rows of bytes. stamps: nanoseconds (n,). columns: numbers (n, k) by path."""
        rows = np.tile(np.frombuffer(self._bytes, np.uint8), (len(stamps), 1))
        for path, values in {
            "header/stamp/sec": stamps[:, None] // 10**9,
            "header/stamp/nanosec": stamps[:, None] % 10**9,
            **columns,
        }.items():
            at, dtype = self._at[path]
            raw = np.ascontiguousarray(values, dtype=dtype).view(np.uint8).reshape(len(stamps), -1)
            rows[:, at : at + raw.shape[1]] = raw
        return rows


def write(path: Path, minutes: float, compression: CompressionType) -> int:
    """Write the recording; how many messages it has."""
    period = STAND + TRAVEL
    stations = int(60.0 * minutes / period)
    made = record(1, stations + 1).samples
    poses = se3.to_pose(se3.transform(made.R, made.reading))
    rng, count = np.random.default_rng(0), 0
    name = {key: message_class(f"geometry_msgs/msg/{key}") for key in ("Pose", "Point", "Quaternion")}
    header = message_class("std_msgs/msg/Header")
    time_of = message_class("builtin_interfaces/msg/Time")
    zeros = np.zeros(6)
    states = Stamped(JOINTS, message_class(JOINTS)(header(time_of(0, 0), ""), list(made.names), zeros, zeros, zeros))
    pose = name["Pose"](name["Point"](0.0, 0.0, 0.0), name["Quaternion"](0.0, 0.0, 0.0, 1.0))
    readings = Stamped(POSE, message_class(POSE)(header(time_of(0, 0), "tracker"), pose))
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start("ros2", "bench")
        channels = {}
        for topic, type_name in (("/joint_states", JOINTS), ("/tracker/pose", POSE), ("/robot_description", TEXT)):
            schema = writer.register_schema(type_name, "ros2msg", definition(type_name)[0].encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        urdf = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()
        writer.add_message(
            channels["/robot_description"], START * 10**9, serialise(message_class(TEXT)(urdf), TEXT), START * 10**9
        )
        since = np.arange(int(period * RATE)) / RATE
        u = np.clip((since - STAND) / TRAVEL, 0.0, 1.0)
        u = (u**3 * (10.0 - 15.0 * u + 6.0 * u**2))[:, None]
        for k in range(stations):
            stamps = START * 10**9 + np.round((k * period + since) * 1e9).astype(np.int64)
            q = made.q[k] + u * (made.q[k + 1] - made.q[k]) + 1e-6 * rng.normal(size=(len(stamps), 6))
            said = states.all(stamps, {"position": q})
            seen = np.flatnonzero((np.arange(len(stamps)) % EVERY == 0) & (since < STAND))
            noisy = np.tile(poses[k], (len(seen), 1))
            noisy[:, :3] += 2e-5 * rng.normal(size=(len(seen), 3))
            parts = [*(f"pose/position/{a}" for a in "xyz"), *(f"pose/orientation/{a}" for a in "xyzw")]
            read = readings.all(stamps[seen], {path: noisy[:, i : i + 1] for i, path in enumerate(parts)})
            reading = dict(zip(seen.tolist(), read, strict=True))
            for i, stamp in enumerate(stamps.tolist()):
                writer.add_message(channels["/joint_states"], stamp, said[i].tobytes(), stamp)
                if i in reading:
                    writer.add_message(channels["/tracker/pose"], stamp, reading[i].tobytes(), stamp)
            count += len(stamps) + len(seen)
        writer.finish()
    return count


def others(path: Path) -> float:
    """Messages that rosbags decodes in a second of the processor, of the beginning of the file."""
    store, begun, count = jazzy(), time.process_time(), 0
    with Reader(path.parent) as reader:
        for connection, _, raw in reader.messages():
            store.deserialize_cdr(raw, connection.msgtype)
            count += 1
            if count == PEER:
                break
    return count / (time.process_time() - begun)


def main() -> int:
    """Run and say."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--minutes", type=float, default=60.0)
    asked.add_argument("--compression", choices=("zstd", "none"), default="zstd")
    chosen = asked.parse_args()
    assert ur10().n == 6
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "hour.mcap"
        count = write(bag, chosen.minutes, CompressionType[chosen.compression.upper()])
        print(f"{count} messages, {bag.stat().st_size / 1e6:.0f} MB", flush=True)
        part = Path(folder) / "part.mcap"
        some = write(part, min(chosen.minutes, 5.0), CompressionType[chosen.compression.upper()])
        ours = 1e3 * some / median_ms(lambda: read_bag(part), 5)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        wall = time.monotonic()
        done = subprocess.run([ROOT / ".venv/bin/modcal", "calibrate", bag, "--out", Path(folder) / "out"], check=False)
        wall = time.monotonic() - wall
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        memory = after.ru_maxrss / 1e3
        print(f"read into arrays: {ours / 1e6:.2f} million messages a second of the processor")
        print(f"this machine takes {machine_scale():.2f} times as long as that of the published figures")
        print(f"bag to report: {spent:.1f} s of the processor, {wall:.1f} s by the clock, {memory:.0f} MB at most")
        whole = Path(folder) / "bag"
        whole.mkdir()
        part.rename(whole / "bag_0.mcap")
        (whole / "metadata.yaml").write_text(_metadata(some))
        theirs = others(whole / "bag_0.mcap")
        print(f"rosbags: {theirs / 1e6:.3f} million messages a second; {ours / theirs:.0f} x")
    too_long = spent > MAX_SECONDS * chosen.minutes / 60.0 + 10.0 * (chosen.minutes < 30.0)
    return int(done.returncode != 0 or too_long or memory > MAX_MB)


def _metadata(count: int) -> str:
    """What rosbags wants beside the file."""
    topics = "".join(
        f"    - topic_metadata: {{name: {topic}, type: {type_name}, serialization_format: cdr, "
        "offered_qos_profiles: ''}\n      message_count: 1\n"
        for topic, type_name in (("/joint_states", JOINTS), ("/tracker/pose", POSE), ("/robot_description", TEXT))
    )
    return (
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  duration: {nanoseconds: 1}\n"
        f"  starting_time: {{nanoseconds_since_epoch: {START * 10**9}}}\n  message_count: {count}\n"
        f"  topics_with_message_count:\n{topics}  compression_format: ''\n  compression_mode: ''\n"
        "  relative_file_paths: [bag_0.mcap]\n  files: []\n"
    )


if __name__ == "__main__":
    sys.exit(main())
