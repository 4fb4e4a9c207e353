"""Quick ways to read: joint states from their bytes, rows of tracks that grow, bags in many small chunks."""

from __future__ import annotations

import array
import math
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from modcal_msgs_py.track_rows import JointStateBytes, JointStateView, TrackRows

NAMES = st.lists(st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=9), max_size=7)


def slow(cdr: bytes) -> Any:
    return deserialize_message(cdr, JointState)


def same(fast: Any, message: JointState) -> None:
    assert (fast.header.stamp.sec, fast.header.stamp.nanosec) == (
        message.header.stamp.sec,
        message.header.stamp.nanosec,
    )
    assert fast.header.frame_id == message.header.frame_id
    assert list(fast.name) == list(message.name)
    for part in ("position", "velocity", "effort"):
        np.testing.assert_array_equal(np.asarray(getattr(fast, part)), np.asarray(getattr(message, part)))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.text(max_size=5).filter(lambda t: "\0" not in t), NAMES, st.integers(0, 7)), max_size=5),
    st.randoms(use_true_random=False),
)
def test_of_any_publishers_in_turn(publishers: list[tuple[str, list[str], int]], random: Any) -> None:
    """Each with its own frame and joints, with velocities and efforts or without, and every number of its own."""
    read = JointStateBytes(slow)
    for _ in range(3):
        for frame, names, parts in publishers:
            message = JointState(name=names)
            message.header.frame_id = frame
            message.header.stamp.sec, message.header.stamp.nanosec = random.randrange(2**31), random.randrange(10**9)
            for bit, part in enumerate(("position", "velocity", "effort")):
                values = [random.choice([math.nan, random.uniform(-9.0, 9.0)]) for _ in names]
                setattr(message, part, array.array("d", values if parts >> bit & 1 else []))
            same(read(serialize_message(message)), message)


def test_of_the_same_length_with_other_joints_or_parts() -> None:
    """Lengths alike, what they say not: the joint's name, and which of velocities and efforts are sent."""
    read = JointStateBytes(slow)
    for names, parts in ((["ab", "cd"], "velocity"), (["ab", "ce"], "velocity"), (["ab", "ce"], "effort")):
        message = JointState(name=names, position=[1.0, 2.0], **{parts: [3.0, 4.0]})
        fast = read(serialize_message(message))
        assert isinstance(fast, JointStateView)
        same(fast, message)


def test_what_only_fills_up_may_be_anything() -> None:
    """DDS leaves bytes between texts and numbers as they were; they are not compared."""
    read = JointStateBytes(slow)
    message = JointState(name=["a", "bcd"], position=[1.0, 2.0])
    whole = serialize_message(message)
    first = whole.index(b"a\0")
    for filling in (b"\0\0", b"\xff\xfe"):
        cdr = whole[: first + 2] + filling + whole[first + 4 :]
        assert isinstance(read(cdr), JointStateView)
        same(read(cdr), message)
    assert len(read._layouts[len(whole)]) == 1


def test_what_it_cannot_read_is_left_to_another() -> None:
    """Bytes that end early, in the other order, or of a seventeenth publisher."""
    asked: list[bytes] = []
    read = JointStateBytes(asked.append)
    whole = serialize_message(JointState(name=["a", "b"], position=[1.0, 2.0]))
    read(whole)
    assert asked == []
    # eight bytes at the end say nothing: room that was taken for velocities and efforts
    spoiled = [whole[:k] for k in range(len(whole) - 8)] + [b"\0\0" + whole[2:], whole[:12] + b"\xff" * 4 + whole[16:]]
    for cdr in spoiled:
        read(cdr)
    assert asked == spoiled
    for k in range(20):
        read(serialize_message(JointState(name=[f"joint{k:02}"], position=[float(k)])))
    assert len(asked) == len(spoiled) + 5


def test_what_a_later_message_of_the_same_joints_replaces() -> None:
    """The newest of each set of joints is read, and whatever is not said to be replaced, in the order in which it came."""
    read = JointStateBytes(slow)

    def told(names: list[str], stamp: float) -> bytes:
        message = JointState(name=names, position=[stamp] * len(names))
        message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1.0 * 1e9)
        return bytes(serialize_message(message))

    arm, hand, broken = ["ab", "cd"], ["ab", "ce"], told(["ab"], 9.0)[:-12]
    came = [told(arm, 1.0), told(hand, 1.25), told(arm, 1.5), broken, told(hand, 1.75), broken, told(arm, 2.0)]
    assert read.needed(came, lambda _: True) == [broken, came[4], broken, came[6]]
    assert read.needed(came, lambda stamp: stamp > 1.25) == [*came[:2], broken, came[4], broken, came[6]]
    assert read.needed(came, lambda _: False) == came
    assert read.needed([], lambda _: True) == []


WIDTH = 3


@given(
    steps=st.lists(st.tuples(st.sampled_from(["extend", "look", "forget"]), st.integers(0, 70)), max_size=30),
    expected=st.sampled_from([0, 1, 40, 10**9]),
)
def test_rows_are_those_that_were_added(steps: list[tuple[str, int]], expected: int) -> None:
    """In their order, whatever number was expected; also what was looked at before more came."""
    rows, truth = TrackRows(WIDTH, expected), np.empty((0, 2 + WIDTH))
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    count = 0
    for what, n in steps:
        new = 10.0 * np.arange(count, count + n)[:, None] + np.arange(2 + WIDTH)
        if what == "extend":
            rows.extend(new[:, 0], new[:, 1], new[:, 2:3].astype(">f8"), new[:, 3:].astype(np.float32))
            truth, count = np.vstack([truth, new]), count + n
        elif what == "look":
            stamps, received, values = rows.columns()
            seen.append((np.column_stack([stamps, received, values]), truth))
            seen.append((values, truth[:, 2:]))  # the same memory as the rows'
        elif len(truth):
            border = truth[len(truth) // 2, 1]
            rows.forget_before(border)
            truth = truth[truth[:, 1] >= border]
        assert len(rows) == len(truth)
    stamps, received, values = rows.columns()
    assert values.shape == (len(truth), WIDTH)
    seen.append((np.column_stack([stamps, received, values]), truth))
    assert all(np.array_equal(there, then) for there, then in seen)


def test_a_number_that_was_wrongly_expected_takes_no_memory() -> None:
    rows = TrackRows(1, expected=10**15)
    rows.extend(np.zeros(100), np.zeros(100), np.zeros((100, 1)))
    values = rows.columns()[2]
    assert values.base is not None
    assert np.asarray(values.base).nbytes < 100_000
