"""Managed nodes in every state, under load; and what their answers are about."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.recordings import START, URDF
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetState
from modcal_interfaces.action import Solve
from modcal_interfaces.msg import Change, Verdict
from nodes.beside_a_cell import MODEL, beside_a_cell, latched, stations
from nodes.cell import call
from nodes.corrected_arm import AWAY, LATCHED, Arm, calibration, truth, written
from nodes.processes import Goal, Process, Wait, ask, beside, fresh_domain, listener, running
from nodes.talking import Diagnostics, Talker, numbers_on_disk
from rclpy.node import Node
from std_msgs.msg import String

from modcal_core.calibration.store import fingerprint
from modcal_core.geometry import se3
from modcal_core.measurements.recording import Recording
from modcal_core.robots.urdf import read_chain

pytestmark = pytest.mark.dds
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE, SHUTDOWN = (
    getattr(Transition, f"TRANSITION_{name}")
    for name in ("CONFIGURE", "CLEANUP", "ACTIVATE", "DEACTIVATE", "ACTIVE_SHUTDOWN")
)
UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = (
    getattr(State, f"PRIMARY_STATE_{name}") for name in ("UNCONFIGURED", "INACTIVE", "ACTIVE", "FINALIZED")
)
MANAGED = (
    "recorder", "calibrator", "corrector", "articulation_estimator", "acceleration_limits", "impedance_setpoint"
)  # fmt: skip
OTHERS = ("board_detector", "viewer", "simulated_cell", "simulated_furniture", "door_demo", "trajectory_sender")


class Manager:
    """Asks nodes for transitions, as a lifecycle manager does."""

    def __init__(self, node: Node, wait: Wait) -> None:
        self.node, self.wait = node, wait

    def change(self, name: str, transition: int) -> bool:
        request = ChangeState.Request()
        request.transition.id = transition
        return bool(ask(self.node, self.wait, ChangeState, f"{name}/change_state", request).success)

    def state(self, name: str) -> int:
        return int(ask(self.node, self.wait, GetState, f"{name}/get_state").current_state.id)


@contextlib.contextmanager
def managed(folder: Path, name: str, **parameters: Any) -> Iterator[tuple[Process, Manager]]:
    """One node and its manager; it must end well."""
    with beside(folder, name, **parameters) as (process, node, wait):
        yield process, Manager(node, wait)
        assert process.stop() == 0
        assert "Traceback" not in process.output


def test_every_executable_and_its_lifecycle(tmp_path: Path) -> None:
    """Managed nodes come up active and take every transition; the others have no such services."""
    target, trajectory = tmp_path / "target.yaml", tmp_path / "trajectory.yaml"
    target.write_text("{modcal_target: 1, type: chessboard, columns: 7, rows: 4, square_m: 0.03}")
    trajectory.write_text("{joint_names: [a], points: [{positions: [0.0], time_from_start: {sec: 0, nanosec: 0}}]}")
    needed: dict[str, dict[str, Any]] = {
        "board_detector": {"target": target},
        "simulated_cell": {"urdf": URDF},
        "simulated_furniture": {"urdf": URDF.with_name("panda.urdf")},
        "door_demo": {"start": "false"},
        "trajectory_sender": {"trajectory": trajectory, "patience_s": 600.0},
        "impedance_setpoint": {"autostart": True},
    }
    domain = fresh_domain()
    # each where nobody publishes what it hears
    names = (*MANAGED, "station_runner", *OTHERS)
    made = {n: Process(n, domain, tmp_path, "-r", f"__ns:=/of_{n}", **needed.get(n, {})) for n in names}
    with running(*made.values()), listener(domain) as (node, wait):
        manager, events = Manager(node, wait), dict[str, list[str]]()
        said = Diagnostics(node)
        wait(lambda: all(any(part.startswith(f"/of_{n}/") for part in said.last) for n in names), 60.0)
        services = {name for name, _ in node.get_service_names_and_types()}
        has = {n for n in names if f"/of_{n}/{n}/change_state" in services}
        assert has == {*MANAGED, "station_runner"}
        assert manager.state("/of_station_runner/station_runner") == ACTIVE
        for name in MANAGED:
            who = f"/of_{name}/{name}"
            heard = events.setdefault(name, [])
            node.create_subscription(
                TransitionEvent, f"{who}/transition_event", lambda m, h=heard: h.append(m.goal_state.label), 50
            )
            assert manager.state(who) == ACTIVE
            for transition, legal, state in (
                (CONFIGURE, False, ACTIVE), (DEACTIVATE, True, INACTIVE), (DEACTIVATE, False, INACTIVE),
                (ACTIVATE, True, ACTIVE), (DEACTIVATE, True, INACTIVE), (CLEANUP, True, UNCONFIGURED),
                (ACTIVATE, False, UNCONFIGURED), (CONFIGURE, True, INACTIVE), (ACTIVATE, True, ACTIVE),
                (SHUTDOWN, True, FINALIZED),
            ):  # fmt: skip
                assert (manager.change(who, transition), manager.state(who)) == (legal, state), (name, transition)
            wait(lambda h=heard: h[-1:] == ["finalized"], 10.0)
            assert {"inactive", "active", "unconfigured"} <= set(heard)
        assert [made[name].stop() for name in MANAGED] == [0] * len(MANAGED)
        assert not any("Traceback" in process.output for process in made.values())


def test_a_corrector_sends_only_while_it_is_active(tmp_path: Path) -> None:
    """Whatever is asked of it meanwhile; and one that cannot be configured says why, and can be once it is repaired."""
    made = calibration()
    place = tmp_path / "later"
    with managed(tmp_path, "corrector", calibration=place, autostart=False) as (process, manager):
        arm = Arm(manager.node, rate=200.0)
        assert not manager.change("corrector", CONFIGURE)
        assert manager.state("corrector") == UNCONFIGURED
        (line,) = [line for line in process.output.splitlines() if "configure failed" in line]
        assert str(place) in line
        manager.wait(lambda: line.endswith(arm.health["lifecycle"].message), 10.0)
        place.mkdir()
        shutil.move(written(made, tmp_path), place)
        assert manager.change("corrector", CONFIGURE)
        wanted = truth(made, AWAY + 0.1)

        def wishing(seconds: float) -> None:
            end = arm.now() + seconds
            while arm.now() < end:
                arm.desired.publish(arm.wish(wanted))
                due = arm.now() + 0.02
                manager.wait(lambda due=due: arm.now() > due, 10.0)

        wishing(1.0)
        assert not any((arm.poses, arm.states, arm.commands, arm.urdfs))
        for _ in range(3):
            assert manager.change("corrector", ACTIVATE)
            manager.wait(lambda: arm.poses and arm.states and arm.urdfs, 20.0)
            assert arm.ask(manager.wait, lambda: arm.wish(wanted)).points
            assert manager.change("corrector", DEACTIVATE)
            wishing(0.5)  # what was on its way has arrived
            for kept in (arm.poses, arm.states, arm.commands, arm.urdfs):
                kept.clear()
            late: list[str] = []
            heard = manager.node.create_subscription(
                String, "corrector/robot_description", lambda m, late=late: late.append(m.data), LATCHED
            )
            wishing(1.0)
            assert not any((arm.poses, arm.states, arm.commands, arm.urdfs, late))
            assert not call(manager.node, manager.wait, "corrector/reset").success
            manager.node.destroy_subscription(heard)
        assert manager.change("corrector", CLEANUP)
        assert manager.change("corrector", CONFIGURE)
        assert manager.change("corrector", ACTIVATE)
        manager.wait(lambda: arm.poses and arm.urdfs, 20.0)


def test_a_recorder_begins_a_bag_with_each_activation(tmp_path: Path) -> None:
    """Each bag is whole, and lacks nothing of its time."""
    with managed(tmp_path, "recorder", out=tmp_path / "bag") as (process, manager), Talker(manager.node, rate=400.0):
        manager.wait(lambda: "recording /joint_states" in process.output, 30.0)
        for count in range(1, 4):
            end = manager.node.get_clock().now().nanoseconds + 5e8
            manager.wait(lambda end=end: manager.node.get_clock().now().nanoseconds > end, 10.0)
            assert manager.change("recorder", DEACTIVATE)
            manager.wait(lambda count=count: process.output.count("] [modcal.recorder]: closed") == count, 10.0)
            assert manager.change("recorder", ACTIVATE)
    bags = [tmp_path / "bag", *(tmp_path / f"bag_{k}" for k in (2, 3))]
    numbers = [numbers_on_disk(bag) for bag in bags]
    for bag, heard in zip(bags, numbers, strict=True):
        assert (bag / "metadata.yaml").exists()
        assert len(heard) > 50
        assert heard == list(range(heard[0], heard[0] + len(heard)))
    assert numbers[0][-1] < numbers[1][0] <= numbers[1][-1] < numbers[2][0]


def seen(recording: Recording, T: Any = None, frame: str = "tracker") -> Recording:
    """The recording, as an instrument reads it that was moved by T, or calls itself so."""
    (track,) = recording.readings
    values = track.values if T is None else se3.to_pose(T @ np.stack([se3.from_pose(v) for v in track.values]))
    return replace(recording, readings=(replace(track, values=values, frame=frame),))


def test_a_calibrator_says_what_its_answers_are_about_and_ends_a_solve_when_it_is_deactivated(tmp_path: Path) -> None:
    robot = fingerprint(read_chain(URDF.read_text()))
    knock = se3.exp(np.array([1e-3, -2e-3, 1e-3, 5e-4, 0.0, -5e-4]))
    with beside_a_cell(tmp_path, effects=False, after_change=0) as (calibrator, node, wait, cell, said):
        manager, changes = Manager(node, wait), latched(node, "calibrator/change", Change)
        solve = partial(call, node, wait, "calibrator/solve")
        cell.play(stations())
        wait(cell.taken, 60.0)
        goal = Goal(node, wait, Solve, "calibrator/solve")
        assert manager.change("calibrator", DEACTIVATE)
        result = goal.result()[1]
        assert (result.outcome, result.message) == (Solve.Result.FAILED, "the node was deactivated")
        assert solve().message == "calibrator is inactive: activate it first"
        assert manager.change("calibrator", ACTIVATE)
        verdicts = latched(node, "calibrator/report", Verdict)
        answer = solve()
        assert answer.success
        assert answer.message.endswith(f"[robot {robot}, base_link to tool0, seen by tracker]")
        wait(lambda: verdicts, 10.0)
        about = verdicts[-1].about
        assert (about.robot, about.base, about.tip, about.observers) == (robot, "base_link", "tool0", ["tracker"])

        # base and instrument are one motion, whichever was knocked
        cell.play(seen(stations(16, begin=START + 1000.0), knock))
        wait(lambda: changes and changes[-1].changed, 60.0)
        assert {changes[-1].place, *changes[-1].same_as} >= {"base", "tracker"}
        assert "base or the tracker" in changes[-1].sentence
        assert changes[-1].about == about

        # another arm is published: nothing is solved, checked or accepted by the description of before
        cell.describe(URDF.read_text().replace("0.612", "0.622"))
        wait(lambda: said.level(MODEL) == 2, 20.0)
        for name in ("solve", "check", "accept"):
            answer = call(node, wait, f"calibrator/{name}")
            assert not answer.success
            assert "robot_description has changed" in answer.message
        cell.describe(URDF.read_text())
        wait(lambda: said.level(MODEL) != 2, 20.0)

        # an instrument that calls itself otherwise from some day on
        assert call(node, wait, "calibrator/reset").success
        cell.play(stations(24, begin=START + 2000.0))
        cell.play(seen(stations(24, seed=1, begin=START + 3000.0), frame="tracker_2"))
        wait(cell.taken, 60.0)
        wait(lambda: "frame 'tracker_2' is read in place of tracker" in changes[-1].sentence, 20.0)
        assert "frame 'tracker_2' is read beside tracker" in calibrator.output
        answer = solve()
        assert answer.success
        assert "Frames tracker and tracker_2 have the same coordinates" in answer.message
        assert answer.message.endswith("seen by tracker, tracker_2]")
