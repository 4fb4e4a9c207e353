"""What a ROS 2 developer expects of every node: parameters that mean what they say, log levels, QoS overrides, --help."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
import rclpy
from nodes.in_process import spun
from nodes.processes import EXECUTABLES, environment, fresh_domain
from nodes.test_guarding import NODES as MADE
from nodes.test_guarding import PLANNED
from rcl_interfaces.msg import LoggerLevel
from rcl_interfaces.srv import GetLoggerLevels, SetLoggerLevels
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from modcal_nodes.nodes.calibrator import Calibrator
from modcal_nodes.nodes.corrector import Corrector
from modcal_nodes.nodes.recorder import Recorder
from modcal_nodes.nodes.viewer import Viewer
from modcal_nodes.ros.parameters import NODES
from modcal_nodes.ros.running import SENSOR, answered
from modcal_nodes.simulation.plant import SWITCHES

EVERY = sorted(MADE)


def other(value: Any) -> Any:
    """Another value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"{value}x"
    if isinstance(value, list):
        return [other(value[0]), *value[1:]] if value else value
    return value + type(value)(1) if value == 0 else value * 1.01 if isinstance(value, float) else value + 1


@pytest.mark.dds
@pytest.mark.parametrize("name", MADE)
def test_what_is_read_once_is_read_only_and_the_rest_is_taken(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every parameter of every node is set: it is refused, with a reason, or it is what the node goes by from then on."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "planned.yaml").write_text(PLANNED)
    make, parameters = MADE[name]
    with spun(make, **{k: v for k, v in parameters.items() if k != "autostart"}) as pair:
        node: Any = pair.node
        chosen = getattr(node, "_chosen", {})
        for key, declared in NODES[name].items():
            before = node.get_parameter(key).value
            wanted = other(before)
            (result,) = node.set_parameters([Parameter(key, value=wanted)])
            if not declared.live:
                assert not result.successful, key
                assert "read-only" in result.reason, key
            elif result.successful and name != "simulated_cell":  # whose switches have tests of their own
                assert chosen[key] == node.get_parameter(key).value == wanted, key
            else:
                assert result.reason or result.successful, key
    if name == "simulated_cell":
        assert {key for key, declared in NODES[name].items() if declared.live} == set(SWITCHES)


@pytest.mark.dds
def test_parameters_that_may_change_take_effect(tmp_path: Path) -> None:
    def put(node: Node, **values: Any) -> None:
        for result in node.set_parameters([Parameter(name, value=value) for name, value in values.items()]):
            assert result.successful, result.reason

    with spun(Calibrator, after_change=7) as pair:
        node: Any = pair.node
        put(node, silence_timeout_s=0.25, after_change=3, first_solve=12, accept="asked")
        assert {subscription.patience for subscription in node._inputs} == {0.25}
        assert (node._supervisor.policy.after_change, node._supervisor.policy.accept) == (3, "asked")
        assert node._supervisor._wait == 12
        pair.wait(lambda: any(subscription.complaint() for subscription in node._inputs if subscription.needed), 2.0)
        (refused,) = node.set_parameters([Parameter("accept", value="perhaps")])
        assert "better and asked are known" in refused.reason
        assert node._chosen["accept"] == "asked"
    with spun(Recorder, out=tmp_path / "bag") as pair:
        put(pair.node, patience_s=0.3, min_free_mb=1.0)
        assert {recorder.patience for recorder in pair.node._recorders} == {0.3}  # type: ignore[attr-defined]
    with spun(Corrector) as pair:
        put(pair.node, target="tool", horizon_s=0.2)
        assert pair.node._commander.settings.target == "tool"  # type: ignore[attr-defined]
        assert pair.node._commander.settings.horizon == 0.2  # type: ignore[attr-defined]
    with spun(Viewer) as pair:
        pair.node._dirty = False  # type: ignore[attr-defined]
        put(pair.node, arrow_scale=7.0)
        assert pair.node._dirty  # type: ignore[attr-defined]


@pytest.mark.dds
def test_log_levels_are_asked_and_set_by_service() -> None:
    with spun(Corrector) as pair:
        wanted = SetLoggerLevels.Request(levels=[LoggerLevel(name="corrector", level=10)])
        assert pair.call(SetLoggerLevels, "/corrector/set_logger_levels", wanted).results[0].successful
        asked = GetLoggerLevels.Request(names=["corrector"])
        assert pair.call(GetLoggerLevels, "/corrector/get_logger_levels", asked).levels[0].level == 10
        rclpy.logging.set_logger_level("corrector", rclpy.logging.LoggingSeverity.INFO)


@pytest.mark.dds
def test_qos_is_overridden_by_parameters() -> None:
    """For one topic, in one direction; what others ask for stays as it was."""
    overrides = {
        "qos_overrides./joint_states.subscription.reliability": "best_effort",
        "qos_overrides./joint_states.subscription.depth": 3,
        "qos_overrides./calibrator/trusted.publisher.durability": "volatile",
    }
    with spun(Calibrator, **overrides) as pair:
        by_topic = {s.topic_name: s.qos_profile for s in pair.node.subscriptions}
        assert by_topic["/joint_states"].reliability == ReliabilityPolicy.BEST_EFFORT
        assert by_topic["/tracker/pose"].reliability == ReliabilityPolicy.RELIABLE
        assert (SENSOR.reliability, SENSOR.depth) == (ReliabilityPolicy.RELIABLE, 1000)
        (info,) = pair.partner.get_publishers_info_by_topic("/calibrator/trusted") or [None]
        if info is not None:
            assert info.qos_profile.durability == DurabilityPolicy.VOLATILE
        assert pair.node.get_parameter("qos_overrides./joint_states.subscription.depth").value == 3


@pytest.mark.parametrize("name", EVERY)
def test_help_is_printed_in_place_of_starting(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    def make() -> Node:
        """What it is."""
        raise AssertionError("started")

    for words in (["--help"], ["-h"], ["--ros-args", "-p", "seed:=1", "--", "--help"]):
        assert answered(make, [f"/somewhere/{name}", *words]) == 0
        out = capsys.readouterr().out
        assert f"usage: ros2 run modcal_nodes {name}" in out
        for parameter in NODES[name]:
            assert f"{parameter} (" in out
    assert answered(make, [name, "--hlep"]) == 2
    assert f"--hlep: is not an argument of {name}" in capsys.readouterr().err
    assert answered(make, [name, "--ros-args", "-r", "a:=b"]) is None


def run(name: str, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(EXECUTABLES / name), *words], env=environment(fresh_domain()), capture_output=True, text=True, timeout=60.0
    )


@pytest.mark.dds
@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--help",), 0, ""),
        (("--hlep",), 2, "is not an argument"),
        (("--ros-args", "-p", "horizon_s:=1e9"), 2, "horizon_s"),
        (("--ros-args", "-p"), 2, ""),
        (("--ros-args", "--params-file", "no_such.yaml"), 2, "no_such.yaml"),
    ],
)
def test_exit_codes_of_an_executable(words: tuple[str, ...], code: int, said: str, install: Path) -> None:
    done = run("corrector", *words)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert os.linesep in (done.stdout if code == 0 else done.stderr)
