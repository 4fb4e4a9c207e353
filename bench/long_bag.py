"""An hour of an arm at 1 kHz, from the bag to the report: seconds of the processor, memory, messages a second.

    make bench NAME=long_bag                       # ARGS="--minutes 5 --compression none"

The stations' truth is MuJoCo's; the joints run at 1 kHz, and a tracker reads at 30 Hz while the arm stands. Calibration
is the command itself, in a process of its own. Exit code 1 where it takes more than 20 s of the processor for an hour,
or more than 1 GB. How fast rosbags reads beside it: `make bench NAME=speed ARGS="--only bags"`.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import harness

# isort: split
import conftest  # noqa: F401 (finds the install tree)
import numpy as np
from cells import record
from mcap.writer import CompressionType, Writer

from modcal_core.geometry import Array, se3
from modcal_msgs_py.layout import MessageLayout, definition, fields_of, message_class, serialise
from modcal_msgs_py.mcap_read import read_recording

RATE, EVERY = 1000, 33  # joint states a second, of which each 33rd has a reading
STAND, TRAVEL = 2.5, 1.0  # s
START = 1_700_000_000 * 10**9  # ns
MAX_SECONDS, MAX_MB = 20.0, 1000.0
JOINTS, POSE, TEXT = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/String"
POSITION = [*(f"pose/position/{a}" for a in "xyz"), *(f"pose/orientation/{a}" for a in "xyzw")]


def stamped(type_name: str, sample: object) -> Callable[[Array, dict[str, Array]], list[bytes]]:
    """Makes messages of one type, by stamps [ns] (n,) and numbers (n, k) by path, in which they differ."""
    whole = serialise(sample, type_name)
    layout = MessageLayout.of(fields_of(type_name, {type_name: definition(type_name)[0]}), whole)

    def made(stamps: Array, columns: dict[str, Array]) -> list[bytes]:
        rows = np.tile(np.frombuffer(whole, np.uint8), (len(stamps), 1))
        sec, nanosec = np.divmod(stamps[:, None], 10**9)
        for path, values in {"header/stamp/sec": sec, "header/stamp/nanosec": nanosec, **columns}.items():
            column = layout.columns[path]
            raw = np.ascontiguousarray(values, dtype=column.dtype).view(np.uint8).reshape(len(stamps), -1)
            rows[:, column.at : column.at + raw.shape[1]] = raw
        return [row.tobytes() for row in rows]

    return made


def write(path: Path, minutes: float, compression: CompressionType) -> int:
    """Write the recording; how many messages it has."""
    period, rng, count = STAND + TRAVEL, np.random.default_rng(0), 0
    stations = int(60.0 * minutes / period)
    made = record(1, stations + 1).samples
    poses = se3.to_pose(se3.transform(made.R, made.reading))
    kind = {key: message_class(f"geometry_msgs/msg/{key}") for key in ("Pose", "Point", "Quaternion")}
    header, stamp_of = message_class("std_msgs/msg/Header"), message_class("builtin_interfaces/msg/Time")
    zeros = np.zeros(6)
    states = stamped(JOINTS, message_class(JOINTS)(header(stamp_of(0, 0), ""), list(made.names), zeros, zeros, zeros))
    pose = kind["Pose"](kind["Point"](0.0, 0.0, 0.0), kind["Quaternion"](0.0, 0.0, 0.0, 1.0))
    readings = stamped(POSE, message_class(POSE)(header(stamp_of(0, 0), "tracker"), pose))
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start("ros2", "bench")
        channels = {}
        for topic, type_name in (("/joint_states", JOINTS), ("/tracker/pose", POSE), ("/robot_description", TEXT)):
            schema = writer.register_schema(type_name, "ros2msg", definition(type_name)[0].encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        urdf = serialise(message_class(TEXT)((harness.ROBOTS / "ur10.urdf").read_text()), TEXT)
        writer.add_message(channels["/robot_description"], START, urdf, START)
        since = np.arange(int(period * RATE)) / RATE
        u = np.clip((since - STAND) / TRAVEL, 0.0, 1.0)
        u = (u**3 * (10.0 - 15.0 * u + 6.0 * u**2))[:, None]
        seen = np.flatnonzero((np.arange(len(since)) % EVERY == 0) & (since < STAND))
        for k in range(stations):
            stamps = START + np.round((k * period + since) * 1e9).astype(np.int64)
            q = made.q[k] + u * (made.q[k + 1] - made.q[k]) + 1e-6 * rng.normal(size=(len(stamps), 6))
            noisy = np.tile(poses[k], (len(seen), 1))
            noisy[:, :3] += 2e-5 * rng.normal(size=(len(seen), 3))
            read = readings(stamps[seen], {name: noisy[:, i : i + 1] for i, name in enumerate(POSITION)})
            reading = dict(zip(seen.tolist(), read, strict=True))
            for i, said in enumerate(states(stamps, {"position": q})):
                writer.add_message(channels["/joint_states"], int(stamps[i]), said, int(stamps[i]))
                if i in reading:
                    writer.add_message(channels["/tracker/pose"], int(stamps[i]), reading[i], int(stamps[i]))
            count += len(stamps) + len(seen)
        writer.finish()
    return count


def main() -> int:
    given = harness.options(__doc__, seeds=0, minutes=60.0, compression=("zstd", "none"))
    packed = CompressionType[given.compression.upper()]
    with harness.scratch() as folder:
        bag, part = folder / "hour.mcap", folder / "part.mcap"
        harness.say(f"{write(bag, given.minutes, packed)} messages, {bag.stat().st_size / 1e6:.0f} MB")
        some = write(part, min(given.minutes, 5.0), packed)
        began = time.process_time()
        for _ in range(5):
            read_recording(part)
        ours = 5 * some / (time.process_time() - began)
        before, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        modcal = Path(sys.executable).with_name("modcal")
        done = subprocess.run([modcal, "calibrate", bag, "--out", folder / "out"], check=False)
        after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - wall
        spent, memory = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, after.ru_maxrss / 1e3
    harness.say(
        f"read into arrays: {ours / 1e6:.2f} million messages a second of the processor",
        f"bag to report: {spent:.1f} s of the processor, {wall:.1f} s by the clock, {memory:.0f} MB at most",
    )
    limit = MAX_SECONDS * given.minutes / 60.0 + 10.0 * (given.minutes < 30.0)
    return harness.met(
        ("the recording is calibrated", done.returncode == 0),
        (f"{limit:.0f} s of the processor", spent <= limit),
        (f"{MAX_MB:g} MB", memory <= MAX_MB),
    )


if __name__ == "__main__":
    sys.exit(main())
