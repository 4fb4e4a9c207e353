"""``modcal call`` and ``modcal play`` beside real nodes: what a shell without ``ros2`` does with a cell."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli.recordings import URDF
from msgs import bag_forms as forms
from nodes.beside_a_cell import SAMPLES, STATIONS, stations
from nodes.processes import EXECUTABLES, ROOT, SLOWER, Process, environment, fresh_domain, listener, running
from nodes.talking import BEST_EFFORT, Diagnostics
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from modcal_msgs_py.layout import jazzy, message_class
from modcal_msgs_py.readings import nanoseconds
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.dds
BAG = ROOT / "bags" / "ur10_cell"
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DURABLE, FLEETING = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
OF_THE_BAG = {"title", "trace"}  # of a report: a node does not know which bag it hears


def command(domain: int, *words: str) -> dict[str, Any]:
    return {"args": [str(EXECUTABLES / "modcal"), *words], "env": environment(domain), "text": True}


def started(domain: int, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(**command(domain, *words), stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def ran(domain: int, *words: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr."""
    done = subprocess.run(**command(domain, *words), capture_output=True, timeout=SLOWER * 120.0)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.slow
def test_a_bag_that_is_played_gives_the_report_of_the_bag(tmp_path: Path) -> None:
    """Renamed topics and simulated time on the way, and every kind of answer behind it."""
    domain, bag = fresh_domain(), tmp_path / "bag"
    write_recording(replace(stations(STATIONS), robot_description=URDF.read_text()), bag)
    live = {"effects": False, "out": tmp_path / "live", "use_sim_time": True}
    calibrator = Process("calibrator", domain, tmp_path, "-r", "tracker/pose:=left/pose", **live)
    with running(calibrator), listener(domain) as (node, wait):
        said = Diagnostics(node)
        wait(lambda: SAMPLES in said.last, 60.0)
        code, out, told = ran(
            domain, "play", str(bag), "--rate=20", "--clock=50", "--remap=/tracker/pose:=left/pose", "--json"
        )
        assert (code, told) == (0, "")
        sent = json.loads(out)["messages"]
        assert (sent["/joint_states"], sent["/tracker/pose"]) == (STATIONS, STATIONS)
        wait(lambda: (said.counted("/joint_states"), said.counted("/left/pose")) == (STATIONS, STATIONS), 30.0)

        code, out, told = ran(domain, "call", "calibrator", "solve", "--json")
        answer = json.loads(out)
        assert (code, answer["done"], answer["outcome"]) == (0, True, "SOLVED")
        assert told.startswith("phase ")
        assert run(["calibrate", str(bag), "--geometry-only", "--out", str(tmp_path / "out")]) == 0
        reports: list[Any] = [json.loads((tmp_path / of / "report.json").read_text()) for of in ("live", "out")]
        first, second = ({k: v for k, v in report.items() if k not in OF_THE_BAG} for report in reports)
        assert first == second
        assert answer["result"]["verdict"]["sentence"] == second["verdict"]

        assert ran(domain, "call", "calibrator", "reset")[:2] == (
            0,
            "recording and candidate cleared; the trusted model stays\n",
        )
        code, out, _ = ran(domain, "call", "/calibrator/", "~/solve", "--goal={version: 1}")
        assert (code, out.startswith("FAILED: recording: no message was received")) == (3, True)
        code, out, _ = ran(domain, "call", "calibrator", "save")
        assert (code, out) == (3, "no folder: set the parameter state\n")
        for words, why in {
            ("calibrator", "solv"): "there are accept, change_state, check, ",
            ("calibratr", "solve", "--patience=4"): "there are /calibrator",
            ("calibrator", "solve", "--goal={versio: 1}"): "give some of {version: uint32}",
            ("calibrator", "solve", "--goal={version: -1}"): "-1 is no uint32",
        }.items():
            code, out, told = ran(domain, "call", *words)
            assert (code, out, why in told) == (2, "", True), told


def test_an_interrupted_call_cancels_its_goal(tmp_path: Path) -> None:
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path)
    with running(calibrator):
        assert ran(domain, "play", str(BAG), "--rate=40")[0] == 0
        call = started(domain, "call", "calibrator", "solve")
        assert call.stderr is not None
        assert "phase" in call.stderr.readline()
        call.send_signal(signal.SIGINT)
        out, told = call.communicate(timeout=SLOWER * 30.0)
        assert (call.returncode, out.partition(":")[0]) == (3, "CANCELLED"), told


FOREVER = QosTime(9223372036, 854775807)


def offer(reliable: bool, latched: bool) -> Qos:
    lasting = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    trusty = QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT
    return Qos(QosHistory.KEEP_LAST, 7, trusty, lasting, FOREVER, FOREVER, QosLiveliness.AUTOMATIC, FOREVER, False)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_what_is_played_is_what_was_recorded(storage: StoragePlugin, tmp_path: Path) -> None:
    """Bytes, pace and QoS, from some moment on, with what was latched before it; the clock runs ahead of nothing."""
    domain, second = fresh_domain(), 10**9
    stamps = [second + k * second // 10 for k in range(21)]
    words: list[forms.Message] = [
        ("/notes", forms.STRING, message_class(forms.STRING)(w), second + k) for k, w in enumerate("ab")
    ]
    sent = [forms.joint_state(ns, ["a"], [1e-9 * ns]) for ns in stamps]
    states = [("/joint_states", forms.JOINT_STATE, m, ns) for m, ns in zip(sent, stamps, strict=True)]
    offered = {"/notes": offer(True, True), "/joint_states": offer(False, False)}
    bag = forms.write(tmp_path / "bag", [*words, *states], storage=storage, offered=offered)
    with listener(domain) as (node, wait):
        heard, texts, clock = list[Any](), list[str](), list[int]()
        node.create_subscription(
            JointState, "arm/joints", lambda m: heard.append((time.monotonic(), m)), BEST_EFFORT, raw=True
        )
        node.create_subscription(Clock, "clock", lambda m: clock.append(nanoseconds(m.clock)), 100)
        play = started(
            domain, "play", str(bag), "--start=1", "--rate=2", "--clock=10", "--remap=joint_states:=arm/joints"
        )
        wait(lambda: heard, 60.0)
        node.create_subscription(String, "notes", lambda m: texts.append(m.data), LATCHED)
        (notes,) = node.get_publishers_info_by_topic("/notes")
        (joints,) = node.get_publishers_info_by_topic("/arm/joints")
        wait(lambda: (len(heard), len(texts), len(clock)) == (11, 2, 6), 30.0)
        assert not play.communicate(timeout=SLOWER * 20.0)[1]
        assert play.returncode == 0
    assert [info.qos_profile.durability for info in (notes, joints)] == [DURABLE, FLEETING]
    assert joints.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert [cdr for _, cdr in heard] == [bytes(jazzy().serialize_cdr(m, forms.JOINT_STATE)) for m in sent[10:]]
    assert texts == ["a", "b"]
    assert heard[-1][0] - heard[0][0] > 0.4
    assert clock == [2 * second + k * second // 5 for k in range(6)]
