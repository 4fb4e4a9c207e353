"""What a calibrator remembers comes apart where the clock was set back, whichever topic says so first."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

from modcal_msgs_py.readings import set_seconds
from modcal_nodes.calibrating.buffer import Buffer

JOINTS, POSE = ("/joint_states", "sensor_msgs/msg/JointState"), ("/tracker/pose", "geometry_msgs/msg/PoseStamped")


def joint_states(stamps: np.ndarray) -> list[tuple[tuple[str, str], JointState]]:
    out = []
    for stamp in stamps:
        message = JointState(name=["a"], position=[0.1])
        set_seconds(message.header.stamp, float(stamp))
        out.append((JOINTS, message))
    return out


def poses(stamps: np.ndarray, frame: str = "tracker") -> list[tuple[tuple[str, str], PoseStamped]]:
    out = []
    for stamp in stamps:
        message = PoseStamped()
        message.header.frame_id = frame
        set_seconds(message.header.stamp, float(stamp))
        out.append((POSE, message))
    return out


FIRST, SECOND = 5000.0 + np.arange(30.0), 1000.0 + np.arange(30.0)
ORDERS = {
    "one by one": [m for t in (FIRST, SECOND) for pair in zip(joint_states(t), poses(t), strict=True) for m in pair],
    "readings first": [*joint_states(FIRST), *poses(FIRST), *poses(SECOND), *joint_states(SECOND)],
    "joint states first": [*joint_states(FIRST), *joint_states(SECOND), *poses(FIRST), *poses(SECOND)],
    "late and early": [*joint_states(FIRST), *poses(FIRST[:20]), *joint_states(SECOND[:10]), *poses(FIRST[20:]),
                       *poses(SECOND), *joint_states(SECOND[10:])],
}  # fmt: skip


@pytest.mark.parametrize("order", ORDERS)
def test_readings_stay_with_the_joint_states_of_their_time(order: str) -> None:
    memory = Buffer(1e4)
    for k, ((topic, kind), message) in enumerate(ORDERS[order]):
        memory.add(topic, kind, message, 1e4 + k)
    pieces = memory.collected().recordings
    assert [list(piece.joints[0].stamps) for piece in pieces] == [list(FIRST), list(SECOND)]
    assert [list(piece.readings[0].stamps) for piece in pieces] == [list(FIRST), list(SECOND)]


def test_a_trackers_own_clock_makes_no_pieces() -> None:
    """Its readings stay where they are, for what came of it is found out when clocks are aligned."""
    memory = Buffer(1e4)
    t = 5000.0 + 0.1 * np.arange(1500)
    both = zip(joint_states(t), poses(np.r_[t[:500], t[500:] - 2000.0]), strict=True)
    for (topic, kind), message in chain.from_iterable(both):
        memory.add(topic, kind, message, 1e4)
    (piece,) = memory.collected().recordings
    assert len(piece.joints[0].stamps) == len(piece.readings[0].stamps) == 1500


def test_two_trackers_with_clocks_of_their_own_make_no_pieces() -> None:
    memory = Buffer(1e4)
    t = 5000.0 + np.arange(100.0)
    for messages in zip(joint_states(t), poses(t, "one"), poses(t - 500.0, "two"), strict=True):
        for (topic, kind), message in messages:
            memory.add(topic, kind, message, 1e4)
    (piece,) = memory.collected().recordings
    assert [len(reading.stamps) for reading in piece.readings] == [100, 100]


def test_pieces_end_when_they_are_long() -> None:
    memory = Buffer(20.0)
    for (topic, kind), message in joint_states(5000.0 + np.arange(50.0)):
        memory.add(topic, kind, message, 1e4)
    assert memory.pieces == 1  # the second may have readings to come
    assert [len(piece.joints[0].stamps) for piece in memory.collected().recordings] == [21, 21, 8]
    memory.condensed(1, None)
    assert [len(piece.joints[0].stamps) for piece in memory.collected().recordings] == [21, 8]


@pytest.mark.parametrize("offset", [0.0, -2000.0, 2000.0], ids=["one clock", "tracker behind", "tracker ahead"])
def test_readings_that_come_late_are_not_lost_where_a_long_piece_ends(offset: float) -> None:
    memory = Buffer(20.0)
    t = 5000.0 + 0.2 * np.arange(300)
    bursts = zip(np.split(t, 6), np.split(t + offset, 6), strict=True)
    for (topic, kind), message in chain.from_iterable((*joint_states(a), *poses(b)) for a, b in bursts):
        memory.add(topic, kind, message, 1e4)
    pieces = memory.collected().recordings
    assert sum(len(reading.stamps) for piece in pieces for reading in piece.readings) == 300
    if not offset:
        for piece in pieces:
            assert list(piece.readings[0].stamps) == list(piece.joints[0].stamps)
