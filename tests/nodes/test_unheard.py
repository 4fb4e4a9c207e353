"""A recorder that has subscribed and holds no message says so within a second, and does not wait for it idly."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nodes.in_process import spun
from nodes.talking import RELIABLE, numbered
from sensor_msgs.msg import JointState, Temperature

from modcal_nodes.nodes.recorder import Recorder

pytestmark = pytest.mark.dds


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
