"""The setpoint node as a process: it opens what it should, is silent when it should be, and nothing hostile gets through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticStatus
from impedance.toy import PANDA, READY, Toy, door
from lifecycle_msgs.msg import Transition
from modcal_interfaces.action import Pull
from nodes.processes import Goal, Process, Wait, fresh_domain, listener, running
from nodes.pulled_arm import URDF, WHO, PulledArm, Witness, fuzz, reached
from std_msgs.msg import String

from modcal_core.geometry import se3
from modcal_msgs_py.readings import seconds

pytestmark = pytest.mark.dds
# towards −x of the base, seen from the Panda's hand that points down
BACK = "[-1.0, 0.0, 0.0]"
GOAL = 0.2  # rad


@dataclass
class Cell:
    """A node that runs, an arm for it to talk to, and how to wait."""

    process: Process
    arm: PulledArm
    wait: Wait


def pose_of(message: Any) -> np.ndarray:
    p, o = message.pose.position, message.pose.orientation
    return se3.from_pose([p.x, p.y, p.z, o.x, o.y, o.z, o.w])


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """One node for the tests that need nothing special of it: each begins with another object in the hand."""
    domain = fresh_domain()
    process = Process(
        "impedance_setpoint",
        domain,
        tmp_path_factory.mktemp("cell"),
        direction=BACK,
        goal_rad=GOAL,
        tip=PANDA.tip,
        use_sim_time=True,
    )
    with running(process), listener(domain) as (node, wait):
        yield Cell(process, PulledArm(node), wait)
        assert process.stop() == 0


def test_it_opens_a_door_and_says_nothing_before_and_after(cell: Cell) -> None:
    arm, wait = cell.arm, cell.wait
    # not configured, not active: refused, with the reason
    wait(lambda: "lifecycle" in arm.health, 60.0)
    answer = arm.ask(wait, "pull")
    assert not answer.success
    assert "is unconfigured: activate it first" in answer.message
    arm.ready(wait)
    assert arm.trajectories == []
    goal = arm.goal(wait)
    wait(lambda: len(arm.poses) > 100 and len(arm.stiffnesses) > 100, 60.0)
    # one setpoint in five ways, which agree
    trajectory = {seconds(m.header.stamp): m for m in arm.trajectories}
    pairs = [(trajectory[s], m) for m in arm.poses if (s := seconds(m.header.stamp)) in trajectory]
    assert len(pairs) > 50
    for sent, pose in pairs[::10]:
        assert np.abs(reached(np.array(sent.points[0].positions)) - pose_of(pose)).max() < 1e-6
        assert pose.header.frame_id == PANDA.base
    assert {m.header.frame_id for m in (*arm.wrenches, *arm.stiffnesses)} == {PANDA.tip}
    assert {m.wrench.force.x for m in arm.stiffnesses} == {3000.0}
    assert {m.wrench.force.x for m in arm.wrenches} == {0.0}
    witness = Witness(arm)
    # somebody starts another robot's description in mid-pull: this arm stays the one that was pulling
    arm.description.publish(String(data=URDF.replace('"panda_', '"other_')))
    status, result = goal.result(90.0)
    assert (status, result.outcome) == (GoalStatus.STATUS_SUCCEEDED, Pull.Result.OPENED), result.message
    assert result.message.startswith("open to")
    assert result.opened == pytest.approx(arm.toy.a, abs=0.03)
    assert not goal.heard[0].trusted
    arm.description.publish(String(data=URDF))
    witness.look()
    assert witness.count > 300
    assert arm.toy.a == pytest.approx(GOAL, abs=0.03)
    assert arm.health["pull"].level == DiagnosticStatus.OK
    # it is over: silence, until it is asked again
    arm.trajectories.clear()
    over = arm.now() + 0.5
    wait(lambda: arm.now() > over, 60.0)
    assert arm.change(wait, Transition.TRANSITION_DEACTIVATE)
    assert not arm.ask(wait, "pull").success
    assert arm.trajectories == []
    # the whole round once more
    assert arm.change(wait, Transition.TRANSITION_CLEANUP)
    arm.toy = Toy(door())
    arm.ready(wait)
    arm.pull(wait)
    wait(lambda: len(arm.trajectories) > 20, 30.0)
    assert "stopped" in arm.ask(wait, "stop").message


def test_a_pull_as_an_action_tells_how_it_goes_and_lets_go_when_cancelled(cell: Cell) -> None:
    arm, wait = cell.arm, cell.wait
    arm.again(wait, Toy(door()))
    goal = arm.goal(wait)
    other = Goal(arm.node, wait, Pull, f"{WHO}/pull")
    status, refused = other.result()
    assert (status, refused.outcome) == (GoalStatus.STATUS_ABORTED, Pull.Result.REFUSED)
    assert "another goal is active" in refused.message
    wait(lambda: any(f.phase not in ("", "tare") and f.force_n > 0.0 for f in goal.heard), 60.0)
    assert goal.cancel()
    status, result = goal.result()
    assert (status, result.outcome) == (GoalStatus.STATUS_CANCELED, Pull.Result.CANCELLED)
    assert "cancelled" in result.message
    assert result.largest_force_n >= max(f.force_n for f in goal.heard)
    # what cannot begin says why
    arm.numb = True
    old = arm.now() + 0.5
    wait(lambda: arm.now() > old, 30.0)
    status, result = Goal(arm.node, wait, Pull, f"{WHO}/pull").result()
    assert result.outcome == Pull.Result.REFUSED
    assert "wrench" in result.message


def test_an_arm_that_falls_silent_is_left_alone(cell: Cell) -> None:
    arm, wait = cell.arm, cell.wait
    arm.again(wait, Toy(door(), locked=True))
    arm.pull(wait)
    wait(lambda: len(arm.trajectories) > 20, 30.0)
    arm.silent = True
    wait(lambda: arm.health["pull"].level == DiagnosticStatus.ERROR, 20.0)
    assert "no message in the last 0.1 s" in arm.said()
    Witness(arm).nothing_after(arm.spoke)


def test_a_pull_is_refused_for_what_its_wrench_is_refused_for(cell: Cell) -> None:
    arm, wait = cell.arm, cell.wait
    arm.again(wait, Toy(door()))
    arm.frame = "elsewhere"
    old = arm.now() + 0.5  # from when on no wrench of before counts
    wait(lambda: arm.now() > old and "wrench in frame 'elsewhere'" in arm.health["hearing"].message, 30.0)
    assert arm.health["hearing"].level == DiagnosticStatus.WARN
    answer = arm.ask(wait, "pull")
    assert not answer.success
    assert "wrench in frame 'elsewhere'" in answer.message
    arm.frame = PANDA.tip
    wait(lambda: arm.health["hearing"].level == DiagnosticStatus.OK, 30.0)


def test_nothing_hostile_makes_it_send_what_it_should_not(cell: Cell, rng: np.random.Generator) -> None:
    """A thousand messages; bench/control_tick.py sends a hundred thousand and more."""
    arm, wait = cell.arm, cell.wait
    arm.again(wait, Toy(door()))
    arm.pull(wait)
    seen, pulls = fuzz(arm, wait, rng, 1_000, burst=100)
    assert pulls > 2
    assert seen > 50
    # and it is sound afterwards
    arm.again(wait, Toy(door()))
    arm.pull(wait)
    wait(lambda: len(arm.trajectories) > 50, 30.0)
    assert cell.process.popen.poll() is None


def test_a_calibrated_arm_is_where_the_corrector_says(tmp_path: Path) -> None:
    """It starts itself, waits for the corrector, begins where that says the tool is, and ends when it falls silent."""
    domain = fresh_domain()
    process = Process(
        "impedance_setpoint",
        domain,
        tmp_path,
        direction=BACK,
        tip=PANDA.tip,
        use_sim_time=True,
        calibrated=True,
        autostart=True,
    )
    with running(process), listener(domain) as (node, wait):
        arm = PulledArm(node)
        # nobody has asked it to be ready, and it is not while the corrector is silent
        wait(lambda: arm.said().startswith("not ready: ") and "tool_pose" in arm.said(), 60.0)
        wait(lambda: "tool_pose: no message was received recently" in arm.ask(wait, "pull").message, 60.0)
        arm.off = np.array([0.004, -0.003, 0.002])
        wait(lambda: arm.said() == "ready", 60.0)
        arm.pull(wait)
        wait(lambda: len(arm.poses) > 20, 60.0)
        begun = pose_of(arm.poses[0])[:3, 3] - reached(READY)[:3, 3]
        assert np.abs(begun - arm.off).max() < 5e-4
        Witness(arm).look()
        silence, arm.off = arm.now(), None
        wait(lambda: arm.health["pull"].level == DiagnosticStatus.ERROR, 60.0)
        assert "no message in the last 0.1 s" in arm.said()
        Witness(arm).nothing_after(silence)
        assert process.stop() == 0


def test_parameters_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    process = Process("impedance_setpoint", fresh_domain(), tmp_path, mode="both", tip=PANDA.tip)
    with running(process):
        assert process.popen.wait(60.0) == 2
        assert "neither expected nor admittance" in process.output
