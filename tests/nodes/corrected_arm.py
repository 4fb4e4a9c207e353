"""An arm at the other end of the corrector's topics: it says where its joints are and hears what it is told."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from correction.test_compensation import calibration_of, true_model
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from modcal_interfaces.msg import Calibration as CalibrationMessage
from nodes.processes import ROOT, Wait
from nodes.talking import LATCHED, Diagnostics
from rcl_interfaces.msg import Parameter
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from modcal_core.calibration.store import Calibration, to_data
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.files import to_yaml
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.commands import fill_pose
from modcal_msgs_py.readings import set_seconds
from modcal_msgs_py.typed import fill_calibration

URDF = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()
CHAIN = read_chain(URDF)
WARN = DiagnosticStatus.WARN
AWAY = np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.2])  # from anything singular
GEAR = Effect("gear_harmonic", "elbow_joint", AXIS, "position:elbow_joint", Shape("sine", {"cycles": 101.0}))


def calibration(seed: int = 0, *effects: Effect, chain: Chain = CHAIN) -> Calibration:
    """A calibration of the UR10, or of another arm, as if truth had been found."""
    shown = effects or (GEAR.started(np.array([2e-4, 1e-4])),)
    return calibration_of(true_model(*shown, chain=chain, seed=seed), chain)


def text(made: Calibration) -> str:
    return to_yaml(to_data(made))


def message(made: Calibration) -> CalibrationMessage:
    """As the calibrator publishes it."""
    return fill_calibration(CalibrationMessage(), Parameter, to_data(made))


def written(made: Calibration, folder: Path) -> Path:
    """The path of a calibration's file."""
    file = folder / "calibration.yaml"
    file.write_text(text(made))
    return file


class Arm:
    """Publishes joint states and the description under a namespace, and keeps what the corrector says there."""

    def __init__(self, node: Node, space: str = "", q: Array = AWAY, rate: float = 50.0, urdf: str = URDF) -> None:
        self.node, self.q, self.names = node, np.array(q), list(CHAIN.names)
        self.silent = False
        self._tried = -1.0
        self.reshape: Callable[[JointState], list[JointState]] = lambda message: [message]
        self.poses: list[PoseWithCovarianceStamped] = []
        self.states: list[JointState] = []
        self.commands: list[JointTrajectory] = []
        self.urdfs: list[str] = []
        self.who = f"{space}/corrector"
        self.health = Diagnostics(node, self.who)
        self.joints = node.create_publisher(JointState, f"{space}/joint_states", 10)
        self.description = node.create_publisher(String, f"{space}/robot_description", LATCHED)
        self.desired = node.create_publisher(PoseStamped, f"{space}/desired_pose", 10)
        self.calibration = node.create_publisher(CalibrationMessage, f"{space}/calibration", LATCHED)
        for kind, topic, kept in (
            (PoseWithCovarianceStamped, "pose", self.poses),
            (JointState, "joint_states", self.states),
            (JointTrajectory, "joint_trajectory", self.commands),
        ):
            node.create_subscription(kind, f"{self.who}/{topic}", kept.append, 1000)
        node.create_subscription(String, f"{self.who}/robot_description", lambda m: self.urdfs.append(m.data), LATCHED)
        self.timer = node.create_timer(1.0 / rate, self.speak)
        if urdf:
            self.description.publish(String(data=urdf))

    def now(self) -> float:
        return 1e-9 * self.node.get_clock().now().nanoseconds

    def state(self, stamp: float | None = None) -> JointState:
        message = JointState(name=self.names, position=[float(x) for x in self.q])
        set_seconds(message.header.stamp, self.now() if stamp is None else stamp)
        return message

    def speak(self) -> None:
        if not self.silent:
            for message in self.reshape(self.state()):
                self.joints.publish(message)

    def wish(self, T: Array, frame: str = "", stamp: float | None = None) -> PoseStamped:
        """A desired pose; stamp: now unless given."""
        message = PoseStamped()
        fill_pose(message.pose, T)
        message.header.frame_id = frame
        set_seconds(message.header.stamp, self.now() if stamp is None else stamp)
        return message

    def connected(self) -> bool:
        """Whether corrected poses come and wishes are heard."""
        return bool(self.poses) and self.heard()

    def heard(self) -> bool:
        """Whether wishes arrive. One that comes before both sides know of each other is lost, so one is tried."""
        if int(self.facts("commands").get("refused", 0)) > 0:
            return True
        if time.monotonic() - self._tried > 1.0 and self.desired.get_subscription_count():
            self._tried = time.monotonic()
            self.desired.publish(self.wish(np.eye(4), "somewhere unknown"))
        return False

    def ask(self, wait: Wait, wish: Callable[[], PoseStamped]) -> JointTrajectory:
        """The command for a wish, which is made and sent again where nothing comes of it."""
        count = len(self.commands)
        for _ in range(10):
            self.desired.publish(wish())
            with contextlib.suppress(AssertionError):
                wait(lambda: len(self.commands) > count, 3.0)
                return self.commands[-1]
        raise AssertionError(f"no command: {self.health['commands'].message}")

    def refuse(self, wait: Wait, wish: Callable[[], PoseStamped], said: str) -> None:
        """The wish is counted as refused, the reason said, and no command comes of it."""
        before, commands = int(self.facts("commands").get("refused", 0)), len(self.commands)

        def refused() -> bool:
            told = self.health["commands"]
            return (
                int(self.facts("commands").get("refused", 0)) > before and said in told.message and told.level == WARN
            )

        for _ in range(5):
            self.desired.publish(wish())
            try:
                wait(refused, 5.0)
            except AssertionError:
                continue
            assert len(self.commands) == commands
            return
        raise AssertionError(f"'{said}' was not said: {self.health['commands'].message}")

    def facts(self, part: str) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.health[part].values}


def matrix(message: Any) -> Array:
    """The pose (4, 4) of a Pose."""
    p, o = message.position, message.orientation
    return se3.from_pose([p.x, p.y, p.z, o.x, o.y, o.z, o.w])


def truth(made: Any, q: Array, target: str = "tip", frame: str = "") -> Array:
    """Where a calibration has the tool of an arm at rest at joints q."""
    return Correction(made).pose(np.asarray(q), ArmState.at_rest(q, 1.7e9), target, frame)  # type: ignore[arg-type]


def near(T: Array, metres: float, turn: float = 0.0) -> Array:
    """A pose so far from T [m, rad] in each direction."""
    return T @ se3.transform(so3.exp([turn, 0.0, -turn]), [metres, -metres, metres])
