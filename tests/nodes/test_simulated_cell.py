"""The simulated cell as a process: what it publishes, what may be changed while it runs, and whose time it keeps."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deltas import FILE
from geometry_msgs.msg import PoseStamped
from nodes import processes
from nodes.cell import call
from nodes.processes import ROOT, Process, beside, fresh_domain, listener, running
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Temperature

from modcal_core.errors import ModcalError
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_nodes.ros.parameters import SIMULATED_CELL
from modcal_nodes.simulation.plant import Plant, make_world

URDF = ROOT / "examples" / "robots" / "ur10.urdf"
CHAIN = read_chain(URDF.read_text())
SEED = 3

pytestmark = pytest.mark.dds


def seconds(message: Any) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def nanoseconds(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def transform(message: PoseStamped) -> Array:
    p, q = message.pose.position, message.pose.orientation
    return se3.from_pose(np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w]))


def jumps(messages: list[Any]) -> list[int]:
    """Messages whose stamp lies before that of the message before."""
    return [k for k in range(1, len(messages)) if nanoseconds(messages[k]) < nanoseconds(messages[k - 1])]


def hear(node: Node, kind: type, topic: str) -> list[Any]:
    heard: list[Any] = []
    node.create_subscription(kind, topic, heard.append, 5000)
    return heard


def test_effects_are_switched_on_while_it_runs(tmp_path: Path) -> None:
    parameters = {"urdf": URDF, "seed": SEED, "noise_m": 0.0, "noise_rad": 0.0, "publish_effort": True}
    parameters |= {"joint_compliance_rad_per_nm": "[2.0e-5]", "warm_up_link": "upper_arm_link", "warm_up_s": 0.5}
    with beside(tmp_path, "simulated_cell", temperature_noise_k=0.0, **parameters) as (cell, node, wait):
        states, readings = hear(node, JointState, "joint_states"), hear(node, PoseStamped, "tracker/pose")
        true = hear(node, PoseStamped, "simulated_cell/true_tool")
        in_base = hear(node, PoseStamped, "simulated_cell/true_tool_in_base")
        warmth = hear(node, Temperature, "temperature")
        put = partial(processes.put, node, wait, "simulated_cell")
        wait(lambda: states and readings and true and in_base and warmth, 60.0)

        # as a world of the same seed has it
        world = make_world(CHAIN, np.random.default_rng(SEED), 5e-4, 1e-3, read_inertias(URDF.read_text(), CHAIN), 2e-5)
        q = np.array(states[-1].position)
        assert tuple(states[-1].name) == CHAIN.names
        assert not np.any(states[-1].velocity)
        assert np.abs(np.array(states[-1].effort) - world.holding(q)).max() < 1e-9
        assert np.abs(transform(in_base[-1]) - world.tool_in_base(q)).max() < 1e-12
        assert np.abs(transform(true[-1]) - world.tool_in_tracker(q)).max() < 1e-12
        assert true[-1].header.frame_id == readings[-1].header.frame_id == "tracker"
        assert in_base[-1].header.frame_id == "base_link"
        wait(lambda: {nanoseconds(m) for m in readings} & {nanoseconds(m) for m in true}, 30.0)
        truth = {nanoseconds(m): m.pose for m in true}
        assert all(m.pose == truth[nanoseconds(m)] for m in readings if nanoseconds(m) in truth)  # there is no noise

        def until(expected: Callable[[], Array]) -> None:
            wait(lambda: np.abs(transform(true[-1]) - expected()).max() < 1e-12, 30.0)

        def expected() -> Array:
            return world.tool_in_tracker(q)

        move, turn = [1e-3, 0.0, -2e-3], [0.01, -0.02, 0.0]
        assert not put(tool_bump_m=move)
        assert not put(tool_turn_rad=turn)
        world.bump(move, turn)
        until(expected)
        assert not put(payload_kg=3.0)
        world.carry(3.0)
        until(expected)
        wait(lambda: np.abs(np.array(states[-1].effort) - world.holding(q)).max() < 1e-9, 30.0)
        assert not put(tracker_move_m=[0.0, 0.1, 0.0])
        world.move_tracker([0.0, 0.1, 0.0])
        until(expected)
        wait(lambda: in_base[-1].header.stamp == true[-1].header.stamp, 30.0)
        assert np.abs(transform(in_base[-1]) - world.tool_in_base(q)).max() < 1e-12

        # warming up, against the clock of the stamps
        assert (warmth[-1].header.frame_id, warmth[-1].temperature) == ("upper_arm_link", 20.0)
        cold, count = transform(true[-1])[:3, 3], len(true)
        assert not put(warm_up_m=5e-4)
        world.grow("upper_arm_link", 5e-4)
        wait(lambda: np.abs(transform(true[-1]) - expected()).max() < 1e-7, 60.0)
        hot = expected()[:3, 3] - cold
        t = np.array([seconds(m) for m in true[count:]])
        share = np.array([(transform(m)[:3, 3] - cold) @ hot / (hot @ hot) for m in true[count:]])
        rising = (share > 0.1) & (share < 0.95)
        assert rising.sum() > 20
        slope = np.polyfit(t[rising] - t[0], -np.log(1.0 - share[rising]), 1)[0]
        assert slope == pytest.approx(1.0 / 0.5, rel=0.01)
        length = world.length("upper_arm_link")
        wait(lambda: abs(warmth[-1].temperature - 20.0 - 5e-4 / (23e-6 * length)) < 0.1, 60.0)

        # what makes no sense, and what counts at the start only
        for name, value, said in (
            ("tool_bump_m", [0.0, 0.1], "three finite numbers"),
            ("payload_kg", -1.0, ""),
            ("warm_up_link", "wing", "link 'wing'"),
            ("tracker_rate_hz", 10.0, "read-only"),
            ("urdf", "other.urdf", "read-only"),
        ):
            reason = put(**{name: value})
            assert reason
            assert said in reason
        count = len(true)
        wait(lambda: len(true) > count + 5, 30.0)
        assert np.abs(transform(true[-1]) - expected()).max() < 1e-7
        assert cell.stop() == 0
    for name in ("tool_bump_m", "tool_turn_rad", "payload_kg", "tracker_move_m", "warm_up_m"):
        assert f"{name}: " in cell.output
    assert "Traceback" not in cell.output


def test_its_own_tour_goes_on_and_is_held_up_without_loss(tmp_path: Path) -> None:
    """Stamps lie on a grid, velocity is the slope of position, a stop of the process loses no message."""
    domain = fresh_domain()
    cell = Process(
        "simulated_cell", domain, tmp_path, urdf=URDF, stations=2, travel_s=0.2, dwell_s=0.1, repeat=True,
        joint_rate_hz=500.0, tracker_rate_hz=100.0, measurement="pose",
    )  # fmt: skip
    with running(cell), listener(domain) as (node, wait):
        states, readings = hear(node, JointState, "joint_states"), hear(node, PoseStamped, "tracker/pose")
        wait(lambda: len(states) > 500 and len(readings) > 50, 60.0)
        refused = call(node, wait, "simulated_cell/restart")  # time that is not its own is not set back
        assert not refused.success
        assert "publish_clock" in refused.message
        cell.popen.send_signal(signal.SIGSTOP)
        stopped = time.monotonic()
        wait(lambda: time.monotonic() - stopped > 1.0, 30.0)
        cell.popen.send_signal(signal.SIGCONT)
        after = seconds(states[-1])
        wait(lambda: seconds(states[-1]) > after + 2.0 and seconds(readings[-1]) > after + 2.0, 60.0)
        assert cell.stop() == 0
    for messages, step in ((states, 2_000_000), (readings, 10_000_000)):
        assert np.abs(np.diff([nanoseconds(m) for m in messages]) - step).max() <= 1
    assert not {nanoseconds(m) for m in states} & {nanoseconds(m) for m in readings}
    q, v = np.array([m.position for m in states]), np.array([m.velocity for m in states])
    assert not any(len(m.effort) for m in states)
    slope = (q[2:] - q[:-2]) / 0.004
    # where a leg begins or ends its third derivative jumps, which is all that a central difference misses there
    assert np.abs(slope - v[1:-1]).max() < 0.05 * np.abs(v).max()
    assert np.abs(slope - v[1:-1]).mean() < 2e-3 * np.abs(v).max()
    rest = q[1:-1][(v[1:-1] == 0.0).all(axis=1)]
    assert len(np.unique(np.round(rest, 9), axis=0)) > 4  # two stations a tour


def test_simulated_time_runs_at_its_own_pace_and_begins_anew(tmp_path: Path) -> None:
    domain = fresh_domain()
    cell = Process(
        "simulated_cell", domain, tmp_path, urdf=URDF, publish_clock=True, time_factor=4.0, clock_start_s=500.0,
        stations=2, travel_s=0.3, dwell_s=0.2, clock_rate_hz=50.0, joint_rate_hz=50.0, tracker_rate_hz=20.0,
    )  # fmt: skip
    with running(cell), listener(domain) as (node, wait):
        states, clock = hear(node, JointState, "joint_states"), hear(node, Clock, "/clock")
        readings = hear(node, PoseStamped, "tracker/pose")
        wait(lambda: states and clock and readings, 60.0)
        begun, first = time.monotonic(), clock[-1].clock.sec
        wait(lambda: clock[-1].clock.sec >= first + 12, 60.0)
        took = time.monotonic() - begun
        assert 2.0 < took < 20.0  # 11 to 12 s at four times the pace; a busy machine is late, but not by so much
        assert seconds(states[0]) >= 500.0
        ticks = [1_000_000_000 * m.clock.sec + m.clock.nanosec for m in clock]
        assert set(np.diff(ticks)) == {20_000_000}
        assert call(node, wait, "simulated_cell/restart").success
        for messages in (states, readings):
            wait(lambda messages=messages: len(jumps(messages)) == 1, 30.0)
        (back,) = jumps(states)
        assert seconds(states[back]) == 500.0
        # the tour of two postures had ended and starts over as well
        assert not np.any(states[back - 1].velocity)
        wait(lambda: any(np.any(m.velocity) for m in states[back:]), 30.0)
        assert cell.stop() == 0


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"joint_compliance_rad_per_nm": [1.0e-5, 2.0e-5]}, "1 or 6 numbers"),
        ({"warm_up_m": 1e-4}, "warm_up_link must name"),
        ({"tool_bump_m": [5.0, 0.0, 0.0]}, "tool_bump_m is longer than 1"),
        ({"delta": str(FILE), "gear_joint": "elbow"}, "gear_joint 'elbow'"),
        ({"gear_joint": "knee"}, "gear_joint 'knee'"),
        ({"delta": "nowhere.yaml"}, "delta 'nowhere.yaml'"),
        ({"delta": str(FILE), "warm_up_link": "arm_1", "warm_up_m": 1e-4}, "whose links do not grow"),
    ],
)
def test_what_cannot_be_simulated(parameters: dict[str, Any], said: str) -> None:
    """In one line; that the process then ends with it: the next test."""
    chosen = {name: parameter.default for name, parameter in SIMULATED_CELL.items()} | {"urdf": str(URDF)}
    with pytest.raises(ModcalError) as refused:
        Plant(chosen | parameters)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_repeatability_scatters_arrivals_only(tmp_path: Path) -> None:
    """Standing still, the tool stands still; at the next arrival it is elsewhere by the scatter of the joints."""
    domain = fresh_domain()
    cell = Process(
        "simulated_cell", domain, tmp_path, urdf=URDF, seed=SEED, repeatability_rad=1e-4, stations=6, travel_s=0.1,
        dwell_s=0.3, start_delay_s=6.0,
    )  # fmt: skip
    with running(cell), listener(domain) as (node, wait):
        states, true = hear(node, JointState, "joint_states"), hear(node, PoseStamped, "simulated_cell/true_tool")

        def toured() -> bool:
            begun = next((seconds(m) for m in states if np.any(m.velocity)), np.inf)
            return bool(true) and seconds(true[-1]) > begun + 6 * 0.4

        wait(toured, 60.0)
        assert cell.stop() == 0
    world = make_world(CHAIN, np.random.default_rng(SEED), 5e-4, 1e-3)
    t, at = np.array([seconds(m) for m in states]), np.array([m.position for m in states])
    still = np.array([not np.any(m.velocity) for m in states])
    off = []
    for message in true:
        k = np.searchsorted(t, seconds(message))
        if 0 < k < len(t) and still[k - 1] and still[k]:
            gap = transform(message) @ se3.inverse(world.tool_in_tracker(at[k]))
            off.append(np.r_[at[k], so3.log(gap[:3, :3])])
    rows = np.array(off)
    stations = np.unique(np.round(rows[:, :6], 9), axis=0)
    turns = []
    for q in stations:
        here = rows[np.abs(rows[:, :6] - q).max(axis=1) < 1e-6, 6:]
        assert np.ptp(here, axis=0).max() < 1e-9
        turns.append(here[0])
    turned = np.linalg.norm(turns, axis=1)
    assert len(stations) >= 5
    assert (turned[np.abs(stations).max(axis=1) > 0] > 1e-6).all()
    assert turned.max() < 6 * 6**0.5 * 1e-4
