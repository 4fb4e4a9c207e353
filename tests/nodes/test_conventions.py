"""What a ROS 2 developer expects of every node: parameters, log levels, QoS overrides, --help, refusals in one line."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest
import rclpy
from cli.recordings import URDF
from diagnostic_msgs.msg import DiagnosticStatus
from nodes.in_process import spun
from nodes.processes import EXECUTABLES, Process, environment, fresh_domain, running
from nodes.talking import LATCHED
from nodes.test_guarding import NODES as MADE
from nodes.test_guarding import PLANNED
from rcl_interfaces.msg import LoggerLevel
from rcl_interfaces.srv import GetLoggerLevels, SetLoggerLevels
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from robots.test_urdf import row
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from modcal_nodes.nodes.acceleration_limits import AccelerationLimits
from modcal_nodes.nodes.articulation_estimator import ArticulationEstimator
from modcal_nodes.nodes.calibrator import Calibrator
from modcal_nodes.nodes.corrector import Corrector
from modcal_nodes.nodes.impedance_setpoint import ImpedanceSetpoint
from modcal_nodes.nodes.viewer import Viewer
from modcal_nodes.ros.guarded import GuardedNode
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
def test_an_executable_that_cannot_read_its_parameters_ends_with_2(install: Path) -> None:
    done = run("corrector", "--ros-args", "--params-file", "no_such.yaml")
    assert done.returncode == 2, done.stderr
    assert "no_such.yaml" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.dds
def test_a_misspelt_parameter_is_said_with_the_one_that_is_meant(capfd: pytest.CaptureFixture[str]) -> None:
    """In the log and on /diagnostics; what is known is not."""
    given = {"max_forse_n": 33.0, "colour": "red", "max_moment_nm": 17.0, "use_sim_time": True, "timeout_s": 0.2}
    said = "parameters without effect: colour is not known; max_forse_n is not known, max_force_n is"
    with spun(ImpedanceSetpoint, **given) as pair:
        heard = pair.told()
        pair.wait(lambda: any(one.name.endswith(": parameters") for one in heard), 10.0)
        status = next(one for one in heard if one.name.endswith(": parameters"))
        assert status.level == DiagnosticStatus.WARN
        assert said in status.message
    assert said in " ".join(capfd.readouterr().err.split())


FILES = [("calibrator", "delta"), ("calibrator", "cell"), ("calibrator", "target"), ("corrector", "delta")]
FILES += [("board_detector", "target"), ("trajectory_sender", "trajectory")]


@pytest.mark.dds
@pytest.mark.parametrize(
    ("name", "parameters", "said"),
    [
        ("recorder", {"out": "taken"}, "taken: exists already"),
        ("recorder", {"out": "bag", "min_free_mb": 1e11}, "less than min_free_mb = 1e+11: make room"),
        ("simulated_cell", {"urdf": "no_such.urdf"}, "urdf 'no_such.urdf': is not a file"),
        ("simulated_cell", {"urdf": URDF, "joint_compliance_rad_per_nm": "[1e-5, 2e-5]"}, "1 or 6 numbers"),
        ("simulated_cell", {"urdf": URDF, "publish_clock": True, "use_sim_time": True}, "the cell would wait for itself"),
        ("simulated_cell", {"joint_rate_hz": 1e9}, "joint_rate_hz"),
        ("corrector", {"calibration": "nowhere"}, "nowhere: does not exist"),
        *((name, {file: "nowhere.yaml"}, "nowhere.yaml") for name, file in FILES),
        ("corrector", {"target": "elbow"}, "target 'elbow'"),
        ("acceleration_limits", {"payload_inertia": "[1.0, 1.0, 3.0, 0.0, 0.0, 0.0]"}, "(1, 1, 3, 0, 0, 0) is not physical"),
        ("articulation_estimator", {"input": "thoughts"}, "parameter input 'thoughts'"),
        ("board_detector", {}, "parameter target: names no file"),
        ("viewer", {"arrow_scale": -1.0}, "arrow_scale"),
        ("impedance_setpoint", {"rate_hz": 1e6}, "rate_hz"),
    ],
)  # fmt: skip
def test_wrong_parameters_end_a_node_with_one_line(
    name: str, parameters: dict[str, Any], said: str, tmp_path: Path
) -> None:
    (tmp_path / "taken").mkdir()
    process = Process(name, fresh_domain(), tmp_path, **parameters)
    with running(process):
        assert process.popen.wait(60.0) == 2
    (line,) = [line for line in process.output.splitlines() if line.startswith("modcal: ")]
    assert said in line
    assert "Traceback" not in process.output
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["taken"]
    assert not list((tmp_path / "taken").iterdir())


@pytest.mark.dds
def test_a_whole_number_is_taken_for_one_with_a_point() -> None:
    with spun(Viewer, rate_hz=5) as pair:
        assert pair.node.get_parameter("rate_hz").value == 5.0


READERS = [AccelerationLimits, ArticulationEstimator, Calibrator, ImpedanceSetpoint, Viewer]
LARGE = row(3) + " " * 6_000_000


@pytest.mark.dds
@pytest.mark.parametrize("make", READERS)
def test_a_node_refuses_it_and_goes_on(make: type[GuardedNode]) -> None:
    """No fault, no delay: one sentence on /diagnostics; then a sound description is still taken up by the topic."""
    with spun(make, **({"autostart": True} if make is ImpedanceSetpoint else {})) as pair:
        heard = pair.told()
        description = pair.partner.create_publisher(String, "robot_description", LATCHED)
        joints = pair.partner.create_publisher(JointState, "joint_states", 10)
        pair.wait(lambda: description.get_subscription_count() and joints.get_subscription_count(), 5.0)
        for text, said in ((row(3000), "has 3001 links, 2000"), (row(600), "600 joints in a row"), (LARGE, "million")):
            description.publish(String(data=text))
            state = JointState(name=["j1", f"another {said}"], position=[0.0, 0.0])  # once anew: it is looked at again

            def told(said: str = said, state: JointState = state) -> bool:
                joints.publish(state)
                return any(said in s.message for s in heard)

            pair.wait(told, 5.0)
        assert not pair.node.faults.counts
