"""The calibrator in a real cell: topics of other names and of any quality of service, and other robots beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cells import record
from cli.recordings import URDF
from nodes.beside_a_cell import HEARING, latched, stations
from nodes.cell import BEST_EFFORT, PlayedCell, Said, call
from nodes.processes import Process, fresh_domain, listener, running
from rclpy.qos import DurabilityPolicy, QoSProfile

from modcal_nodes.io.inputs import parse_calibration

pytestmark = pytest.mark.dds


def test_any_quality_of_service_is_heard_and_a_mismatch_is_said(tmp_path: Path) -> None:
    """A description that is not latched, a tracker of best effort."""
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path, effects=False)
    volatile = QoSProfile(depth=1, durability=DurabilityPolicy.VOLATILE)
    with running(calibrator), listener(domain) as (node, wait):
        said = Said(node)
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


def test_two_publishers_of_one_arms_joints_are_said(tmp_path: Path) -> None:
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path, effects=False)
    with running(calibrator), listener(domain) as (node, wait):
        said, cells = Said(node), (PlayedCell(node), PlayedCell(node))
        wait(cells[0].heard, 60.0)
        wait(lambda: "/joint_states: 2 publishers at once" in said.text(HEARING), 30.0)
        assert said.level(HEARING) >= 1
        assert calibrator.stop() == 0


def test_topics_are_remapped(tmp_path: Path) -> None:
    domain = fresh_domain()
    topics = ("joint_states", "tracker/pose", "robot_description")
    remapped = [word for topic in topics for word in ("-r", f"{topic}:=/hall_3/{topic}")]
    calibrator = Process("calibrator", domain, tmp_path, *remapped, effects=False)
    with running(calibrator), listener(domain) as (node, wait):
        cell = PlayedCell(node, "/hall_3")
        wait(cell.heard, 60.0)
        cell.describe(URDF.read_text())
        cell.play(stations())
        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        assert calibrator.stop() == 0


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
        texts = [latched(node, f"/{side}/calibrator/calibration") for side in sides]
        for side in sides:
            assert call(node, wait, f"/{side}/calibrator/solve").success
        wait(lambda: all(texts), 20.0)
        assert [process.stop() for process in nodes] == [0, 0]
    models = [parse_calibration(text[-1], side) for text, side in zip(texts, sides, strict=True)]
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 6))
    for seed, model in enumerate(models):
        truth = record(21 + seed, 2).world.tool_in_tracker(q)
        assert np.abs(model.calibrated.predict(q)[:, :3, 3] - truth[:, :3, 3]).max() < 3e-4
        other = record(21 + 1 - seed, 2).world.tool_in_tracker(q)
        assert np.abs(model.calibrated.predict(q)[:, :3, 3] - other[:, :3, 3]).max() > 1e-2
