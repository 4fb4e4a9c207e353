"""An arm measures itself: nothing moves before a dry run was accepted, it stops when asked, and goes on where it was."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from measuring.shaped import with_spheres
from modcal_interfaces.action import Measure
from nodes.processes import ROOT, Goal, Process, ask, fresh_domain, listener, running
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from modcal_core.robots.urdf import read_chain

URDF = ROOT / "examples" / "robots" / "ur10.urdf"
MIDDLE, HALF = np.array([0.0, -1.2, 1.2, -0.5, 0.6, 0.3]), 0.35  # rad


def stations(folder: Path) -> list[dict[str, Any]]:
    file = folder / "session.yaml"
    return list(yaml.safe_load(file.read_text())["stations"]) if file.exists() else []


def measured(folder: Path) -> list[dict[str, Any]]:
    return [s for s in stations(folder) if s["state"] == "measured"]


@pytest.mark.dds
def test_an_arm_measures_itself_until_the_goal_is_proven(tmp_path: Path) -> None:
    """From launch to the end, killed once in between. The arm's own time cannot be hurried: some twenty stations, a
    second each."""
    names = read_chain(URDF.read_text()).names
    limits = {n: [float(m - HALF), float(m + HALF)] for n, m in zip(names, MIDDLE, strict=True)}
    (tmp_path / "site.yaml").write_text(yaml.safe_dump({"limits": limits}))
    shaped = tmp_path / "shaped.urdf"
    shaped.write_text(with_spheres(URDF.read_text()))
    domain, out = fresh_domain(), tmp_path / "out"
    cell = Process("simulated_cell", domain, tmp_path, urdf=shaped, joint_rate_hz=100.0, tracker_rate_hz=100.0)
    asked: dict[str, Any] = {
        "out": out, "site": tmp_path / "site.yaml", "goal_mm": 2.0, "speed_rad_s": 3.0, "settle_s": 0.05,
        "readings": 5, "geometry_only": True,
        # a busy machine holds up the cell for seconds, which would rightly hold the arm; tests of the runner have that
        "timeout_s": 10.0, "tracking_rad": 1.0, "patience_s": 60.0,
    }  # fmt: skip
    remap = ("-r", "~/joint_trajectory:=joint_trajectory")
    with running(cell), listener(domain) as (node, wait):
        sent: list[JointTrajectory] = []
        joints: list[JointState] = []
        node.create_subscription(JointTrajectory, "joint_trajectory", sent.append, 10)
        node.create_subscription(JointState, "joint_states", joints.append, 10)
        # the arm stands outside the site's limits at first: it is brought to the middle by hand
        mover = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
        wait(lambda: mover.get_subscription_count() >= 2 and joints, 60.0)
        mover.publish(to_middle(names))
        wait(lambda: np.abs(np.array(joints[-1].position) - MIDDLE).max() < 1e-6, 30.0)
        sent.clear()
        runner = Process("station_runner", domain, tmp_path, *remap, **asked)
        with running(runner):
            wait(lambda: "dry run:" in runner.output, 60.0)
            refused = ask(node, wait, Trigger, "station_runner/start")
            assert not refused.success
            assert "nobody has looked at the dry run" in refused.message
            dry = ask(node, wait, Trigger, "station_runner/dry_run")
            assert dry.success
            assert "the shapes of the description" in dry.message
            assert "Nothing has moved" in dry.message
            assert not sent
            assert np.abs(np.array(joints[-1].position) - MIDDLE).max() < 1e-6

            goal = Goal(node, wait, Measure, "station_runner/measure")
            wait(lambda: sent and goal.heard, 20.0)
            assert goal.cancel()
            status, result = goal.result()
            assert (status, result.outcome) == (GoalStatus.STATUS_CANCELED, Measure.Result.CANCELLED)
            assert "held" in result.message
            wait(lambda: len(sent[-1].points) == 1, 5.0)  # where the arm was, and no more
            stood = np.array(joints[-1].position)
            count = len(sent)
            heard = len(joints)
            wait(lambda: len(joints) > heard + 50, 10.0)
            assert len(sent) == count
            assert np.abs(np.array(joints[-1].position) - stood).max() < 0.2

            assert ask(node, wait, Trigger, "station_runner/start").success
            wait(lambda: len(measured(out)) >= 3, 60.0)
            runner.stop(signal.SIGKILL)
        before = measured(out)
        again = Process("station_runner", domain, tmp_path, *remap, **asked, yes=True)
        with running(again):
            wait(lambda: len(measured(out)) > len(before), 60.0)  # it begins by itself
            assert ask(node, wait, Trigger, "station_runner/stop").success
            goal = Goal(node, wait, Measure, "station_runner/measure")
            status, ended = goal.result(120.0)
            wait(lambda: (out / "measure.json").exists(), 20.0)
            again.stop()
        assert (status, ended.outcome) == (GoalStatus.STATUS_SUCCEEDED, Measure.Result.REACHED), ended.message
        assert 0.0 < ended.proven_m <= 2e-3
        assert len(before) <= goal.heard[0].stations <= goal.heard[-1].stations <= ended.stations
        assert f"{len(before)} stations measured before" in again.output
    after = measured(out)
    assert after[: len(before)] == before
    postures = np.array([s["asked"] for s in after])
    assert len(np.unique(postures.round(9), axis=0)) == len(after)
    result = json.loads((out / "measure.json").read_text())
    assert result["ending"] == "proven"
    assert result["proof"]["at_most_mm"] <= 2.0
    assert {"calibration.yaml", "calibrated.urdf", "report.json", "stations.csv"} <= {p.name for p in out.iterdir()}


@pytest.mark.dds
def test_an_arm_is_held_when_another_moves_it_when_the_node_rests_and_when_it_falls_silent(tmp_path: Path) -> None:
    """Each while it moves, and each time it waits to be started again."""
    names = read_chain(URDF.read_text()).names
    limits = {n: [float(m - HALF), float(m + HALF)] for n, m in zip(names, MIDDLE, strict=True)}
    (tmp_path / "site.yaml").write_text(yaml.safe_dump({"limits": limits}))
    shaped = tmp_path / "shaped.urdf"
    shaped.write_text(with_spheres(URDF.read_text()))
    domain = fresh_domain()
    cell = Process("simulated_cell", domain, tmp_path, urdf=shaped, joint_rate_hz=100.0, tracker_rate_hz=100.0)
    runner = Process(
        "station_runner", domain, tmp_path, "-r", "~/joint_trajectory:=joint_trajectory",
        out=tmp_path / "out", site=tmp_path / "site.yaml", speed_rad_s=0.1, geometry_only=True,
        timeout_s=10.0, tracking_rad=1.0, patience_s=60.0,  # as above: a busy machine holds up the cell for seconds
    )  # fmt: skip
    with running(cell), listener(domain) as (node, wait), running(runner):
        sent: list[JointTrajectory] = []
        joints: list[JointState] = []
        node.create_subscription(JointTrajectory, "joint_trajectory", sent.append, 10)
        node.create_subscription(JointState, "joint_states", joints.append, 10)
        mover = node.create_publisher(JointTrajectory, "joint_trajectory", 10)

        def stand(q: np.ndarray) -> None:
            wait(lambda: mover.get_subscription_count() >= 2 and joints, 60.0)
            mover.publish(to(names, q))
            wait(lambda: np.abs(np.array(joints[-1].position) - q).max() < 1e-6, 30.0)
            sent.clear()

        def begin() -> None:
            assert ask(node, wait, Trigger, "station_runner/start").success
            wait(lambda: any(len(m.points) > 1 for m in sent), 30.0)

        def held(said: str) -> None:
            wait(lambda: said in runner.output and sent and len(sent[-1].points) == 1, 60.0)
            again = len(sent)
            heard = len(joints)
            wait(lambda: len(joints) > heard + 50, 30.0)
            assert len(sent) == again

        def change(transition: int) -> None:
            request = ChangeState.Request(transition=Transition(id=transition))
            assert ask(node, wait, ChangeState, "station_runner/change_state", request).success

        stand(MIDDLE)
        wait(lambda: "dry run:" in runner.output, 60.0)
        assert ask(node, wait, Trigger, "station_runner/dry_run").success
        begin()
        second = ask(node, wait, Trigger, "station_runner/start")
        assert not second.success
        assert "it is measuring already" in second.message

        mover.publish(to(names, MIDDLE + 1.5 * np.eye(6)[0]))  # somebody takes the arm elsewhere
        held("from its way")
        stand(MIDDLE)

        begin()
        change(Transition.TRANSITION_DEACTIVATE)
        held("held: deactivated")
        assert "activate it first" in ask(node, wait, Trigger, "station_runner/start").message
        dry = runner.output.count("dry run:")
        change(Transition.TRANSITION_ACTIVATE)
        wait(lambda: runner.output.count("dry run:") > dry, 60.0)
        refused = ask(node, wait, Trigger, "station_runner/start")
        assert not refused.success
        assert "nobody has looked at the dry run" in refused.message

        assert ask(node, wait, Trigger, "station_runner/dry_run").success
        sent.clear()
        begin()
        cell.popen.send_signal(signal.SIGSTOP)
        try:
            wait(lambda: "joint states are older than 10 s" in runner.output and len(sent[-1].points) == 1, 60.0)
        finally:
            cell.popen.send_signal(signal.SIGCONT)
        count = len(joints)
        wait(lambda: len(joints) > count + 50, 30.0)
        sent.clear()
        begin()  # and it goes on once it is asked to
        assert all(s["state"] != "skipped" for s in stations(tmp_path / "out"))


def to_middle(names: tuple[str, ...]) -> JointTrajectory:
    return to(names, MIDDLE)


def to(names: tuple[str, ...], q: np.ndarray) -> JointTrajectory:
    from trajectory_msgs.msg import JointTrajectoryPoint

    point = JointTrajectoryPoint(positions=q.tolist())
    point.time_from_start.sec = 1
    return JointTrajectory(joint_names=list(names), points=[point])
