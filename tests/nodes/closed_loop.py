"""How near the true tool comes to where it is wanted, before and after, in a cell whose truth is MuJoCo's.

The cell records a tour, ``modcal calibrate`` calibrates, the corrector commands, the arm goes there. All poses are of the
tool in the tracker's frame: that is what is physically measured, and it leaves no freedom in what "base" means. Three
commands are compared for the same wishes, each on a pass of its own:

* *nominal*: inverse kinematics of the drawing, with base and tool fitted to the same recording;
* *corrected*: what the corrector sends;
* *floor*: found by Newton's method on MuJoCo's truth itself. No command can do better, and what is left is what the
  joints do not repeat. Nobody but the test can know it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nodes.polling import Polled
from nodes.processes import ROOT, Process, Wait, fresh_domain, listener, running
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.calibration import Calibration
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import inverse
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_msgs_py.commands import fill_pose
from modcal_msgs_py.readings import seconds, set_seconds
from modcal_nodes.cli.main import run
from modcal_nodes.simulation.mjcf import World
from modcal_nodes.simulation.plant import make_world

URDF = ROOT / "examples" / "robots" / "ur10.urdf"
CELL: dict[str, Any] = {
    "urdf": URDF,
    "joint_compliance_rad_per_nm": "[1e-5]",
    "gear_joint": "elbow_joint",
    "gear_cycles": 101.0,
    "gear_amplitude_rad": 2e-4,
    "repeatability_rad": 3e-5,
    # as slow as stations still are found at: messages are what time goes into, and each tick wakes every node
    "clock_rate_hz": 50.0,
    "joint_rate_hz": 50.0,
    "tracker_rate_hz": 25.0,
    "dwell_s": 0.75,
    "travel_s": 0.2,
}
_STATION = CELL["dwell_s"] + CELL["travel_s"]
_RANGE = 1.1  # rad, a little less than the tour goes through
_TRAVEL, _STAND = 0.2, 0.1  # s of simulated time; a stand has two readings


@dataclass(frozen=True)
class Errors:
    """Of one pass: position (N,) [m] and rotation (N,) [rad] between the true tool and the wish.

    gap: the positions' errors as vectors, (N, 3) [m], visit by visit: all poses once, then again.
    """

    position: Array
    rotation: Array
    gap: Array

    @property
    def rms_mm(self) -> float:
        """Root mean square of the position [mm]."""
        return float(1e3 * np.sqrt(np.mean(self.position**2)))

    @property
    def rms_mrad(self) -> float:
        """Root mean square of the rotation [mrad]."""
        return float(1e3 * np.sqrt(np.mean(self.rotation**2)))


@dataclass(frozen=True)
class Outcome:
    """The three passes over the same wishes, what the calibration found, and how many wishes were refused."""

    nominal: Errors
    corrected: Errors
    floor: Errors
    effects: tuple[str, ...]
    refused: int

    def repeatability_mm(self, poses: int) -> float:
        """RMS [mm] that does not repeat, from both passes: the floor's, and the corrected one's scatter at each pose.

        What the corrected pass happened to draw is then on both sides of a comparison.
        """
        by_pose = self.corrected.gap.reshape(-1, poses, 3)
        visits = len(by_pose)
        scatter = float(np.sum((by_pose - by_pose.mean(axis=0)) ** 2))
        total = scatter + float(np.sum(self.floor.gap**2))
        return 1e3 * float(np.sqrt(total / (poses * (visits - 1) + len(self.floor.gap))))

    def table(self) -> str:
        """For people."""
        rows = [f"{'command':<12}{'RMS mm':>10}{'max mm':>10}{'RMS mrad':>10}{'to floor':>10}"]
        for name in ("nominal", "corrected", "floor"):
            e: Errors = getattr(self, name)
            ratio = e.rms_mm / self.floor.rms_mm
            rows.append(f"{name:<12}{e.rms_mm:10.4f}{1e3 * e.position.max():10.4f}{e.rms_mrad:10.4f}{ratio:10.2f}")
        said = f"{len(self.floor.position)} visits of {len(self.nominal.position)} poses, {self.refused} refused; effects: {', '.join(self.effects)}"
        return "\n".join([*rows, said])


class Truth:
    """What the cell of a seed really does, repeatability aside."""

    def __init__(self, seed: int, chain: Chain) -> None:
        compliance = float(str(CELL["joint_compliance_rad_per_nm"]).strip("[]"))
        rng = np.random.default_rng(seed)
        self.world: World = make_world(chain, rng, 5e-4, 1e-3, read_inertias(URDF.read_text(), chain), compliance)
        self._gear = chain.names.index(CELL["gear_joint"])

    def tool(self, q: Array) -> Array:
        """The tool in the tracker (N, 4, 4) when the joints report q (N, n)."""
        sent = np.array(q)
        sent[:, self._gear] += CELL["gear_amplitude_rad"] * np.sin(CELL["gear_cycles"] * sent[:, self._gear])
        return self.world.tool_in_tracker(sent)

    def command(self, wish: Array, q: Array) -> Array:
        """The command (n,) that brings the tool exactly to a pose (4, 4), from one near it."""
        step = 1e-6
        for _ in range(20):
            T = self.tool(np.concatenate([q[None], q + step * np.eye(len(q))]))
            gap = se3.log(se3.inverse(T) @ wish)
            if np.abs(gap[0]).max() < 1e-10:
                return q
            q = q - np.linalg.solve((gap[1:] - gap[0]).T / step, gap[0])
        raise AssertionError("no command brings the tool there")


def close_the_loop(
    folder: Path,
    stations: int,
    wishes: int,
    visits: int,
    seed: int = 21,
    factor: float = 5.0,
    say: Callable[[str], None] = print,
) -> Outcome:
    """Record ``stations`` dwells, calibrate, and command ``wishes`` poses, each ``visits`` times, in three ways.

    What a joint does not repeat is drawn anew at each arrival: of one visit an RMS is known to a tenth only.
    """
    chain = read_chain(URDF.read_text())
    truth = Truth(seed, chain)
    domain = fresh_domain()
    recorder = Process("recorder", domain, folder, out=folder / "bag", use_sim_time="true")
    with running(recorder), listener(domain) as (node, wait):
        states: list[JointState] = []
        tools: list[PoseStamped] = []
        commands: list[JointTrajectory] = []
        polled = Polled(node, 0.01)
        polled.subscribe(JointState, "joint_states", states.append)
        polled.subscribe(PoseStamped, "simulated_cell/true_tool", tools.append)
        node.create_subscription(JointTrajectory, "joint_trajectory", commands.append, 10)
        drive = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
        desire = node.create_publisher(PoseStamped, "desired_pose", 10)
        wait(lambda: "recording into" in recorder.output, 60.0)
        cell = Process(
            "simulated_cell", domain, folder,
            **CELL, seed=seed, stations=stations, publish_clock="true", time_factor=factor, start_delay_s=4.0 * factor,
        )  # fmt: skip
        with running(cell):
            wait(lambda: states, 60.0)
            wait(lambda: recorder.output.count("recording /") >= 3, 20.0)
            length = _STATION * stations
            begun = seconds(states[0].header.stamp)
            wait(lambda: seconds(states[-1].header.stamp) > begun + length + 0.5, 5.0 * length / factor + 30.0)
            assert recorder.stop() == 0
            say(f"recorded {stations} stations")
            assert run(["calibrate", str(folder / "bag"), "--out", str(folder / "calibration")]) == 0
            calibration = Calibration.load(folder / "calibration")
            effects = tuple(f"{e.family} {e.place}" for e in calibration.calibrated.effects)
            say(f"calibrated: {', '.join(effects)}")

            def at(goal: Array, message: JointState) -> bool:
                by_name = dict(zip(chain.names, goal, strict=True))
                return max(abs(by_name[n] - p) for n, p in zip(message.name, message.position, strict=True)) < 1e-9

            def arrived(goal: Array) -> Array:
                """The true tool (4, 4) after the arm has come to rest at a command (n,)."""
                since = wait(lambda: states and at(goal, states[-1]) and seconds(states[-1].header.stamp), 60.0)
                wait(lambda: tools and seconds(tools[-1].header.stamp) > since, 60.0)
                return _pose(tools[-1])

            def go_through(goals: list[Array]) -> list[Array]:
                """The true tools (4, 4) of commands (n,) at each of which the arm stands for a moment."""
                message = JointTrajectory(joint_names=list(chain.names))
                for k, goal in enumerate(goals):
                    for after in (_TRAVEL, _TRAVEL + _STAND):
                        point = JointTrajectoryPoint(positions=[float(x) for x in goal])
                        set_seconds(point.time_from_start, k * (_TRAVEL + _STAND) + after)
                        message.points.append(point)
                # the last one is a pose that it visits before as well
                span = len(goals) * (_TRAVEL + _STAND)
                end = seconds(states[-1].header.stamp) + span - _STAND
                states.clear()
                tools.clear()
                drive.publish(message)
                wait(
                    lambda: states and seconds(states[-1].header.stamp) > end and at(goals[-1], states[-1]),
                    span / factor + 60.0,
                )
                last = seconds(states[-1].header.stamp)
                wait(lambda: tools and seconds(tools[-1].header.stamp) > last, 60.0)
                seen = []
                rest = iter(states)
                for goal in goals:  # in the order in which it stood at them
                    begin = seconds(next(m for m in rest if at(goal, m)).header.stamp)
                    first = next(m for m in tools if seconds(m.header.stamp) > begin)
                    assert seconds(first.header.stamp) < begin + 0.75 * _STAND
                    seen.append(_pose(first))
                return seen

            rng = np.random.default_rng(seed + 1)
            meant = rng.uniform(-_RANGE, _RANGE, (wishes, chain.n))
            meant = np.tile(meant, (visits, 1))
            before = meant + rng.uniform(-0.15, 0.15, meant.shape)
            goals = truth.tool(meant)
            corrector = Process(
                "corrector", domain, folder, "-r", "~/joint_trajectory:=joint_trajectory", use_sim_time="true",
                calibration=folder / "calibration", target="tool", joint_speed_rad_s=1.0, timeout_s=0.4 * factor, rate_hz=1.0,
            )  # fmt: skip
            reached: dict[str, list[Array]] = {"nominal": [], "corrected": [], "floor": []}
            sent: list[Array] = []
            kept: list[Array] = []
            with running(corrector):
                wait(lambda: desire.get_subscription_count() == 1 and "corrects robot" in corrector.output, 60.0)
                for goal, near in zip(goals, before, strict=True):
                    go_through([near])
                    states.clear()
                    tools.clear()
                    commands.clear()
                    message = PoseStamped()
                    message.header.frame_id = "tracker"
                    fill_pose(message.pose, goal)
                    answer = _answer(desire, message, commands, corrector, wait)
                    if answer:
                        say(answer)
                        continue
                    by_name = dict(zip(commands[0].joint_names, commands[0].points[0].positions, strict=True))
                    q = np.array([by_name[name] for name in chain.names])
                    reached["corrected"].append(arrived(q))
                    sent.append(q)
                    kept.append(goal)
                assert corrector.stop() == 0
            nominal = calibration.nominal
            to_tip = se3.inverse(nominal.T_frame_base[0]), se3.inverse(nominal.T_tip_tool)
            # each pose is another one than that before it, so the arm misses it anew
            reached["floor"] = go_through([truth.command(goal, q) for goal, q in zip(kept, sent, strict=True)])
            reached["nominal"] = go_through(
                [
                    inverse(nominal.chain, to_tip[0] @ goal @ to_tip[1], q, rng=rng)
                    for goal, q in zip(kept[:wishes], sent, strict=False)
                ]
            )
            assert cell.stop() == 0
    errors = {name: _errors(np.array(kept[: len(poses)]), np.array(poses)) for name, poses in reached.items()}
    return Outcome(errors["nominal"], errors["corrected"], errors["floor"], effects, len(goals) - len(kept))


def _answer(
    desire: Any,
    wish: PoseStamped,
    commands: list[JointTrajectory],
    corrector: Process,
    wait: Wait,
) -> str:
    """What a refusal says, or nothing where there is a command; asked again where a wish was lost on its way."""
    for _ in range(10):
        said = len(corrector.output)
        desire.publish(wish)
        with contextlib.suppress(AssertionError):
            wait(lambda said=said: commands or "[WARN]" in corrector.output[said:], 5.0)
            return "" if commands else corrector.output[said:].strip()
    raise AssertionError("the corrector does not answer")


def _pose(message: PoseStamped) -> Array:
    p, o = message.pose.position, message.pose.orientation
    return se3.from_pose(np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w]))


def _errors(wanted: Array, reached: Array) -> Errors:
    rotation = so3.log(np.swapaxes(wanted[:, :3, :3], 1, 2) @ reached[:, :3, :3])
    gap = wanted[:, :3, 3] - reached[:, :3, 3]
    return Errors(np.linalg.norm(gap, axis=1), np.linalg.norm(rotation, axis=1), gap)
