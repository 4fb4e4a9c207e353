"""The recorder on a real cell: killed, without room, among publishers of all kinds, told to end, unheard."""

from __future__ import annotations

import resource
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Goals
from nodes.cell import call
from nodes.in_process import spun
from nodes.processes import Process, beside, fresh_domain, listener, put, running
from nodes.talking import (
    BEST_EFFORT,
    LATCHED,
    RELIABLE,
    Diagnostics,
    Talker,
    numbered,
    numbers_on_disk,
    strings_on_disk,
)
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String

from modcal_msgs_py.layout import jazzy
from modcal_msgs_py.mcap_repair import repair_bag
from modcal_msgs_py.mcap_walk import McapFile
from modcal_nodes.cli.main import run
from modcal_nodes.nodes.recorder import Recorder
from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.topic_recorder import Taken, TopicRecorder

pytestmark = pytest.mark.dds
BAG, TOPICS = "/recorder: bag", "/recorder: topics"


def contiguous(numbers: list[int]) -> bool:
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def refusals(process: Process) -> list[str]:
    return [line for line in process.output.splitlines() if line.startswith("modcal: ")]


@pytest.mark.slow
def test_killed_at_any_moment_it_loses_at_most_the_last_second(
    tmp_path: Path, rng: np.random.Generator, capfd: pytest.CaptureFixture[str]
) -> None:
    domain = fresh_domain()
    with listener(domain) as (node, wait), Talker(node) as talker:
        bags = [tmp_path / f"bag_{k}" for k in range(2)]
        recorders = [Process("recorder", domain, tmp_path, "-r", f"__node:={bag.name}", out=bag) for bag in bags]
        with running(*recorders):
            for bag in bags:
                wait(lambda bag=bag: len(numbers_on_disk(bag)) > 0, 60.0)
            begun = time.monotonic()
            known = talker.before(begun)
            for bag, recorder in zip(bags, recorders, strict=True):
                end = max(begun + 1.2, time.monotonic()) + rng.uniform(0.0, 0.6)
                wait(lambda end=end: time.monotonic() > end, 10.0)
                killed = time.monotonic()
                assert recorder.stop(signal.SIGKILL) == -signal.SIGKILL
                numbers = numbers_on_disk(bag)
                assert contiguous(numbers)
                assert numbers[0] < known
                assert numbers[-1] + 1 >= talker.before(killed - 1.0) > known
                # read as it is, and as a whole bag once repaired
                assert run(["info", str(bag)]) == 0
                assert "no metadata.yaml" in capfd.readouterr().out
                repair_bag(bag, tmp_path / f"{bag.name}_new")
                with Reader(tmp_path / f"{bag.name}_new") as reader:
                    assert reader.message_count == len(numbers)
                assert numbers_on_disk(tmp_path / f"{bag.name}_new") == numbers


def test_a_full_disk_ends_it_and_what_is_written_can_be_read(tmp_path: Path) -> None:
    """No file may grow beyond a limit, which the system answers as it answers a full disk: with an error of write."""
    domain = fresh_domain()
    recorder = Process("recorder", domain, tmp_path, out=tmp_path / "bag", topics="[joint_states]")
    with running(recorder), listener(domain) as (node, wait), Talker(node):
        diagnostics = Diagnostics(node)
        wait(lambda: len(numbers_on_disk(tmp_path / "bag")) > 0 and BAG in diagnostics.last, 60.0)
        file = tmp_path / "bag" / "bag_0.mcap"
        limit = file.stat().st_size + 50_000
        resource.prlimit(recorder.popen.pid, resource.RLIMIT_FSIZE, (limit, limit))
        wait(lambda: recorder.popen.poll() is not None, 60.0)
        wait(lambda: diagnostics.worst[BAG] == DiagnosticStatus.ERROR, 10.0)
        assert recorder.popen.returncode == 2
        assert diagnostics.said(BAG, "cannot be written (File too large)")
    (line,) = refusals(recorder)
    assert f"{file}: cannot be written (File too large): make room" in line
    assert "[FATAL]" in recorder.output
    assert "Traceback" not in recorder.output
    assert file.stat().st_size == limit
    assert not (tmp_path / "bag" / "metadata.yaml").exists()
    numbers = numbers_on_disk(tmp_path / "bag")
    assert contiguous(numbers)
    # to the last whole message: the next one is not whole in the file
    data, size = file.read_bytes(), len(serialize_message(numbered(0)))
    assert _begins_with(numbers[-1]) in data
    assert _begins_with(numbers[-1] + 1) not in data[:-size]
    repair_bag(tmp_path / "bag", tmp_path / "new")
    assert numbers_on_disk(tmp_path / "new") == numbers


def _begins_with(number: int) -> bytes:
    """Head and stamp of that joint state, in CDR."""
    return serialize_message(numbered(number))[:12]


