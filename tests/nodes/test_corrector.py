"""The corrector as a process: what it publishes is right, also while its calibration, description, clock or parameters change."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from correction.test_compensation import started
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from modcal_interfaces.msg import Calibration
from nodes.cell import call
from nodes.corrected_arm import (
    AWAY,
    CHAIN,
    GEAR,
    LATCHED,
    URDF,
    Arm,
    calibration,
    matrix,
    message,
    near,
    truth,
    written,
)
from nodes.processes import beside, put
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String

from modcal_core.correction.correction import ArmState, Correction
from modcal_core.geometry.so3 import Array
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.readings import nanoseconds, seconds, set_seconds

pytestmark = pytest.mark.dds

ERROR, WARN, OK = DiagnosticStatus.ERROR, DiagnosticStatus.WARN, DiagnosticStatus.OK


def test_true_poses_effective_joints_and_the_corrected_urdf(tmp_path: Path) -> None:
    """Whatever order, company and parts the joints come in."""
    made = calibration()
    with beside(tmp_path, "corrector", calibration=written(made, tmp_path)) as (process, node, wait):
        arm = Arm(node)

        def turned_and_accompanied(message: JointState) -> list[JointState]:
            message.name = ["gripper", *message.name[::-1]]
            message.position = [0.7, *list(message.position)[::-1]]
            return [message]

        def in_two_parts(message: JointState) -> list[JointState]:
            parts = []
            for rows in (slice(0, 3), slice(3, 6)):
                part = JointState(name=message.name[rows], position=list(message.position)[rows])
                part.header = message.header
                parts.append(part)
            return parts

        sent: set[int] = set()

        def stamped_to_the_nanosecond(message: JointState) -> list[JointState]:
            message.header.stamp = node.get_clock().now().to_msg()
            sent.add(nanoseconds(message.header.stamp))
            return [message]

        expected = truth(made, AWAY)
        for reshape in (stamped_to_the_nanosecond, turned_and_accompanied, in_two_parts):
            arm.reshape = reshape
            arm.poses.clear()
            arm.states.clear()
            wait(lambda: len(arm.poses) > 3 and len(arm.states) > 3, 60.0)
            if reshape is stamped_to_the_nanosecond:
                assert {nanoseconds(m.header.stamp) for m in (*arm.poses, *arm.states)} <= sent
            pose = arm.poses[-1]
            assert pose.header.frame_id == "base_link"
            assert abs(seconds(pose.header.stamp) - arm.now()) < 2.0
            assert np.abs(matrix(pose.pose.pose) - expected).max() < 1e-12
            state = arm.states[-1]
            assert tuple(state.name) == CHAIN.names
            assert 1e-5 < np.abs(np.array(state.position) - AWAY).max() < 1e-3
        covariance = np.array(pose.pose.covariance).reshape(6, 6)
        assert np.allclose(np.diag(covariance), 1e-8)
        # the corrected description with the effective joints is the corrected pose
        wait(lambda: arm.urdfs, 10.0)
        corrected = read_chain(arm.urdfs[-1])
        assert np.abs(chain_forward(corrected, np.array(arm.states[-1].position)) - expected).max() < 1e-9
        assert arm.urdfs[-1] != URDF
        # a joint that is not reported is said; no command is corrected without it
        arm.reshape = lambda m: [JointState(header=m.header, name=m.name[:5], position=list(m.position)[:5])]
        wait(lambda: "correction" in arm.health and "wrist_3_joint" in arm.health["correction"].message, 20.0)
        assert arm.health["correction"].level == ERROR
        # one of two drivers falls silent: what its joints said last is old, and nothing is corrected from it
        arm.reshape = lambda m: in_two_parts(m)[1:]
        until = arm.now() + 0.5  # five times the node's timeout
        wait(lambda: arm.now() > until, 10.0)
        arm.poses.clear()
        arm.states.clear()
        until = arm.now() + 0.5
        wait(lambda: arm.now() > until, 10.0)
        assert arm.poses == []
        assert arm.states == []
        assert process.stop() == 0


def test_goals_are_commanded_and_hostile_ones_refused(tmp_path: Path) -> None:
    made = calibration()
    with beside(tmp_path, "corrector", calibration=written(made, tmp_path), joint_speed_rad_s=0.25) as (_, node, wait):
        arm = Arm(node)
        wait(arm.connected, 60.0)

        goal = AWAY + 0.1
        for frame in ("", "base_link", "tracker"):
            wanted = truth(made, goal, "tip", frame if frame == "tracker" else "")
            command = arm.ask(wait, lambda wanted=wanted, frame=frame: arm.wish(wanted, frame))
            assert tuple(command.joint_names) == CHAIN.names
            (point,) = command.points
            q = np.array(point.positions)
            assert np.abs(q - goal).max() < 1e-6
            assert seconds(point.time_from_start) == pytest.approx(np.abs(q - AWAY).max() / 0.25, abs=1e-6)

        good = truth(made, goal)
        far_away = near(good, 0.0)
        far_away[:3, 3] *= 1000.0
        unreachable = near(good, 0.0)
        unreachable[:3, 3] = [1.0, 0.9, 0.9]
        not_finite, not_unit = arm.wish(good).pose, arm.wish(good).pose
        not_finite.position.y = math.nan
        not_unit.orientation.w += 0.2
        hostile = {
            "looks like millimetres": lambda: arm.wish(far_away),
            "frame 'camera'": lambda: arm.wish(good, "camera"),
            "misses it by": lambda: arm.wish(unreachable),
            "is not finite": lambda: PoseStamped(header=arm.wish(good).header, pose=not_finite),
            "quaternion has length": lambda: PoseStamped(header=arm.wish(good).header, pose=not_unit),
            "s old": lambda: arm.wish(good, stamp=arm.now() - 5.0),
            "s ahead": lambda: arm.wish(good, stamp=arm.now() + 5.0),
        }
        for said, wish in hostile.items():
            arm.refuse(wait, wish, said)
        # an arm that falls silent is not commanded, and where it truly is is no longer said
        arm.silent = True
        wait(lambda: arm.health["correction"].level == ERROR, 20.0)
        arm.refuse(wait, lambda: arm.wish(good), "s off, 0.1 s is the limit")
        arm.silent = False
        wait(lambda: arm.health["correction"].level == OK, 20.0)
        assert arm.ask(wait, lambda: arm.wish(good, stamp=0.0)).points


def test_what_the_effects_need_is_asked_for(tmp_path: Path) -> None:
    """A temperature that nobody publishes: said, and no command is corrected until it comes."""
    made = calibration(0, started("sensor"))
    with beside(tmp_path, "corrector", calibration=written(made, tmp_path)) as (_, node, wait):
        arm = Arm(node)
        heat = node.create_publisher(Temperature, "temperature", 10)
        wait(lambda: "correction" in arm.health and "temperature:arm" in arm.health["correction"].message, 60.0)
        wait(arm.heard, 20.0)
        arm.refuse(wait, lambda: arm.wish(truth(calibration(), AWAY)), "temperature:arm")
        assert not arm.poses
        for value in (math.nan, 5000.0, 30.0):
            message = Temperature(temperature=value)
            message.header.frame_id = "arm"
            set_seconds(message.header.stamp, arm.now())
            heat.publish(message)
        wait(lambda: arm.poses, 20.0)
        expected = Correction(made).model
        longer = chain_forward(expected.chain, AWAY)
        gap = np.linalg.norm(matrix(arm.poses[-1].pose.pose)[:3, 3] - longer[:3, 3])
        assert gap == pytest.approx(30.0 * 2e-5, rel=0.02)


def test_the_calibration_of_the_tests_is_another_than_the_drawing() -> None:
    """Else all of the above would pass without any correction."""
    made = calibration()
    assert np.linalg.norm(truth(made, AWAY)[:3, 3] - chain_forward(CHAIN, AWAY)[:3, 3]) > 5e-4
    assert replace(made.calibrated, effects=()).chain.names == CHAIN.names


def test_a_calibration_of_another_robot_corrects_nothing(tmp_path: Path) -> None:
    """Joints of other names, or the same names on another arm; the right description then is taken."""
    made = calibration()
    with beside(tmp_path, "corrector", calibration=written(made, tmp_path)) as (_, node, wait):
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
    # time enough for a machine that does other things as well
    with beside(tmp_path, "corrector", stream=True, timeout_s=1.0, horizon_s=0.5, blend_s=0.5) as (_, node, wait):
        arm = Arm(node)
        arm.calibration.publish(message(first))
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

        arm.calibration.publish(message(slightly))
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

        arm.calibration.publish(message(much))

        sent = [arm.q.copy()]

        def waits() -> bool:
            sent.append(one(first, 0))
            return any(
                "waits for the stream to pause" in said and "moves a joint by" in said
                for said in chain(*arm.health.texts.values())
            )

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
    with beside(tmp_path, "corrector", calibration=written(made, tmp_path), use_sim_time="true") as (_, node, wait):
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


def test_reset_and_parameters_at_run_time(tmp_path: Path) -> None:
    made = calibration()
    with beside(tmp_path, "corrector") as (_, node, wait):
        arm = Arm(node)
        arm.calibration.publish(Calibration())
        wait(
            lambda: "calibration" in arm.health and "is not a modcal calibration" in arm.health["calibration"].message,
            60.0,
        )
        arm.calibration.publish(message(made))
        wait(arm.connected, 20.0)
        arm.calibration.publish(Calibration())
        wait(lambda: "is not a modcal calibration" in arm.health["calibration"].message, 20.0)
        assert arm.health["calibration"].level == WARN, "the one in use stays in use"

        set_parameter = partial(put, node, wait, "corrector")
        assert not set_parameter(target="tool")
        arm.poses.clear()
        wait(lambda: len(arm.poses) > 2, 20.0)
        assert np.abs(matrix(arm.poses[-1].pose.pose) - truth(made, AWAY, "tool")).max() < 1e-12
        assert "must be tip or tool" in set_parameter(target="elbow")
        assert set_parameter(horizon_s=1e9)
        assert "read-only" in set_parameter(calibration="x")

        assert call(node, wait, "corrector/reset").success
        wait(lambda: arm.health["calibration"].level == ERROR, 20.0)
        arm.refuse(wait, lambda: arm.wish(truth(made, AWAY)), "no command is corrected")
        arm.calibration.publish(message(made))
        arm.poses.clear()
        wait(lambda: arm.poses, 20.0)
