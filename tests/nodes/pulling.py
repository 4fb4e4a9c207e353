"""A pull through the real nodes: furniture in MuJoCo, articulation_estimator and impedance_setpoint, each a process."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nodes.plain_pulls import Pull
from nodes.polling import Polled
from nodes.processes import ROOT, Process, Wait, ask, fresh_domain, listener, running
from nodes.talking import RELIABLE, Diagnostics
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectoryPoint

from modcal_core.geometry.so3 import Array
from modcal_msgs_py.readings import seconds
from modcal_nodes.simulation.furniture import Furniture

PANDA = ROOT / "examples" / "robots" / "panda.urdf"
WORLD, ESTIMATOR, SETPOINT = "simulated_furniture", "articulation_estimator", "impedance_setpoint"
PULL = f"/{SETPOINT}: pull"


@dataclass
class Told:
    """What the world and the setpoints said, with the world's own time [s]."""

    forces: list[tuple[float, float]] = field(default_factory=list)
    opened: list[tuple[float, float]] = field(default_factory=list)
    setpoints: list[float] = field(default_factory=list)

    def listen(self, node: Node) -> None:
        polled = Polled(node)
        polled.subscribe(WrenchStamped, f"{WORLD}/contact_force", self._force, RELIABLE.depth)
        polled.subscribe(JointState, f"{WORLD}/object_truth", self._truth, RELIABLE.depth)
        polled.subscribe(JointTrajectoryPoint, "joint_references", self._setpoint, RELIABLE.depth)

    def _force(self, message: WrenchStamped) -> None:
        f = message.wrench.force
        self.forces.append((seconds(message.header.stamp), float(np.linalg.norm([f.x, f.y, f.z]))))

    def _truth(self, message: JointState) -> None:
        self.opened.append((seconds(message.header.stamp), float(message.position[0])))

    def _setpoint(self, _: JointTrajectoryPoint) -> None:
        # it bears no stamp
        self.setpoints.append(self.forces[-1][0] if self.forces else 0.0)


def _since(begun: float, series: list[tuple[float, float]]) -> Array:
    return np.array([(t - begun, value) for t, value in series if t >= begun]).reshape(-1, 2)


@dataclass(frozen=True)
class Opening:
    """A pull, and how it went: forces and opened (n, 2), times [s] and values [N; rad or m]."""

    pull: Pull
    forces: Array
    opened: Array
    seconds: float
    gap: float  # s, the longest between two setpoints
    by_efforts: tuple[str, ...] = ()  # force that the joints' efforts showed, as diagnostics said it


def change(node: Node, wait: Wait, name: str, transition: int) -> None:
    request = ChangeState.Request(transition=Transition(id=transition))
    answer = ask(node, wait, ChangeState, f"{name}/change_state", request)
    assert answer.success, f"{name}: transition {transition} failed"


def followers(
    folder: Path, domain: int, scene: Furniture, world: dict[str, Any], setpoint: dict[str, Any]
) -> tuple[Process, Process]:
    """The two nodes beside the world, connected by remapping alone."""

    def remap(**names: str) -> list[str]:
        return [word for old, new in names.items() for word in ("-r", f"{old}:={new}")]

    paced = {"use_sim_time": bool(world.get("publish_clock"))}
    heard = {f"object_{what}": f"{ESTIMATOR}/object_{what}" for what in ("description", "state", "status")}
    return (
        Process(ESTIMATOR, domain, folder, tool_mass=scene.tool_mass, **paced),
        Process(
            SETPOINT,
            domain,
            folder,
            *remap(**heard),
            "-r",
            "~/joint_references:=joint_references",
            tool_mass=scene.tool_mass,
            tool_centre=[float(x) for x in scene.tool_com],
            **paced,
            **setpoint,
        ),
    )


def open_it(
    folder: Path, scene: Furniture, world: dict[str, Any], patience: float = 60.0, share: float = 1.0, **setpoint: Any
) -> Opening:
    """Pull at the object of a scene, which ``world`` (parameters of the world) must draw, until setpoints end.

    share: of the scene's goal, how far it is to be opened.
    """
    domain = fresh_domain()
    goal = share * float(scene.goal)
    made = followers(folder, domain, scene, world, {"goal": goal, **setpoint})
    with contextlib.ExitStack() as until_over:
        until_over.enter_context(running(*made))
        node, wait = until_over.enter_context(listener(domain))
        told, health = Told(), Diagnostics(node)
        told.listen(node)
        change(node, wait, SETPOINT, Transition.TRANSITION_CONFIGURE)
        change(node, wait, SETPOINT, Transition.TRANSITION_ACTIVATE)
        # last: from here on hundreds of messages a second wake everybody
        scenery = Process(WORLD, domain, folder, urdf=PANDA, **world)
        until_over.enter_context(running(scenery))
        wait(lambda: told.forces and told.opened, 30.0)
        until_heard(node, wait)
        held = told.forces[0][0] + 1.1 * float(world.get("approach_s", 0.0)) + 0.5
        wait(lambda: told.forces[-1][0] > held, 60.0)
        if "approach_s" in world:  # how it came to the handle says nothing of the object
            ask(node, wait, Trigger, f"{ESTIMATOR}/reset", Trigger.Request())
        begun, by_efforts = told.forces[-1][0], [""]
        begin(node, wait)
        wait(lambda: health.value(PULL, "phase"), 30.0)
        try:
            wait(lambda: _ended(health, by_efforts), patience)
            said = health.last[PULL].message
        except AssertionError:
            said = f"no end within {patience:g} s: {health.last[PULL].message}"
        # the truth of that moment may have to be heard yet
        over = health.at[PULL]
        wait(lambda: min(told.forces[-1][0], told.opened[-1][0]) >= over, 30.0)
        ended = told.forces[-1][0]
        for process in (scenery, *made):
            process.stop()
    forces, opened = _since(begun, told.forces), _since(begun, told.opened)
    moving = [t for t in told.setpoints if t >= begun]
    # a message holds the largest force since the one before, so this mean is never too small; while the tool is tared
    # nothing pulls
    pulled = forces[forces[:, 0] >= (moving[0] - begun if moving else 0.0), 1]
    pull = Pull(float(forces[:, 1].max()), float(pulled.mean()), float(opened[:, 1].max()), goal, said)
    return Opening(pull, forces, opened, ended - begun, float(np.diff(moving).max(initial=0.0)), tuple(by_efforts[1:]))


def _ended(health: Diagnostics, by_efforts: list[str]) -> bool:
    """Whether the pull is over; what its efforts show is noted whenever it is new."""
    said = health.value(PULL, "force by joint efforts N")
    if said and said != by_efforts[-1]:
        by_efforts.append(said)
    return not health.value(PULL, "phase")


def begin(node: Node, wait: Wait) -> None:
    """Ask for a pull until it begins: at first the arm may not be known yet."""
    for _ in range(20):
        answer = ask(node, wait, Trigger, f"{SETPOINT}/pull", Trigger.Request())
        if answer.success:
            return
        with contextlib.suppress(AssertionError):
            wait(lambda: False, 0.5)
    raise AssertionError(answer.message)


def until_heard(node: Node, wait: Wait) -> None:
    """Wait until everybody has found whom to talk to: what is said before is lost."""
    for topic, listeners in (("joint_references", 2), ("joint_states", 2), ("wrench", 1)):
        wait(lambda topic=topic, least=listeners: node.count_subscribers(topic) >= least, 30.0)
        wait(lambda topic=topic: node.count_publishers(topic) == 1, 30.0)
