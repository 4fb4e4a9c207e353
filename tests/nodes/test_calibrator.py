"""The calibrator in a real cell: what it hears, of whatever topics, quality of service and commands, and what it refuses."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cells import record
from cli.recordings import START, URDF, part
from modcal_interfaces.msg import Calibration
from nodes.beside_a_cell import (
    HEARING,
    MODEL,
    SAMPLES,
    STATIONS,
    alive,
    beside_a_cell,
    children,
    latched,
    stations,
)
from nodes.cell import PlayedCell, call
from nodes.processes import Process, Wait, beside, fresh_domain, listener, meet, running
from nodes.talking import BEST_EFFORT, Diagnostics
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.measurements.dropouts import ALONE, BEYOND, ELSEWHEN, IMPLAUSIBLE
from modcal_nodes.calibrating.intake import KnownArm
from modcal_nodes.io.inputs import calibration_of

pytestmark = pytest.mark.dds


class Shared:
    """One calibrator for the tests that need nothing special of it. Each begins with nothing heard, and later stamps."""

    def __init__(
        self, calibrator: Process, node: Node, wait: Wait, cell: PlayedCell, said: Diagnostics, out: Path
    ) -> None:
        self.calibrator, self.node, self.wait, self.cell, self.said, self.out = calibrator, node, wait, cell, said, out
        self._begin = START

    def again(self) -> float:
        """The stamp [s] to begin at."""
        shutil.rmtree(self.out, ignore_errors=True)
        assert call(self.node, self.wait, "calibrator/reset").success
        self._begin += 10_000.0
        return self._begin

    def counted(self, what: str) -> int:
        """A count that the calibrator keeps of its samples."""
        return int(self.said.value(SAMPLES, what) or 0)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    folder = tmp_path_factory.mktemp("shared")
    # what the model of one test makes of the next one's stations must not start a solve by itself
    with beside_a_cell(folder, effects=False, after_change=0, out=folder / "out") as made:
        yield Shared(*made, folder / "out")


def test_joints_in_any_order_with_others_between_them(shared: Shared) -> None:
    begin = shared.again()

    def shuffled(i: int, message: Any) -> Any:
        if hasattr(message, "name"):
            order = np.random.default_rng(i % 3).permutation(7)
            names, positions = [*message.name, "gripper"], [*message.position, 0.01]
            message.name, message.position = [names[k] for k in order], [positions[k] for k in order]
        return message

    shared.cell.play(stations(begin=begin), shuffled)
    shared.wait(shared.cell.taken, 60.0)
    assert call(shared.node, shared.wait, "calibrator/solve").success
    report = json.loads((shared.out / "report.json").read_text())
    assert report["recording"]["stations"] == STATIONS
    assert report["error_mm"]["final"]["rms"] < 0.2
    assert (shared.out / "report.html").is_file()


def test_silence_is_said_by_topic(tmp_path: Path) -> None:
    with beside(tmp_path, "calibrator", silence_timeout_s=1.0) as (calibrator, node, wait):
        said = Diagnostics(node)
        wait(lambda: said.level(HEARING) == 2, 60.0)
        assert "/joint_states: no node publishes it" in said.text(HEARING)
        assert "/robot_description: no node publishes it" in said.text(HEARING)
        cell = PlayedCell(node)
        cell.describe(URDF.read_text())
        wait(cell.heard, 60.0)
        one = stations(2)
        joints_only = partial(cell.play, one, lambda _, m: m if hasattr(m, "name") else None)
        wait(lambda: joints_only() or "no message from the tracker" in said.text(HEARING), 30.0)
        assert said.level(HEARING) == 1
        wait(lambda: cell.play(one) or said.level(HEARING) == 0, 30.0)
        wait(lambda: "/joint_states: silent for" in said.text(HEARING), 30.0)  # the joints fell silent again
        assert said.level(HEARING) == 1
        assert calibrator.stop() == 0


def test_a_clock_set_back_begins_a_new_stretch(shared: Shared) -> None:
    begin = shared.again()
    whole, before = stations(60, begin=begin), shared.counted("clock set back")
    shared.cell.play(part(whole, slice(0, 30)))
    # the second half at stamps an hour before the first
    later = part(whole, slice(30, 60))
    joints, reading = later.joints[0], later.readings[0]
    back = replace(joints, stamps=joints.stamps - 3600.0), replace(reading, stamps=reading.stamps - 3600.0)
    shared.cell.play(replace(later, joints=(back[0],), readings=(back[1],)))
    shared.wait(shared.cell.taken, 60.0)
    shared.wait(lambda: shared.counted("clock set back") == before + 1, 20.0)
    assert call(shared.node, shared.wait, "calibrator/solve").success
    # readings overtake the joint state that says that the clock was set back, and are not lost
    assert json.loads((shared.out / "report.json").read_text())["recording"]["stations"] == 60


def test_a_reset_ends_the_solve_of_what_it_clears(shared: Shared) -> None:
    shared.cell.play(stations(begin=shared.again()))
    shared.wait(shared.cell.taken, 60.0)
    client = shared.node.create_client(Trigger, "calibrator/solve")
    meet(shared.wait, client)
    answers = [client.call_async(Trigger.Request()) for _ in range(2)]
    shared.wait(lambda: any(a.done() for a in answers), 20.0)  # that it is running already
    shared.again()
    answers.append(client.call_async(Trigger.Request()))  # a new one, which has nothing to solve
    shared.wait(lambda: all(a.done() for a in answers), 20.0)
    said = [a.result().message for a in answers]
    assert said.count("a solve is running already") == 1
    assert "the data it was solved from have been cleared since" in said
    shared.node.destroy_client(client)


def test_messages_without_a_station_are_left_out_when_they_grow_old(tmp_path: Path) -> None:
    """Half a minute of joint states without a tracker, and then a cell as it should be."""
    with beside_a_cell(tmp_path, effects=False, buffer_s=20.0) as (calibrator, node, wait, cell, _):
        cell.play(stations(30), lambda _, m: m if hasattr(m, "name") else None)
        wait(lambda: "some minutes of messages are left out" in calibrator.output, 60.0)
        cell.play(stations(begin=START + 100.0))
        wait(cell.taken, 60.0)
        answer = call(node, wait, "calibrator/solve")
        assert answer.success, answer.message


def cannot_be(i: int, message: Any) -> Any:
    """The message, or one of each kind that cannot be."""
    joints = hasattr(message, "name")
    if joints and i == 9:
        message.position[2] = 1e9
    elif joints and i == 14:
        message.header.stamp.sec = 0
    elif not joints and i == 20:
        message.pose.position.y = 1e16
    elif not joints and i == 25:
        message.pose.orientation.x, message.pose.orientation.w = 0.3, 0.0
        message.pose.orientation.y = message.pose.orientation.z = 0.0
    elif not joints and i == 31:
        message.header.stamp.sec = 2**31 - 1
    elif not joints and i == 37:
        message.pose.position.x = float("nan")
    return message


def millimetres(_: int, message: Any) -> Any:
    if not hasattr(message, "name"):
        at = message.pose.position
        at.x, at.y, at.z = 1e3 * at.x, 1e3 * at.y, 1e3 * at.z
    return message


def test_messages_that_cannot_be_are_left_out_counted_and_said_as_of_a_bag(shared: Shared) -> None:
    begin = shared.again()
    refused = int(shared.said.value(SAMPLES, "messages refused") or 0)
    shared.cell.play(stations(begin=begin), cannot_be)
    shared.wait(shared.cell.taken, 60.0)
    assert call(shared.node, shared.wait, "calibrator/solve").success
    report = json.loads((shared.out / "report.json").read_text())
    assert report["recording"]["stations"] == STATIONS - 6
    assert report["recording"]["dropped"] == {
        BEYOND: 1,
        f"joint states {ELSEWHEN}": 1,
        f"readings {ELSEWHEN}": 1,
        IMPLAUSIBLE: 2,
        ALONE: 2,  # whose joint states were left out
        "readings that are not finite": 1,
    }
    assert sum("left out" in note for note in report["notes"]) == 5
    shared.wait(lambda: int(shared.said.value(SAMPLES, "messages refused")) == refused + 6, 10.0)


def test_what_cannot_be_calibrated_is_refused_in_one_line(shared: Shared) -> None:
    shared.cell.play(stations(begin=shared.again()), millimetres)
    shared.wait(shared.cell.taken, 60.0)
    answer = call(shared.node, shared.wait, "calibrator/solve")
    assert not answer.success
    assert "millimetres" in answer.message
    assert "\n" not in answer.message
    assert not shared.out.exists()


def test_reset_forgets_what_was_heard_and_keeps_what_is_trusted(shared: Shared) -> None:
    node, wait = shared.node, shared.wait
    shared.cell.play(stations(begin=shared.again()))
    wait(shared.cell.taken, 60.0)
    assert call(node, wait, "calibrator/solve").success
    assert not call(node, wait, "calibrator/save").success  # there is no folder to save in
    assert call(node, wait, "calibrator/reset").success
    answer = call(node, wait, "calibrator/solve")
    assert not answer.success
    assert "no message was received" in answer.message
    wait(lambda: shared.said.value(MODEL, "state") == "trusted", 10.0)


def test_an_unwritable_folder_is_said(shared: Shared) -> None:
    begin = shared.again()
    shared.out.write_text("in the way")
    shared.cell.play(stations(begin=begin))
    shared.wait(shared.cell.taken, 60.0)
    answer = call(shared.node, shared.wait, "calibrator/solve")
    shared.out.unlink()
    assert not answer.success
    assert "out: is a file" in answer.message


def test_any_quality_of_service_is_heard_and_a_mismatch_is_said(tmp_path: Path) -> None:
    """A description that is not latched, a tracker of best effort."""
    volatile = QoSProfile(depth=1, durability=DurabilityPolicy.VOLATILE)
    with beside(tmp_path, "calibrator", effects=False) as (calibrator, node, wait):
        said = Diagnostics(node)
        cell = PlayedCell(node, description=volatile, tracker=BEST_EFFORT)
        wait(
            lambda: (
                "durability does not match" in calibrator.output and "reliability does not match" in calibrator.output
            ),
            60.0,
        )
        wait(cell.heard, 60.0)
        for _ in range(5):
            cell.describe(URDF.read_text())
        cell.play(stations())
        wait(lambda: said.counted("/tracker/pose") >= 40, 30.0)  # some may have been lost
        assert call(node, wait, "calibrator/solve").success
        assert calibrator.stop() == 0


def test_two_publishers_of_one_arms_joints_are_said(shared: Shared) -> None:
    another = shared.node.create_publisher(JointState, "joint_states", 10)
    shared.wait(lambda: "/joint_states: 2 publishers at once" in shared.said.text(HEARING), 30.0)
    assert shared.said.level(HEARING) >= 1
    shared.node.destroy_publisher(another)


def test_a_killed_solver_is_replaced(shared: Shared) -> None:
    shared.cell.play(stations(begin=shared.again()))
    shared.wait(shared.cell.taken, 60.0)
    for child in children(shared.calibrator.popen.pid):
        if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
            os.kill(child, signal.SIGKILL)
            shared.wait(lambda: not alive(child), 20.0)  # noqa: B023
    answer = call(shared.node, shared.wait, "calibrator/solve")
    if not answer.success:  # the node had not noticed yet
        answer = call(shared.node, shared.wait, "calibrator/solve")
    assert answer.success, answer.message


def test_two_robots_in_one_domain(tmp_path: Path) -> None:
    domain = fresh_domain()
    sides = ("left", "right")
    nodes = [Process("calibrator", domain, tmp_path, "-r", f"__ns:=/{s}", effects=False) for s in sides]
    with running(*nodes), listener(domain) as (node, wait):
        cells = [PlayedCell(node, f"/{side}") for side in sides]
        wait(lambda: all(cell.heard() for cell in cells), 60.0)
        for seed, cell in enumerate(cells):
            cell.describe(URDF.read_text())
            cell.play(stations(seed=21 + seed))
            wait(cell.taken, 60.0)
        heard = [latched(node, f"/{side}/calibrator/calibration", Calibration) for side in sides]
        for side in sides:
            assert call(node, wait, f"/{side}/calibrator/solve").success
        wait(lambda: all(heard), 20.0)
        assert [process.stop() for process in nodes] == [0, 0]
    models = [calibration_of(told[-1], side) for told, side in zip(heard, sides, strict=True)]
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 6))
    for seed, model in enumerate(models):
        truth = record(21 + seed, 2).world.tool_in_tracker(q)
        assert np.abs(model.calibrated.predict(q)[:, :3, 3] - truth[:, :3, 3]).max() < 3e-4
        other = record(21 + 1 - seed, 2).world.tool_in_tracker(q)
        assert np.abs(model.calibrated.predict(q)[:, :3, 3] - other[:, :3, 3]).max() > 1e-2


ELBOW, COUNT = 2, 80


def test_a_joint_that_logs_late_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    made = stations(COUNT)
    joints = made.joints[0]
    apart = 1e-5 * rng.standard_normal(joints.position.shape)
    apart[:, ELBOW] += 1e-3 * rng.standard_normal(COUNT)
    logged = joints.position - np.where(np.arange(6) == ELBOW, apart, 0.0)
    played = replace(made, joints=(replace(joints, position=logged),))
    told = logged + apart
    with beside_a_cell(tmp_path, out=tmp_path / "out") as (_, node, wait, cell, said):
        commands = node.create_publisher(JointTrajectory, "joint_commands", 100)
        wait(lambda: said.found("/joint_commands"), 60.0)

        def with_commands(i: int, message: Any) -> Any:
            if isinstance(message, JointState):
                row = int(
                    np.argmin(np.abs(joints.stamps - message.header.stamp.sec - 1e-9 * message.header.stamp.nanosec))
                )
                positions = told[row].tolist()
                command = JointTrajectory(header=message.header, joint_names=list(joints.names))
                command.points = [JointTrajectoryPoint(positions=positions)]
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


_JOINT = (
    '<joint name="{0}" type="revolute"><parent link="l{1}"/><child link="l{2}"/><origin xyz="0 0 0.3"/>'
    '<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/>{3}</joint>'
)


def test_the_calibrator_fills_it_in() -> None:
    mimic = ("", "", '<mimic joint="a" multiplier="-1"/>')
    links = "".join(f'<link name="l{i}"/>' for i in range(4))
    joints = "".join(_JOINT.format(name, i, i + 1, mimic[i]) for i, name in enumerate("abc"))
    arm = KnownArm(f'<robot name="r">{links}{joints}</robot>', "l0", "l3")
    assert arm.recognise(frozenset("ab"))
    stamp = SimpleNamespace(sec=1, nanosec=0)
    q = np.array([0.4, 0.1]).tobytes()
    message = SimpleNamespace(header=SimpleNamespace(stamp=stamp), name=["b", "a"], position=q, effort=b"")
    arm.joint_state(message)
    told = arm.position(message)
    assert told is not None
    assert np.allclose(told, [0.1, 0.4, -0.1])
