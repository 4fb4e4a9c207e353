"""The calibrator with corners: images of a target and joint states over DDS to a calibrated arm, and a kicked tripod."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera.boards import views
from camera.fits import MEASURED
from camera.scenes import PANDA, CameraScene, scene
from camera.test_several_cameras import OTHER_LENS, looking
from modcal_interfaces.msg import Change
from nodes.beside_a_cell import latched
from nodes.cell import call
from nodes.processes import Process, Wait, fresh_domain, listener, running
from nodes.talking import LATCHED, Diagnostics
from rclpy.node import Node
from sensor_msgs.msg import JointState, PointCloud2, PointField
from std_msgs.msg import Bool, String

from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_msgs_py.images import fill_corners
from modcal_msgs_py.readings import set_seconds

pytestmark = pytest.mark.dds
STATUS = "/calibrator: camera"
TARGET = {
    "modcal_target": 1, "type": "charuco", "columns": 7, "rows": 5, "square_m": 0.03, "marker_m": 0.022,
    "dictionary": "DICT_5X5_100",
    "rulers": {"x_m": 0.21, "y_m": 0.15, "measured_x_m": 0.21, "measured_y_m": 0.15, "measured_std_m": 3e-4},
}  # fmt: skip


PACE = 0.005  # s between messages: who hears in best effort loses some of a burst


class Cell:
    """An arm and a camera that a test plays: it stands at a posture, and one image of it is looked at."""

    def __init__(self, node: Node, wait: Wait, s: CameraScene) -> None:
        self.node, self.wait, self.scene = node, wait, s
        self.states = node.create_publisher(JointState, "joint_states", 100)
        self.corners = node.create_publisher(PointCloud2, "corners", 100)
        self.second = node.create_publisher(PointCloud2, "second/corners", 100)
        self.description = node.create_publisher(String, "robot_description", LATCHED)
        self.health = Diagnostics(node)
        self.stamp = 1000.0
        self.description.publish(String(data=PANDA.read_text()))

    def stop_at(self, q: Array, T: Array, seed: int, by_second: Array) -> None:
        """Joint states of a second, and the corners of an image of either camera in its middle.

        T, by_second: poses (4, 4) of the board, seen from the cameras.
        """
        s = self.scene
        (seen,) = views(np.random.default_rng(seed), T[None], board=s.board)
        (other,) = views(np.random.default_rng([seed, 1]), by_second[None], lens=OTHER_LENS, board=s.board)
        for k in range(11):
            message = JointState(name=list(s.chain.names), position=q.tolist())
            set_seconds(message.header.stamp, self.stamp + 0.05 * k)
            self.states.publish(message)
            time.sleep(PACE)
            if k == 5:
                view = replace(seen, stamp=self.stamp + 0.25)
                self.corners.publish(fill_corners(PointCloud2(), PointField, view, s.lens.size, "camera"))
                if len(other):
                    view = replace(other, stamp=self.stamp + 0.26)
                    self.second.publish(fill_corners(PointCloud2(), PointField, view, OTHER_LENS.size, "second"))
                time.sleep(PACE)
        self.stamp += 1.0

    @property
    def images(self) -> int:
        return int(self.health.value(STATUS, "images") or 0)


def test_corners_of_two_cameras_to_a_calibrated_arm_and_a_kicked_tripod(tmp_path: Path) -> None:
    """A process solves as a user has it solve, which takes its seconds; another one goes on where it was.

    Both cameras are in one calibration, each with a lens file of its own; of the two tripods the kicked one is named.
    """
    s = scene(61, False, count=20, board=MEASURED)
    (tmp_path / "target.yaml").write_text(to_yaml(TARGET))
    domain = fresh_domain()
    options = {"target": tmp_path / "target.yaml", "tip": "panda_link8", "effects": False, "out": tmp_path / "out"}
    options |= {"state": tmp_path / "state", "also_corners": ["second/corners"]}
    from_second = se3.inverse(looking())
    process = Process("calibrator", domain, tmp_path, **options)
    with running(process), listener(domain) as (node, wait):
        cell = Cell(node, wait, s)
        trusted, models, changes = (
            latched(node, f"calibrator/{topic}", kind)
            for topic, kind in (("trusted", Bool), ("robot_description", String), ("change", Change))
        )
        publishers = (cell.states, cell.corners, cell.second, cell.description)
        wait(lambda: all(one.get_subscription_count() for one in publishers), 60.0)
        wait(lambda: trusted, 60.0)

        def stop_at(i: int, seed: int, kick: Array | None = None) -> None:
            seen = from_second @ s.T[i]
            cell.stop_at(s.q[i], s.T[i], seed, seen if kick is None else kick @ seen)

        def refusal() -> str:
            stop_at(0, 0)  # by which it knows the arm, once it has the description
            answer = call(node, wait, "calibrator/solve")
            assert not answer.success
            return "" if "not received yet" in answer.message else answer.message

        assert "at least 8 are needed" in wait(refusal, 60.0)
        for i in range(len(s.q)):
            stop_at(i, i)
        stop_at(0, 0)  # whose joint states come after the last image
        wait(lambda: cell.images >= len(s.q), 60.0)
        solved = call(node, wait, "calibrator/solve")
        assert solved.success, solved.message
        assert solved.message.startswith("Apply."), solved.message
        wait(lambda: models and trusted[-1], 60.0)
        report = json.loads((tmp_path / "out" / "report.json").read_text())
        assert report["camera"]["mounting"] == "world"
        assert report["camera"]["tool_error_mm"]["in_view"]["calibrated"]["high95"] < 5.0
        (further,) = report["camera"]["further"]
        assert further["name"] == "second/corners"
        assert further["lens"]["fx"]["value"] == pytest.approx(OTHER_LENS.values[0], rel=0.02)
        assert (tmp_path / "out" / "camera_2.yaml").exists()
        # after a restart the same images give the same model, and what comes is held against it
        assert process.stop() == 0
        models.clear()
        trusted.clear()
        again = Process("calibrator", domain, tmp_path, **options)
        with running(again):
            wait(lambda: all(one.get_subscription_count() for one in publishers), 60.0)

            def restored() -> bool:
                stop_at(0, 0)
                return bool(models and trusted and trusted[-1])

            wait(restored, 60.0)
            # a tripod is kicked by 5 mm: named within six images
            for i in range(6):
                stop_at(i, 100 + i, se3.exp([0.0, 5e-3, 0.0, 0.0, 0.0, 0.0]))
            wait(lambda: any(change.changed for change in changes), 15.0)
            said = next(change for change in changes if change.changed)
            assert said.place == "camera second/corners"
            assert said.size_m == pytest.approx(5e-3, rel=0.5)
            wait(lambda: not trusted[-1], 60.0)
            assert again.stop() == 0
