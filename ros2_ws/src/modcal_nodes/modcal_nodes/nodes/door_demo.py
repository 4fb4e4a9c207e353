"""``door_demo``: one command that opens a simulated door, or a drawer, and says how it went."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionClient
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from modcal_core.errors import BadCommand, BadTable
from modcal_msgs_py import seconds, wrench_numbers
from modcal_nodes import ros
from modcal_nodes.simulation import PullRecord

_PERIOD, _AGAIN = 0.2, 1.0  # s between two looks, and between two attempts to begin
_KINDS = ("door", "drawer")
_PACED = ("publish_clock:=true", "keep_step:=true", "clock_rate_hz:=250.0")


class DoorDemo(ros.HealthyNode):
    """Opens a simulated door or drawer by the other nodes; ends when it is over, exit code 0 if it is open."""

    executable = "door_demo"

    def __init__(self) -> None:
        super().__init__()
        self._opened, self._pulls, self._over = 0.0, False, False
        self._record = PullRecord()
        self._begun = self._asked = time.monotonic()
        self._type = ros.interface("Pull")
        self._pull = ActionClient(self, self._type, "impedance_setpoint/pull")
        self.create_subscription(JointState, "simulated_furniture/object_truth", self._hear_truth, 10)
        self.create_subscription(WrenchStamped, "simulated_furniture/contact_force", self._hear_force, 10)
        self.create_subscription(String, "robot_description", lambda m: self._record.describe(m.data), ros.LATCHED)
        self.create_subscription(JointState, "joint_states", self._hear_joints, ros.FRESH)
        self._children = self._start() if self._chosen["start"] else []
        self.every(_PERIOD, self._look)

    def _check(self, new: dict[str, Any]) -> None:
        if new["kind"] not in _KINDS:
            raise BadTable(f"kind '{new['kind']}'", "is neither door nor drawer", "set one of them")

    def _report(self) -> list[ros.Status]:
        return [ros.Status("demo", ros.OK, "pulls" if self._pulls else "waiting for the pull to begin")]

    def _start(self) -> list[subprocess.Popen[bytes]]:
        """The other nodes, as the launch file would start them, in processes of their own."""
        try:
            share = Path(get_package_share_directory("modcal_nodes"))
        except (LookupError, OSError) as error:
            raise BadTable("package modcal_nodes", "is not found", "source install/setup.bash") from error
        beside = Path(sys.argv[0]).resolve().parent
        plan, namespace, children = ros.LAUNCHES["door_demo"], self.get_namespace(), []
        for node in plan.nodes:
            if node == "door_demo":
                continue
            words = [str(beside / node), "--ros-args", "-r", f"__ns:={namespace}"]
            words += ["--params-file", str(share / "config" / f"{node}.yaml")]
            for name, value in plan.fixed.get(node, {}).items():
                words += ["-p", f"{name}:={str(share / value) if name == 'urdf' else str(value).lower()}"]
            # a time that waits for the machine: a busy one is slower, and no limit of the control is in the way
            if node == "simulated_furniture":
                words += ["-p", f"kind:={self._chosen['kind']}", "-p", f"seed:={self._chosen['seed']}"]
                words += [word for paced in _PACED for word in ("-p", paced)]
            else:
                words += ["-p", "use_sim_time:=true"]
            for old, new in plan.remaps.get(node, ()):
                words += ["-r", f"{old}:={new}"]
            children.append(subprocess.Popen(words, stdin=subprocess.DEVNULL))
        return children

    def _hear_truth(self, message: JointState) -> None:
        self._opened = float(message.position[0])

    def _hear_force(self, message: WrenchStamped) -> None:
        self._record.feel(wrench_numbers(message)[:3])

    def _hear_joints(self, message: JointState) -> None:
        if not self._over:
            self._record.take(list(message.name), list(message.position), seconds(message.header.stamp))

    def _look(self) -> None:
        if self._over:
            unit = "rad" if self._chosen["kind"] == "door" else "m"
            said = f"{self._said}; in truth it is open by {self._opened:.3f} {unit}, "
            said += f"the handle was held with {self._record.force:.0f} N at most"
            if not self._went_well:
                raise ros.NodeEnds(
                    BadCommand(f"{self._chosen['kind']} {self._chosen['seed']}", said, "try another seed")
                )
            for line in self._learned(said):
                self.get_logger().info(line)
            raise SystemExit(0)
        now = time.monotonic()
        if now - self._begun > self._chosen["patience_s"]:
            said = f"is not open after {self._chosen['patience_s']:g} s"
            raise ros.NodeEnds(
                BadCommand(self._chosen["kind"], said, "check the nodes' output, or allow more patience_s")
            )
        if any(child.poll() is not None for child in self._children):
            raise ros.NodeEnds(BadCommand("door_demo", "one of its nodes has ended", "check its output"))
        ready = self._record.begun and self._pull.server_is_ready()
        if ready and not self._pulls and now - self._asked > _AGAIN:
            self._asked, self._pulls = now, True
            self._pull.send_goal_async(self._type.Goal()).add_done_callback(self._sent)

    def _sent(self, sent: Future) -> None:
        sent.result().get_result_async().add_done_callback(self._ended)

    def _ended(self, got: Future) -> None:
        result = got.result().result
        if result.outcome == ros.REFUSED:  # until everything has been heard
            self._pulls = False
        else:
            self._over, self._said, self._went_well = True, result.message, result.outcome == ros.DONE

    def _learned(self, outcome: str) -> tuple[str, ...]:
        """How it ended, and what was learned of the object, which a folder is left with where one is named."""
        if not self._chosen["out"]:
            return (outcome,)
        return self._record.write(f"{self._chosen['kind']} {self._chosen['seed']}", outcome, Path(self._chosen["out"]))

    def close(self) -> None:
        """End the nodes that were started."""
        for child in self._children:
            with contextlib.suppress(ProcessLookupError):
                child.send_signal(signal.SIGINT)
        for child in self._children:
            try:
                child.wait(10.0)
            except subprocess.TimeoutExpired:
                child.kill()