def test_when_room_gets_short_the_bag_is_closed_in_time(tmp_path: Path) -> None:
    domain = fresh_domain()
    recorder = Process("recorder", domain, tmp_path, out=tmp_path / "bag")
    with running(recorder), listener(domain) as (node, wait), Talker(node):
        diagnostics = Diagnostics(node)
        wait(lambda: BAG in diagnostics.last and len(numbers_on_disk(tmp_path / "bag")) > 100, 60.0)
        assert not put(node, wait, "recorder", min_free_mb=1e11)
        wait(lambda: recorder.popen.poll() is not None, 60.0)
        wait(lambda: diagnostics.worst[BAG] == DiagnosticStatus.ERROR, 10.0)
        assert recorder.popen.returncode == 2
    assert len(refusals(recorder)) == 1
    assert "MB free, less than min_free_mb = 1e+11" in refusals(recorder)[0]
    assert repair_bag(tmp_path / "bag", tmp_path / "new").folder is None
    assert contiguous(numbers_on_disk(tmp_path / "bag"))


def test_publishers_of_every_qos_are_heard_and_kept_once(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with beside(tmp_path, "recorder", out=bag) as (recorder, node, wait):
        reliable = node.create_publisher(JointState, "joint_states", RELIABLE)
        first = node.create_publisher(String, "robot_description", RELIABLE)
        wait(lambda: reliable.get_subscription_count() == 1 and first.get_subscription_count() == 1, 60.0)
        first.publish(String(data="not latched"))
        for k in range(100):
            reliable.publish(numbered(k))
        # others, later, of which a reliable subscription would hear one not at all, and the other not from its beginning
        late = node.create_publisher(String, "robot_description", LATCHED)
        late.publish(String(data="latched"))
        careless = node.create_publisher(JointState, "joint_states", BEST_EFFORT)
        wait(lambda: reliable.get_subscription_count() == 2 and careless.get_subscription_count() == 1, 30.0)
        for k in range(100, 400):
            (careless if k % 3 == 0 else reliable).publish(numbered(k))
            time.sleep(0.003)
        wait(lambda: set(strings_on_disk(bag, "/robot_description")) == {"latched", "not latched"}, 30.0)
        wait(lambda: {k for k in range(400) if k < 100 or k % 3} <= set(numbers_on_disk(bag)), 30.0)
        assert recorder.stop() == 0
    numbers = numbers_on_disk(bag)
    assert len(numbers) == len(set(numbers))
    # best effort promises nothing, but on a machine by itself little is lost
    assert sum(k % 3 == 0 for k in numbers if k >= 100) > 50
    assert sorted(strings_on_disk(bag, "/robot_description")) == ["latched", "not latched"]
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    offered = {
        t["topic_metadata"]["name"]: [
            (q["reliability"], q["durability"]) for q in t["topic_metadata"]["offered_qos_profiles"]
        ]
        for t in information["topics_with_message_count"]
    }
    assert offered["/joint_states"] == [("reliable", "volatile"), ("best_effort", "volatile")]
    assert offered["/robot_description"] == [("reliable", "volatile"), ("reliable", "transient_local")]


def test_what_is_missing_or_cannot_be_recorded_is_said(tmp_path: Path) -> None:
    domain = fresh_domain()
    topics = "[joint_states, never, silent, goals, tracker/pose]"
    recorder = Process("recorder", domain, tmp_path, out=tmp_path / "bag", topics=topics, patience_s=1.0)
    # within one participant a topic has one type
    with running(recorder), listener(domain) as (node, wait), listener(domain) as (other, _):
        diagnostics = Diagnostics(node)
        node.create_publisher(String, "silent", RELIABLE)
        node.create_publisher(Goals, "goals", RELIABLE)
        right = node.create_publisher(JointState, "joint_states", RELIABLE)
        # of two types, the one that comes first is recorded
        wait(lambda: right.get_subscription_count() == 1, 60.0)
        other.create_publisher(String, "joint_states", RELIABLE)
        expected = [
            "/never: no node publishes it: start the driver, or remap the topic",
            "/silent: silent for ",
            "/joint_states: only sensor_msgs/msg/JointState is recorded, not std_msgs/msg/String",
            "no message from a tracker (/tracker/pose)",
        ]
        wait(lambda: all(diagnostics.said(TOPICS, words) for words in expected), 60.0)
        assert diagnostics.last[TOPICS].level == DiagnosticStatus.ERROR
        wait(lambda: all(words in recorder.output for words in expected), 30.0)
        assert "recording /goals (nav_msgs/msg/Goals)" in recorder.output  # which is known by its class alone
        # said, and the rest is recorded all the same
        right.publish(numbered(7))
        wait(lambda: numbers_on_disk(tmp_path / "bag") == [7], 30.0)
        wait(lambda: diagnostics.value(TOPICS, "messages of /joint_states") == "1", 30.0)
        assert recorder.output.count("/never: no node publishes it") == 1
        assert recorder.stop() == 0


def test_simulated_time_that_begins_late_and_jumps_back(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with beside(tmp_path, "recorder", out=bag, use_sim_time="true", topics="[joint_states]") as (recorder, node, wait):
        diagnostics = Diagnostics(node)
        clock = node.create_publisher(Clock, "/clock", RELIABLE)
        joints = node.create_publisher(JointState, "joint_states", RELIABLE)
        wait(lambda: joints.get_subscription_count() == 1 and clock.get_subscription_count() == 1, 60.0)
        joints.publish(numbered(0))
        # written although time has not begun
        wait(lambda: numbers_on_disk(bag) == [0], 30.0)
        wait(lambda: diagnostics.said(BAG, "no node publishes /clock"), 30.0)
        number = 0
        for second in (100, 101, 50):
            now = Clock()
            now.clock.sec = second
            # clock and joints come by different ways, and the clock by best effort: until one has the new time
            while not any(stamp == second * 10**9 for _, stamp in _stamps(bag)):
                clock.publish(now)
                number += 1
                assert number < 1000
                joints.publish(numbered(number))
                wait(lambda: [n for n, _ in _stamps(bag)][-1] == number, 30.0)  # noqa: B023
        assert recorder.stop() == 0
    numbers, stamps = zip(*_stamps(bag), strict=True)
    assert numbers == tuple(range(number + 1))
    # as they come, although time jumps back
    assert [round(1e-9 * t) for k, t in enumerate(stamps) if k == 0 or t != stamps[k - 1]] == [0, 100, 101, 50]
    assert repair_bag(bag, tmp_path / "new").folder is None


def _stamps(bag: Path) -> list[tuple[int, int]]:
    numbers = numbers_on_disk(bag)
    received = [raw.received_ns for path in bag.glob("*.mcap") for raw in McapFile(path).messages()]
    return list(zip(numbers, received[: len(numbers)], strict=True))  # more may have been written since


def test_save_says_what_is_safe_and_reset_begins_another_bag(tmp_path: Path) -> None:
    domain = fresh_domain()
    recorder = Process("recorder", domain, tmp_path, out=tmp_path / "bag")
    with running(recorder), listener(domain) as (node, wait), Talker(node) as talker:
        description = node.create_publisher(String, "robot_description", LATCHED)
        description.publish(String(data="the arm"))
        diagnostics = Diagnostics(node)
        wait(
            lambda: (
                len(numbers_on_disk(tmp_path / "bag")) > 0 and strings_on_disk(tmp_path / "bag", "/robot_description")
            ),
            60.0,
        )

        answer = call(node, wait, "recorder/save")
        on_disk = len(numbers_on_disk(tmp_path / "bag")) + 1
        assert answer.success
        assert answer.message.endswith(f"messages are on the disk in {tmp_path / 'bag' / 'bag_0.mcap'}")
        assert 1 < int(answer.message.split()[0]) <= on_disk

        answer = call(node, wait, "recorder/reset")
        assert answer.success, answer.message
        assert f"recording into {tmp_path / 'bag_2'}" in answer.message
        assert repair_bag(tmp_path / "bag", tmp_path / "new").folder is None
        wait(lambda: len(numbers_on_disk(tmp_path / "bag_2")) > 100, 30.0)
        count = talker.stop()
        wait(lambda: numbers_on_disk(tmp_path / "bag_2")[-1] == count - 1, 30.0)
        # it came in the middle, which is not a loss
        wait(lambda: diagnostics.value(TOPICS, "lost of /joint_states") == "0", 30.0)
        assert not diagnostics.said(TOPICS, "messages lost")
        assert recorder.stop() == 0
    # nothing is lost between the two, and the second is whole without the first
    first, second = numbers_on_disk(tmp_path / "bag"), numbers_on_disk(tmp_path / "bag_2")
    assert contiguous(first + second)
    assert strings_on_disk(tmp_path / "bag", "/robot_description") == ["the arm"]
    assert strings_on_disk(tmp_path / "bag_2", "/robot_description") == ["the arm"]
    with Reader(tmp_path / "bag") as before, Reader(tmp_path / "bag_2") as after:
        assert after.start_time >= before.end_time - 1  # which is 1 ns behind the last message
    assert repair_bag(tmp_path / "bag_2", tmp_path / "new").folder is None


def test_what_overflows_is_counted_as_lost(tmp_path: Path) -> None:
    """A subscription that nobody serves keeps the last 5000 messages; the publisher's numbers show the others."""
    domain = fresh_domain()
    with listener(domain) as (speaker, _), listener(domain, GuardedNode) as (node, wait):
        taken: list[Taken] = []
        tape = TopicRecorder(node, "/joint_states", taken.append, True, 60.0)
        publisher = speaker.create_publisher(JointState, "joint_states", RELIABLE)
        wait(tape.look, 30.0)
        wait(lambda: publisher.get_subscription_count() == 1, 30.0)
        publisher.publish(numbered(0))
        wait(lambda: len(taken) == 1, 30.0)
        assert tape.lost == 0
        assert tape.complaint() is None
        for k in range(1, 6000):
            publisher.publish(numbered(k))
        assert publisher.wait_for_all_acked()
        publisher.publish(numbered(6000))

        def last() -> int:
            stamp = jazzy().deserialize_cdr(taken[-1].cdr, "sensor_msgs/msg/JointState").header.stamp
            return (stamp.sec - 1) * 1000 + stamp.nanosec

        wait(lambda: last() == 6000, 60.0)
        assert 5000 <= tape.count == len(taken) < 6001
        assert not tape.look()  # it is still the only publisher, so what is missing was its own
        assert tape.lost == 6001 - tape.count
        complaint = tape.complaint()
        assert f"{tape.lost} messages lost" in complaint.text

        # another one counts from another number, and nothing is lost by that
        lost = tape.lost
        another = speaker.create_publisher(JointState, "joint_states", RELIABLE)
        wait(lambda: another.get_subscription_count() == 1, 30.0)
        for source, number in ((another, 7000), (publisher, 7001)):
            source.publish(numbered(number))
            wait(lambda number=number: last() == number, 30.0)
        tape.look()
        assert tape.lost == lost


# s from the first SIGINT to the second: as ros2 launch sends them to a group, and as an impatient hand does
PAUSES = (0.0, 0.02, 0.1)


def test_a_second_interrupt_does_not_cut_the_closing_short(tmp_path: Path) -> None:
    """Three recorders; each leaves a whole bag and exit code 0."""
    domain = fresh_domain()
    folders = [tmp_path / f"bag{k}" for k in range(len(PAUSES))]
    made = [Process("recorder", domain, tmp_path, out=folder) for folder in folders]
    with running(*made), listener(domain) as (node, wait), Talker(node, rate=400.0):
        wait(lambda: all("recording /joint_states" in one.output for one in made), 60.0)
        mark = time.monotonic() + 0.2
        wait(lambda: time.monotonic() > mark, 5.0)
        for process, pause in zip(made, PAUSES, strict=True):
            process.popen.send_signal(signal.SIGINT)
            time.sleep(pause)
            process.popen.send_signal(signal.SIGINT)
        assert [process.stop(signal.SIGINT) for process in made] == [0] * len(made)
    for process, folder in zip(made, folders, strict=True):
        about = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        numbers = numbers_on_disk(folder)
        assert about["message_count"] >= len(numbers) > 0
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert "Traceback" not in process.output
        assert f"closed {folder} with" in process.output


def test_it_says_at_once_that_nothing_comes_and_when_it_does(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A publisher is there and nothing of it arrives, as after a kill; a slow topic is not complained of."""
    with spun(Recorder, out=tmp_path / "bag") as pair:
        heard = pair.told()
        joints = pair.partner.create_publisher(JointState, "joint_states", RELIABLE)
        pair.partner.create_publisher(Temperature, "temperature", 10)
        pair.wait(joints.get_subscription_count, 5.0)
        subscribed = time.monotonic()
        pair.wait(lambda: any("no message yet" in s.message for s in heard), 10.0)
        assert time.monotonic() - subscribed > 0.6
        said = [s for s in heard if "no message yet" in s.message][-1]
        assert (said.name, said.level) == ("/recorder: topics", DiagnosticStatus.WARN)
        assert "/joint_states: subscribed for" in said.message
        assert "temperature" not in said.message
        recorder = next(recorder for recorder in pair.node._recorders if recorder.topic == "/joint_states")  # type: ignore[attr-defined]
        pair.wait(lambda: recorder._again >= 2, 5.0)
        pair.wait(joints.get_subscription_count, 5.0)
        for number in range(20):
            joints.publish(numbered(number))
        pair.wait(lambda: recorder.count == 20, 5.0)  # each once, however often it has subscribed
        for number in range(20, 40):  # of the subscriptions, one is kept that goes on hearing
            joints.publish(numbered(number))
            pair.wait(lambda sent=number: recorder.count == sent + 1, 5.0)
            time.sleep(0.1)
        assert not recorder._spares
        joints.publish(numbered(40))
        pair.wait(lambda: recorder.count == 41, 5.0)
        pair.wait(lambda: "/joint_states" not in pair.node._unheard, 5.0)  # type: ignore[attr-defined]
    log = capfd.readouterr().err
    assert "/joint_states: subscribed for 0." in log
    assert "/joint_states: the first message came" in log
