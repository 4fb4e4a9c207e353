"""A recorder that hears nothing says so; one that is told to end does so once, and a bag is whole then."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nodes.in_process import spun
from nodes.processes import Process, fresh_domain, listener, running
from nodes.talking import RELIABLE, Talker, numbered, numbers_on_disk
from sensor_msgs.msg import JointState, Temperature

from modcal_nodes.nodes.recorder import Recorder

pytestmark = pytest.mark.dds

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
        heard: list[DiagnosticStatus] = []
        pair.partner.create_subscription(DiagnosticArray, "/diagnostics", lambda m: heard.extend(m.status), 50)
        joints = pair.partner.create_publisher(JointState, "joint_states", RELIABLE)
        pair.partner.create_publisher(Temperature, "temperature", 10)
        pair.wait(joints.get_subscription_count, 5.0)
        subscribed = time.monotonic()
        pair.wait(lambda: any("no message yet" in s.message for s in heard), 1.5)
        assert 0.6 < time.monotonic() - subscribed < 1.5
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
