"""The corrector as a process: what it publishes is right, and what it must not do it does not."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from correction.test_compensation import started
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nodes.corrected_arm import AWAY, CHAIN, URDF, Arm, calibration, matrix, near, truth, written
from nodes.processes import Process, fresh_domain, listener, running
from sensor_msgs.msg import JointState, Temperature

from modcal_core.correction.correction import Correction
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.readings import seconds, set_seconds

pytestmark = pytest.mark.dds
ERROR, WARN, OK = DiagnosticStatus.ERROR, DiagnosticStatus.WARN, DiagnosticStatus.OK


def test_true_poses_effective_joints_and_the_corrected_urdf(tmp_path: Path) -> None:
    """Whatever order, company and parts the joints come in."""
    made = calibration()
    domain = fresh_domain()
    process = Process("corrector", domain, tmp_path, calibration=written(made, tmp_path))
    with running(process), listener(domain) as (node, wait):
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

        expected = truth(made, AWAY)
        for reshape in (lambda m: [m], turned_and_accompanied, in_two_parts):
            arm.reshape = reshape
            arm.poses.clear()
            arm.states.clear()
            wait(lambda: len(arm.poses) > 3 and len(arm.states) > 3, 60.0)
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
    domain = fresh_domain()
    process = Process("corrector", domain, tmp_path, calibration=written(made, tmp_path), joint_speed_rad_s=0.25)
    with running(process), listener(domain) as (node, wait):
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


def test_two_arms_in_one_domain(tmp_path: Path) -> None:
    """Each hears and answers its own, in its namespace."""
    domain = fresh_domain()
    made = {"/left": calibration(1), "/right": calibration(2)}
    processes, postures = [], {"/left": AWAY, "/right": -AWAY}
    for space, its in made.items():
        folder = tmp_path / space[1:]
        folder.mkdir()
        processes.append(Process("corrector", domain, folder, "-r", f"__ns:={space}", calibration=written(its, folder)))
    with running(*processes), listener(domain) as (node, wait):
        arms = {space: Arm(node, space, q) for space, q in postures.items()}
        for arm in arms.values():
            wait(arm.connected, 60.0)
        for space, arm in arms.items():
            assert np.abs(matrix(arm.poses[-1].pose.pose) - truth(made[space], postures[space])).max() < 1e-12
        goal = postures["/right"] + 0.05
        command = arms["/right"].ask(wait, lambda: arms["/right"].wish(truth(made["/right"], goal)))
        assert np.abs(np.array(command.points[0].positions) - goal).max() < 1e-6
        assert not arms["/left"].commands


def test_what_the_effects_need_is_asked_for(tmp_path: Path) -> None:
    """A temperature that nobody publishes: said, and no command is corrected until it comes."""
    made = calibration(0, started("sensor"))
    domain = fresh_domain()
    process = Process("corrector", domain, tmp_path, calibration=written(made, tmp_path))
    with running(process), listener(domain) as (node, wait):
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
