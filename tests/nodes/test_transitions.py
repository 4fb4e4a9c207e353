"""The setpoint node refuses what its state does not allow, answers, lives on, and lets go of what it pulls."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
from impedance.toy import PANDA, Toy, door
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import GetState
from nodes.processes import Process, Wait, ask, fresh_domain, listener, put, running
from nodes.pulled_arm import PulledArm, Witness
from nodes.random_requests import RandomRequests

pytestmark = pytest.mark.dds
UNKNOWN = 99


class Cell:
    """A node that runs, an arm for it to talk to, and what may be asked of it."""

    def __init__(self, process: Process, arm: PulledArm, wait: Wait) -> None:
        self.process, self.arm, self.wait = process, arm, wait
        self.set = partial(put, arm.node, wait, "impedance_setpoint")

    def state(self) -> int:
        return int(ask(self.arm.node, self.wait, GetState, "impedance_setpoint/get_state").current_state.id)

    def pull(self) -> None:
        """Be pulling at a locked door, with force in the hand."""
        if self.state() == State.PRIMARY_STATE_UNCONFIGURED:
            self.arm.ready(self.wait)
        self.arm.again(self.wait, Toy(door(), locked=True))
        self.arm.pull(self.wait)
        self.wait(lambda: self.arm.toy.peak > 8.0, 60.0)


def fastest(arm: PulledArm, begin: int, end: int) -> float:
    """The largest speed [m/s] of these setpoints of the tool.

    By their own stamps: after a tick that was late by several periods a step is that much longer.
    """
    p = np.array([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in arm.poses[begin:end]])
    t = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in arm.poses[begin:end]])
    return float((np.linalg.norm(np.diff(p, axis=0), axis=1) / np.maximum(np.diff(t), 1.0 / 250.0)).max())


def felt(arm: PulledArm) -> float:
    """The force between hand and handle [N]."""
    return float(np.linalg.norm(arm.toy.contact[:3]))


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    domain = fresh_domain()
    process = Process(
        "impedance_setpoint", domain, tmp_path_factory.mktemp("cell"), direction="[-1.0, 0.0, 0.0]", tip=PANDA.tip,
        use_sim_time=True,
    )  # fmt: skip
    with running(process), listener(domain) as (node, wait):
        yield Cell(process, PulledArm(node), wait)
        assert process.stop() == 0
        assert "Traceback" not in process.output


def test_illegal_transitions_are_answered_in_every_state(cell: Cell) -> None:
    """Activate while unconfigured, configure twice, and a number that is no transition."""
    arm, wait = cell.arm, cell.wait
    legal = {
        State.PRIMARY_STATE_UNCONFIGURED: {Transition.TRANSITION_CONFIGURE},
        State.PRIMARY_STATE_INACTIVE: {Transition.TRANSITION_CLEANUP, Transition.TRANSITION_ACTIVATE},
        State.PRIMARY_STATE_ACTIVE: {Transition.TRANSITION_DEACTIVATE},
    }
    every = {
        Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP, Transition.TRANSITION_ACTIVATE,
        Transition.TRANSITION_DEACTIVATE, UNKNOWN,
    }  # fmt: skip
    for state, onwards in zip(
        legal, (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE, None), strict=True
    ):
        for transition in sorted(every - legal[state]):
            assert not arm.change(wait, transition)
            assert cell.state() == state
        if onwards is not None:
            assert arm.change(wait, onwards)
    wait(lambda: "is refused in state active" in arm.health["lifecycle"].message, 10.0)
    assert arm.health["faults"].level == b"\0"


def test_asked_for_what_is_no_transition_in_the_middle_of_a_pull_it_lets_go(cell: Cell) -> None:
    """The last setpoints go back to where the tool is, and the force with them; the node can pull again."""
    arm, wait = cell.arm, cell.wait
    cell.pull()
    assert not arm.change(wait, UNKNOWN)
    wait(lambda: "is refused in state active" in arm.said(), 10.0)
    assert cell.state() == State.PRIMARY_STATE_ACTIVE
    assert felt(arm) < 3.0
    Witness(arm).look()


def test_stopped_in_the_middle_of_a_pull_it_lets_go(cell: Cell) -> None:
    """Whatever is felt: the answer comes when the force is gone, also where the wrench has fallen silent."""
    arm, wait = cell.arm, cell.wait
    cell.pull()
    arm.numb = True
    answer = arm.ask(wait, "stop")
    assert answer.success
    assert "stopped as asked" in answer.message
    assert cell.state() == State.PRIMARY_STATE_ACTIVE
    assert felt(arm) < 3.0
    Witness(arm).look()
    assert arm.ask(wait, "stop").message == "nothing was pulled"


def test_deactivated_in_the_middle_of_a_pull_it_lets_go(cell: Cell) -> None:
    arm, wait = cell.arm, cell.wait
    cell.pull()
    assert arm.change(wait, Transition.TRANSITION_DEACTIVATE)
    assert cell.state() == State.PRIMARY_STATE_INACTIVE
    assert felt(arm) < 3.0
    Witness(arm).look()
    count = len(arm.trajectories)
    assert arm.change(wait, Transition.TRANSITION_ACTIVATE)
    assert len(arm.trajectories) == count


def test_a_limit_that_is_changed_holds_at_once(cell: Cell) -> None:
    """max_speed_m_s is a limit of safety; what is no limit cannot change while it pulls, and says so."""
    arm, wait = cell.arm, cell.wait
    arm.again(wait, Toy(door()))
    assert not cell.set(max_speed_m_s=0.004)
    arm.pull(wait)
    assert "cannot change while it pulls" in cell.set(blend_s=0.25)
    wait(lambda: len(arm.poses) > 150, 60.0)
    assert 0.0 < fastest(arm, 0, 150) < 1.05 * 0.004
    assert not cell.set(max_speed_m_s=0.001)
    since = len(arm.poses) + 25  # a tenth of a second to brake
    wait(lambda: len(arm.poses) > since + 100, 60.0)
    assert 0.0 < fastest(arm, since, since + 100) < 1.05 * 0.001
    assert not cell.set(max_speed_m_s=0.25)
    arm.ask(wait, "stop")
    assert "is read when the node is configured" in cell.set(tool_mass=1.0)
    assert "must rise" in cell.set(slowdown_force_n=400.0)


def test_limits_are_kept_and_the_hand_lets_go_whatever_it_is_asked(cell: Cell, rng: np.random.Generator) -> None:
    """Requests at random while it pulls, some seconds a pull; bench/control_tick.py asks for hundreds."""
    if cell.state() == State.PRIMARY_STATE_UNCONFIGURED:
        cell.arm.ready(cell.wait)
    asked = RandomRequests(cell.arm, cell.wait, rng)
    asked.run(4)
    assert asked.count["pulls"] >= 1
    assert asked.witness.count > 100


def test_told_to_end_in_the_middle_of_a_pull_it_lets_go(cell: Cell) -> None:
    cell.pull()
    cell.process.popen.terminate()
    cell.wait(lambda: cell.process.popen.poll() is not None, 15.0)  # the arm goes on meanwhile
    assert cell.process.popen.poll() == 0
    assert felt(cell.arm) < 3.0
