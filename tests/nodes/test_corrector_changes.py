"""The corrector while its calibration, description, clock or parameters change."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from correction.test_compensation import started
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nodes.corrected_arm import AWAY, GEAR, LATCHED, URDF, Arm, calibration, matrix, text, truth, written
from nodes.processes import Process, fresh_domain, listener, running
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger

from modcal_core.correction.correction import ArmState, Correction
from modcal_core.geometry.so3 import Array
from modcal_msgs_py.readings import seconds, set_seconds

pytestmark = pytest.mark.dds
ERROR, WARN, OK = DiagnosticStatus.ERROR, DiagnosticStatus.WARN, DiagnosticStatus.OK


def test_a_calibration_of_another_robot_corrects_nothing(tmp_path: Path) -> None:
    """Joints of other names, or the same names on another arm; the right description then is taken."""
    made = calibration()
    domain = fresh_domain()
    process = Process("corrector", domain, tmp_path, calibration=written(made, tmp_path))
    with running(process), listener(domain) as (node, wait):
        arm = Arm(node, urdf="")
        wait(lambda: arm.heard() and "calibration" in arm.health, 60.0)
        assert arm.health["calibration"].level == ERROR
        assert "robot_description: not received yet" in arm.health["calibration"].message
        for other, said in (
            (URDF.replace("elbow_joint", "knee_joint"), "this robot has"),
            (URDF.replace('"-0.612', '"-0.613').replace('"0.612', '"0.613'), "other nominal kinematics"),
            ("<robot", "robot description"),
        ):
            assert other != URDF
            arm.description.publish(String(data=other))
            wait(lambda said=said: said in arm.health["calibration"].message, 20.0)
            assert arm.health["calibration"].level == ERROR
            arm.refuse(wait, lambda: arm.wish(truth(made, AWAY)), "no command is corrected")
        assert not arm.poses
        assert not arm.urdfs
        arm.description.publish(String(data=URDF))
        wait(lambda: arm.poses and arm.urdfs, 20.0)
        wait(lambda: arm.health["calibration"].level != ERROR, 20.0)
        # and lost again
        arm.description.publish(String(data=URDF.replace("elbow_joint", "knee_joint")))
        wait(lambda: arm.health["calibration"].level == ERROR, 20.0)
        late: list[str] = []
        node.create_subscription(String, "corrector/robot_description", lambda m: late.append(m.data), LATCHED)
        arm.refuse(wait, lambda: arm.wish(truth(made, AWAY)), "no command is corrected")
        assert not late, "a late listener must not find the URDF of a calibration that is not in use"


def test_a_stream_its_limits_and_a_new_calibration_in_the_middle(tmp_path: Path) -> None:
    """A calibration that differs by little comes in without a jump, one that differs by much when the stream pauses."""
    first = calibration()
    slightly = calibration(0, GEAR.started(np.array([-1e-4, 3e-4])))
    much = calibration(0, started("ratio").with_values(np.array([8e-3])))
    domain = fresh_domain()
    # time enough for a machine that does other things as well
    process = Process("corrector", domain, tmp_path, stream=True, timeout_s=1.0, horizon_s=0.5, blend_s=0.5)
    with running(process), listener(domain) as (node, wait):
        arm = Arm(node)
        arm.calibration.publish(String(data=text(first)))
        wait(arm.connected, 60.0)

        def one(made: Any, k: int) -> Array:
            """The setpoint for the k-th pose of a slow course; the arm follows."""
            wanted = truth(made, AWAY + 1e-3 * math.sin(0.05 * k))
            message = arm.ask(wait, lambda: arm.wish(wanted))
            (point,) = message.points
            stamps.append(seconds(message.header.stamp))
            assert seconds(point.time_from_start) == pytest.approx(0.5)
            arm.q = np.array(point.positions)
            return arm.q.copy()

        stamps: list[float] = []
        course = [one(first, k) for k in range(20)]
        assert np.abs(course[-1] - AWAY - 1e-3 * math.sin(0.05 * 19)).max() < 1e-6

        arm.calibration.publish(String(data=text(slightly)))
        expected = Correction(slightly)
        settled = None
        for k in range(20, 400):
            course.append(one(first, k))
            T = expected.pose(course[-1], ArmState.at_rest(course[-1], 1.7e9))
            wanted = truth(first, AWAY + 1e-3 * math.sin(0.05 * k))
            settled = k if settled is None and np.abs(T - wanted).max() < 1e-9 else settled
            if settled is not None and k > settled + 5:
                break
        assert settled is not None, "the new calibration never came in"
        # however long it was between two setpoints: a cubic is at most 1.5 times as steep as straight
        plain = np.abs(np.diff(course[:20], axis=0)).max()
        blended = 1.5 * 6e-4 * np.minimum(np.diff(stamps) / 0.5, 1.0)
        assert (np.abs(np.diff(course, axis=0)).max(axis=1) < 1.2 * plain + blended).all(), "it came in with a jump"

        arm.calibration.publish(String(data=text(much)))

        sent = [arm.q.copy()]

        def waits() -> bool:
            sent.append(one(first, 0))
            return any("waits for the stream to pause" in said and "moves a joint by" in said for said in arm.said)

        wait(waits, 30.0)
        steps, apart = np.abs(np.diff(sent, axis=0)).max(axis=1), np.diff(stamps[-len(sent) :])
        assert (steps[apart < 0.5] < 5e-3).all(), "while the stream runs the old one is in use; the new one is 0.01 off"
        wait(lambda: re.search("^in use$|no uncertainty", arm.health["calibration"].message), 20.0)
        assert np.abs(one(much, 0) - AWAY).max() < 1e-5

        # too far for the time, and out of the question
        arm.refuse(wait, lambda: arm.wish(truth(much, arm.q + np.eye(6)[0] * 0.6)), "is faster than")
        arm.refuse(wait, lambda: arm.wish(truth(much, arm.q), stamp=arm.now() - 3.0), "s old")
        straight = np.array([0.3, -1.2, 0.0, -0.8, 1.1, 0.2])
        arm.q = straight
        wait(lambda: np.abs(np.array(arm.states[-1].position) - straight).max() < 0.02, 20.0)
        arm.refuse(wait, lambda: arm.wish(truth(much, straight)), "singular")


def test_simulated_time_that_stands_still_goes_on_and_jumps_back(tmp_path: Path) -> None:
    made = calibration()
    domain = fresh_domain()
    process = Process("corrector", domain, tmp_path, calibration=written(made, tmp_path), use_sim_time="true")
    with running(process), listener(domain) as (node, wait):
        arm = Arm(node)
        clock = node.create_publisher(Clock, "/clock", 10)
        time_now = {"t": 100.0}
        arm.now = lambda: time_now["t"]  # type: ignore[method-assign]

        def tick(step: float = 0.01) -> None:
            time_now["t"] += step
            message = Clock()
            set_seconds(message.clock, time_now["t"])
            clock.publish(message)

        ticking = node.create_timer(0.01, tick)
        wait(arm.connected, 60.0)
        assert seconds(arm.poses[-1].header.stamp) < 1000.0
        goal = truth(made, AWAY + 0.05)
        assert arm.ask(wait, lambda: arm.wish(goal)).points
        # back to the start: what was said before lies ahead, and is not taken for news
        time_now["t"] = 10.0
        arm.poses.clear()
        arm.commands.clear()
        wait(lambda: any(seconds(p.header.stamp) < 90.0 for p in arm.poses), 20.0)
        arm.refuse(wait, lambda: arm.wish(goal, stamp=100.0), "s ahead")
        assert arm.ask(wait, lambda: arm.wish(goal)).points
        # a clock that stands still: the last posture is still of now
        ticking.cancel()
        arm.commands.clear()
        assert arm.ask(wait, lambda: arm.wish(goal)).points


def test_a_description_that_is_not_latched_and_two_that_wish_at_once(tmp_path: Path) -> None:
    made = calibration()
    domain = fresh_domain()
    process = Process("corrector", domain, tmp_path, calibration=written(made, tmp_path))
    with running(process), listener(domain) as (node, wait):
        arm = Arm(node, urdf="")
        volatile = node.create_publisher(String, "robot_description", 1)

        def told() -> bool:
            volatile.publish(String(data=URDF))
            wait(lambda: True, 1.0)
            return bool(arm.poses)

        wait(told, 60.0)
        other = node.create_publisher(PoseStamped, "desired_pose", 10)
        wait(lambda: "2 publishers at once" in arm.health["hearing"].message, 20.0)
        assert arm.health["hearing"].level == WARN
        node.destroy_publisher(other)
        wait(lambda: arm.health["hearing"].level == OK, 20.0)


def test_reset_and_parameters_at_run_time(tmp_path: Path) -> None:
    made = calibration()
    domain = fresh_domain()
    process = Process("corrector", domain, tmp_path)
    with running(process), listener(domain) as (node, wait):
        arm = Arm(node)
        arm.calibration.publish(String(data="nonsense: ["))
        wait(lambda: "calibration" in arm.health and "is not YAML" in arm.health["calibration"].message, 60.0)
        arm.calibration.publish(String(data=text(made)))
        wait(arm.connected, 20.0)
        arm.calibration.publish(String(data="nonsense: ["))
        wait(lambda: "is not YAML" in arm.health["calibration"].message, 20.0)
        assert arm.health["calibration"].level == WARN, "the one in use stays in use"

        def set_parameter(name: str, value: ParameterValue) -> Any:
            client = node.create_client(SetParameters, "corrector/set_parameters")
            wait(client.service_is_ready, 20.0)
            answer = client.call_async(SetParameters.Request(parameters=[ParameterMessage(name=name, value=value)]))
            wait(answer.done, 20.0)
            return answer.result().results[0]

        assert set_parameter("target", ParameterValue(type=4, string_value="tool")).successful
        arm.poses.clear()
        wait(lambda: len(arm.poses) > 2, 20.0)
        assert np.abs(matrix(arm.poses[-1].pose.pose) - truth(made, AWAY, "tool")).max() < 1e-12
        assert "must be tip or tool" in set_parameter("target", ParameterValue(type=4, string_value="elbow")).reason
        assert not set_parameter("horizon_s", ParameterValue(type=3, double_value=1e9)).successful
        assert "read-only" in set_parameter("calibration", ParameterValue(type=4, string_value="x")).reason

        reset = node.create_client(Trigger, "corrector/reset")
        wait(reset.service_is_ready, 20.0)
        answer = reset.call_async(Trigger.Request())
        wait(answer.done, 20.0)
        assert answer.result().success
        wait(lambda: arm.health["calibration"].level == ERROR, 20.0)
        arm.refuse(wait, lambda: arm.wish(truth(made, AWAY)), "no command is corrected")
        arm.calibration.publish(String(data=text(made)))
        arm.poses.clear()
        wait(lambda: arm.poses, 20.0)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"calibration": "nowhere"}, "nowhere: does not exist"),
        ({"target": "elbow"}, "target 'elbow'"),
        ({"joint_speed_rad_s": "-1.0"}, "joint_speed_rad_s"),
    ],
)
def test_wrong_parameters_end_it_with_one_line(parameters: dict[str, str], said: str, tmp_path: Path) -> None:
    process = Process("corrector", fresh_domain(), tmp_path, **parameters)
    with running(process):
        assert process.popen.wait(60.0) == 2
    (line,) = [line for line in process.output.splitlines() if line.startswith("modcal: ")]
    assert said in line
    assert "Traceback" not in process.output
