"""``calibrator``: collects what the cell says and, when asked, calibrates the arm from it."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

from modcal_core.errors import BadRobot, ModcalError
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import Recording
from modcal_core.prepare import prepare
from modcal_core.report.report import Report
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_msgs_py.messages import RecordingBuilder
from modcal_msgs_py.topics import TYPES
from modcal_nodes.files import read_cell, write_folder
from modcal_nodes.parameters import CALIBRATOR, declare, values
from modcal_nodes.results import calibration_files
from modcal_nodes.running import ANY_RELIABILITY, LATCHED, run

_HEARD = {
    "joint_states": JointState,
    "tracker/pose": PoseStamped,
    "tracker/point": PointStamped,
    "temperature": Temperature,
}


class Calibrator(Node):
    """Hears the cell; ``~/solve`` calibrates, ``~/reset`` forgets. The last result is on latched topics."""

    def __init__(self) -> None:
        super().__init__("calibrator")
        declare(self, CALIBRATOR)
        self._lock = threading.Lock()
        self._solving = threading.Lock()
        self._builder = RecordingBuilder("live")
        self._description = self.get_parameter("robot_description").value
        self._last = "nothing solved yet"
        self._residual = self.create_publisher(Float64, "~/residual", LATCHED)
        self._report = self.create_publisher(String, "~/report", LATCHED)
        self._corrected = self.create_publisher(String, "~/robot_description", LATCHED)
        self._health = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        for topic, kind in _HEARD.items():
            self.create_subscription(kind, topic, partial(self._hear, topic), ANY_RELIABILITY)
        self.create_subscription(String, "robot_description", self._take_description, LATCHED)
        # a group of its own: while a solve is awaited, its group takes no other callback
        self.create_service(Trigger, "~/solve", self._solve, callback_group=ReentrantCallbackGroup())
        self.create_service(Trigger, "~/reset", self._reset)
        self.create_timer(1.0, self._diagnose)

    def _hear(self, topic: str, message: Any) -> None:
        received = 1e-9 * self.get_clock().now().nanoseconds
        try:
            with self._lock:
                self._builder.add(f"/{topic}", TYPES[topic], message, received)
        except ModcalError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=5.0)

    def _take_description(self, message: String) -> None:
        if not self.get_parameter("robot_description").value:
            self._description = message.data

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            self._builder = RecordingBuilder("live")
        response.success, response.message = True, "recording forgotten"
        return response

    async def _solve(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Solve beside the callbacks, which go on; answer when done."""
        if not self._solving.acquire(blocking=False):
            response.success, response.message = False, "a solve is running already"
            return response
        try:
            done: Future = Future(executor=self.executor)
            threading.Thread(target=self._work, args=(done,), daemon=True).start()
            response.success, response.message = await done
        finally:
            self._solving.release()
        return response

    def _work(self, done: Future) -> None:
        try:
            done.set_result((True, self._calibrate()))
        except ModcalError as error:
            self._last = str(error)
            done.set_result((False, str(error)))
        except Exception as error:  # a fault of ours must not leave the caller waiting
            self.get_logger().error(f"solve failed: {error!r}")
            done.set_result((False, f"internal error: {error!r}"))

    def _calibrate(self) -> str:
        """Calibrate from what was heard so far, publish the result and write its files; returns the verdict."""
        chosen = values(self, CALIBRATOR)
        with self._lock:
            recording = self._builder.recording()
        if not self._description:
            raise BadRobot("robot_description", "not heard yet", "publish it (latched), or set the parameter")
        recording = replace(recording, robot_description=self._description)
        chain = read_chain(self._description, chosen["base"] or None, chosen["tip"] or None, _joints_of(recording))
        prepared = prepare(recording, chain, clock_limit=chosen["clock_limit_s"])
        cell = read_cell(Path(chosen["cell"]) if chosen["cell"] else None, tuple(f for f in chosen["fixed"] if f))
        rng, inertias = np.random.default_rng(chosen["seed"]), read_inertias(self._description, chain)
        result = calibrate(prepared.samples, chain, rng, cell, inertias=inertias)
        report = replace(result.report, title="live", notes=(*result.report.notes, *prepared.notes))
        files = calibration_files(result, report, chain, self._description)
        if chosen["out"]:
            write_folder(Path(chosen["out"]), files)
        self._publish(report, files)
        self._last = report.verdict
        return report.verdict

    def _publish(self, report: Report, files: dict[str, str]) -> None:
        size = report.size_mm("final")
        if size is not None and np.isfinite(size.rms):
            self._residual.publish(Float64(data=float(1e-3 * size.rms)))
        self._report.publish(String(data=files["report.json"]))
        self._corrected.publish(String(data=files["calibrated.urdf"]))

    def _diagnose(self) -> None:
        with self._lock:
            counts = self._builder.counts()
        silent = [name for name, count in counts.items() if count == 0] + ([] if len(counts) > 1 else ["tracker"])
        status = DiagnosticStatus(name=f"{self.get_fully_qualified_name()}: recording", hardware_id="modcal")
        status.level = DiagnosticStatus.WARN if silent else DiagnosticStatus.OK
        status.message = f"nothing heard of {', '.join(silent)}" if silent else self._last
        status.values = [KeyValue(key=f"messages of {name}", value=str(count)) for name, count in counts.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._health.publish(message)


def _joints_of(recording: Recording) -> frozenset[str]:
    return frozenset(name for track in recording.joints for name in track.names)


def main() -> None:
    """Entry point of the executable."""
    run(Calibrator)
