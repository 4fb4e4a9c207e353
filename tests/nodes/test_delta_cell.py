"""A Delta in the simulated cell: recorded over DDS, calibrated from the bag; driven, and refused what it cannot do."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from deltas import FILE, nominal
from geometry_msgs.msg import PointStamped, PoseStamped
from nodes.processes import Process, fresh_domain, listener, running
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.robots.mechanism import passable
from modcal_nodes.cli.main import run
from modcal_nodes.simulation.delta_world import make_delta_world
from modcal_nodes.simulation.program import tour

pytestmark = pytest.mark.dds
SEED = 3


def test_recorded_over_dds_and_calibrated(tmp_path: Path) -> None:
    domain = fresh_domain()
    bag = tmp_path / "bag"
    topics = ["joint_states", "tracker/point"]
    recorder = Process("recorder", domain, tmp_path, out=bag, topics=json.dumps(topics), use_sim_time="true")
    heard: list[PointStamped] = []
    with running(recorder), listener(domain) as (node, wait):
        node.create_subscription(PointStamped, "tracker/point", heard.append, 1000)
        wait(lambda: "recording into" in recorder.output, 60.0)
        cell = Process(
            "simulated_cell", domain, tmp_path, delta=FILE, measurement="point", seed=SEED, stations=45, dwell_s=0.4,
            travel_s=0.2, start_delay_s=9.0, joint_rate_hz=100.0, tracker_rate_hz=40.0,
            publish_clock="true", clock_rate_hz=50.0, time_factor=3.0,
        )  # fmt: skip
        with running(cell):
            wait(lambda: heard and stamp(heard[-1]) - stamp(heard[0]) > 45 * 0.6, 60.0)
            assert cell.stop() == 0
        assert recorder.stop() == 0
    out = tmp_path / "out"
    assert run(["calibrate", str(bag), "--delta", str(FILE), "--out", str(out)]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["recording"]["stations"] >= 35
    assert report["error_mm"]["nominal"]["rms"] > 0.2
    assert report["error_mm"]["final"]["rms"] < 0.25 * report["error_mm"]["nominal"]["rms"]
    assert report["effects"] == []


def test_it_goes_where_it_is_sent_and_nowhere_else(tmp_path: Path) -> None:
    domain = fresh_domain()
    delta = nominal()
    cell = Process("simulated_cell", domain, tmp_path, delta=FILE, seed=SEED, noise_m=0.0, noise_rad=0.0)
    goal = [0.4, -0.2, 0.6, 1.0]
    states: list[JointState] = []
    truths: list[PoseStamped] = []
    with running(cell), listener(domain) as (node, wait):
        node.create_subscription(JointState, "joint_states", states.append, 1000)
        node.create_subscription(PoseStamped, "simulated_cell/true_tool_in_base", truths.append, 1000)
        send = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
        wait(lambda: states and send.get_subscription_count(), 60.0)
        assert list(states[0].name) == list(delta.names)
        far = trajectory(delta.names, [2.0, -0.2, 0.6, 1.0])
        # again and again: the first may come before the cell has found who speaks
        wait(lambda: send.publish(far) or "lies outside the joint limits" in cell.output, 30.0)
        send.publish(trajectory(delta.names, goal))
        wait(lambda: np.allclose(states[-1].position, goal, rtol=0.0, atol=1e-12), 30.0)
        after = stamp(states[-1])
        wait(lambda: truths and stamp(truths[-1]) > after, 30.0)
        assert cell.stop() == 0
    true = make_delta_world(delta, np.random.default_rng(SEED), 5e-4, 1e-3).tool_in_base(goal)
    at = truths[-1].pose.position
    assert np.abs(np.array([at.x, at.y, at.z]) - true[:3, 3]).max() < 1e-9


def test_a_tour_keeps_to_ways_that_its_platform_fits() -> None:
    delta = nominal()
    legs = tour(delta, 40, 0.5, 0.5, np.random.default_rng(0))
    stops = np.array([np.zeros(4), *(q for _, q in legs)])
    assert all(passable(delta, a, b) for a, b in pairwise(stops))
    assert len(np.unique(stops.round(9), axis=0)) == 41


def trajectory(names: tuple[str, ...], goal: list[float]) -> JointTrajectory:
    point = JointTrajectoryPoint(positions=goal)
    point.time_from_start.sec = 1
    return JointTrajectory(joint_names=list(names), points=[point])


def stamp(message: PointStamped | PoseStamped | JointState) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
