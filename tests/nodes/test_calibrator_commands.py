"""The calibrator hears what joints are told, as either type of message, and names a joint that logs late."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes.beside_a_cell import beside_a_cell, stations
from nodes.cell import call
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

pytestmark = pytest.mark.dds
ELBOW, COUNT = 2, 80


@pytest.mark.parametrize("kind", [JointState, JointTrajectory])
def test_a_joint_that_logs_late_is_named(kind: type, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    made = stations(COUNT)
    joints = made.joints[0]
    apart = 1e-5 * rng.standard_normal(joints.position.shape)
    apart[:, ELBOW] += 1e-3 * rng.standard_normal(COUNT)
    logged = joints.position - np.where(np.arange(6) == ELBOW, apart, 0.0)
    played = replace(made, joints=(replace(joints, position=logged),))
    told = logged + apart
    with beside_a_cell(tmp_path, out=tmp_path / "out") as (_, node, wait, cell, said):
        commands = node.create_publisher(kind, "joint_commands", 100)
        wait(lambda: said.found("/joint_commands"), 60.0)

        def with_commands(i: int, message: Any) -> Any:
            if isinstance(message, JointState):
                row = int(
                    np.argmin(np.abs(joints.stamps - message.header.stamp.sec - 1e-9 * message.header.stamp.nanosec))
                )
                positions = told[row].tolist()
                command = kind(header=message.header)
                if kind is JointState:
                    command.name, command.position = list(joints.names), positions
                else:
                    command.joint_names, command.points = (
                        list(joints.names),
                        [JointTrajectoryPoint(positions=positions)],
                    )
                commands.publish(command)
            return message

        cell.play(played, with_commands)
        wait(lambda: cell.taken() and said.counted("/joint_commands") >= COUNT, 60.0)
        answer = call(node, wait, "calibrator/solve")
        assert answer.success, answer.message
        node.destroy_publisher(commands)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    (effect,) = report["effects"]
    assert (effect["family"], effect["place"], effect["driver"]) == (
        "joint_lag",
        "elbow_joint",
        "following:elbow_joint",
    )
    assert effect["parameters"]["stale_share"]["value"] == pytest.approx(1.0, abs=0.1)
