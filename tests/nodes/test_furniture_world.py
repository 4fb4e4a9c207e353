"""The world in which doors are pulled: its physics against formulas, and the node that runs it at the clock's pace."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from nodes.plain_pulls import PERIOD, learnt_wrong, pull, straight
from nodes.processes import ROOT, Process, fresh_domain, listener, running
from robots.test_kinematics import chain_of, urdf
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadCommand, BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.bodies import STANDARD_GRAVITY
from modcal_core.robots.inverse_kinematics import inverse
from modcal_nodes.simulation.furniture import KINDS, Furniture, draw
from modcal_nodes.simulation.mjcf import GRASP_STIFFNESS
from modcal_nodes.simulation.pulling import Pulling, effort_limits

URDF = urdf("panda")
CHAIN = chain_of("panda")


@cache
def scene(kind: str, grasp: str, seed: int = 3, **chosen: float) -> Furniture:
    return draw(CHAIN, np.random.default_rng(seed), {"kind": kind, "grasp": grasp, **chosen})


def world(drawn: Furniture) -> Pulling:
    return Pulling.of(URDF, CHAIN, drawn, np.random.default_rng(0), noise_n=0.0, noise_nm=0.0)


def lead(made: Pulling, opened: float, seconds: float, rest: float = 0.5) -> None:
    """Lead the hand along the way as it was drawn, gently at both ends, and let it come to rest."""
    q = made.reference()
    steps = round(seconds / PERIOD)
    for k in range(steps + round(rest / PERIOD)):
        s = min(1.0, (k + 1) / steps)
        q = inverse(CHAIN, made.scene.handle(opened * s * s * (3.0 - 2.0 * s)), q, restarts=0, tolerance=1e-7)
        made.refer(q)
        made.advance(PERIOD)


@pytest.mark.slow
@pytest.mark.parametrize("grasp", ["weld", "ball"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_arm_begins_at_rest_with_the_closed_handle_in_its_hand(kind: str, grasp: str) -> None:
    made = world(scene(kind, grasp))
    assert made.time == 0.0
    assert abs(made.opened) < 1e-3
    assert np.linalg.norm(made.contact()[:3]) < 0.1
    assert np.abs(made.tool() - made.scene.T_base_handle).max() < 1e-5
    assert np.abs(made.joints()[1]).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["door", "drawer", "screw"])
def test_the_handle_moves_as_drawn(kind: str) -> None:
    """MuJoCo's hinge and slide against the exponential of the twist that they were drawn from."""
    made = world(scene(kind, "weld"))
    lead(made, 0.5 * made.scene.goal, 1.5)
    assert abs(made.opened - 0.5 * made.scene.goal) < 0.02 * made.scene.goal
    # the coupling of a screw gives way a little
    assert np.abs(made.handle() - made.scene.handle(made.opened)).max() < (1e-4 if kind == "screw" else 1e-6)
    assert np.abs(made.tool() - made.handle()).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["door", "drawer"])
def test_force_that_a_spring_asks_for(kind: str) -> None:
    """Held open without friction, the hand's pull along the way, times the lever arm, is the spring's torque."""
    quiet = scene(kind, "ball", friction=0.0, damping=1.0, spring=5.0 if kind == "door" else 40.0)
    made = world(quiet)
    lead(made, 0.6 * quiet.goal, 1.5, 1.5)
    lever = quiet.radius if quiet.turns else 1.0
    force = made.handle()[:3, :3] @ made.contact()[:3]
    tangent = se3.exp(quiet.twist * made.opened)[:3, :3] @ quiet.direction
    assert tangent @ force * lever == pytest.approx(quiet.spring * made.opened, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("grasp", ["weld", "ball"])
def test_the_wrist_feels_the_tool_and_what_the_hand_does_not_give_to_the_handle(grasp: str) -> None:
    drawn = scene("door", grasp)
    made = world(drawn)

    def weight() -> Array:
        force = made.tool()[:3, :3].T @ np.array([0.0, 0.0, -STANDARD_GRAVITY * drawn.tool_mass])
        return np.concatenate([force, np.cross(drawn.tool_com, force)])

    assert np.abs(made.wrench() - drawn.tool_bias - weight()).max() < 0.1
    lead(made, 0.7 * drawn.goal, 1.5, 1.5)
    felt = made.wrench() - drawn.tool_bias - weight()
    assert np.linalg.norm(made.contact()[:3]) > 2.0
    assert np.abs(felt + made.contact()).max() < 0.05


def test_a_ball_lets_the_hand_turn_and_a_weld_does_not() -> None:
    for grasp, turned in (("ball", True), ("weld", False)):
        made = world(scene("door", grasp))
        goal = made.scene.T_base_handle.copy()
        for tick in range(200):
            goal[:3, :3] = goal[:3, :3] @ se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.001])[:3, :3]
            made.refer(inverse(CHAIN, goal, made.reference(), restarts=0, tolerance=1e-7))
            made.advance(PERIOD)
            if not turned and tick > 50:
                break
        torque = np.linalg.norm(made.contact()[3:])
        assert torque < 0.01 if turned else torque > 1.0


@pytest.mark.slow
def test_servos_lag_as_they_are_told() -> None:
    """A reference that moves steadily is ahead by velocity times lag; nothing pulls at a handle that slides freely."""
    free = scene("drawer", "weld", friction=0.0, damping=0.0, spring=0.0, mass_kg=0.1)
    made = world(free)
    speed, lags = 0.05, []
    q = made.reference()
    for tick in range(int(0.2 / speed / PERIOD)):
        q = inverse(CHAIN, free.handle(speed * tick * PERIOD), q, restarts=0, tolerance=1e-8)
        made.refer(q)
        lags.append((speed * tick * PERIOD - made.opened) / speed)
        made.advance(PERIOD)
    assert np.mean(lags[-200:]) == pytest.approx(0.03, abs=0.006)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [0.0, 0.2])
def test_what_is_locked_does_not_open(stop: float) -> None:
    drawn = scene("door", "weld", stop=stop)
    came = pull(world(drawn), learnt_wrong(drawn), compliant=False)
    assert came.opened < stop + 0.02
    assert came.peak > 100.0


@pytest.mark.slow
def test_a_folding_door_leaves_the_circle_that_it_began_on() -> None:
    drawn = scene("folding", "ball")
    made = world(drawn)
    lead(made, np.radians(15.0), 1.0)

    def off() -> float:
        """How far the handle is from the circle of the first hinge."""
        circle = [drawn.handle(a)[:3, 3] for a in np.linspace(0.0, 1.0, 1001)]
        return float(np.linalg.norm(made.handle()[:3, 3] - circle, axis=1).min())

    assert off() < 1e-3
    for tick in range(500):
        goal = drawn.handle(np.radians(15.0))
        goal[:3, 3] -= 0.15 * min(1.0, tick / 450) * drawn.T_base_handle[:3, 2]
        made.refer(inverse(CHAIN, goal, made.reference(), restarts=0, tolerance=1e-7))
        made.advance(PERIOD)
    (first, second), _ = made.object_state()
    assert off() > 5e-3
    assert first == pytest.approx(np.radians(20.0), abs=0.02)
    assert second > np.radians(8.0)


@pytest.mark.slow
def test_scenes_come_out_as_chosen_and_the_same_for_the_same_seed() -> None:
    one, other = (draw(CHAIN, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(one.q, other.q)
    assert np.array_equal(one.axis, other.axis)
    chosen = scene("door", "ball", radius_m=0.3, friction=1.5)
    assert chosen.radius == pytest.approx(0.3)
    assert chosen.friction == 1.5
    # the direction that the hand points in is off by some degrees, and not by many
    drawn = [scene("drawer", "weld", seed) for seed in range(8)]
    off = [np.degrees(np.arccos(-d.direction @ d.T_base_handle[:3, 2])) for d in drawn]
    assert 3.0 < np.mean(off) < 20.0


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [{"kind": "window"}, {"grasp": "magnet"}, {"kind": "door", "radius_m": 1.9}])
def test_scenes_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(BadTable, match=str(next(reversed(wrong.values())))):
        draw(CHAIN, np.random.default_rng(0), wrong)


def test_references_that_a_driver_would_refuse() -> None:
    made = world(scene("door", "weld"))
    for wrong in (made.scene.q + 0.5, made.scene.q[:-1], made.scene.q * np.nan):
        with pytest.raises(BadCommand, match="joint_references"):
            made.refer(wrong)
    assert np.array_equal(made.reference(), made.scene.q)


@pytest.mark.slow
def test_torques_stay_within_the_limits_of_the_arm() -> None:
    drawn = scene("door", "weld", stop=0.0)
    made = world(drawn)
    limits = effort_limits(URDF, CHAIN.names)
    assert limits.tolist() == [87.0] * 4 + [12.0] * 3
    pull(made, straight(drawn), compliant=False)
    torques = np.abs(made.data.actuator_force)
    assert (torques <= limits + 1e-9).all()
    assert (torques > 0.99 * limits).any()


@pytest.mark.dds
def test_node_speaks_in_time_and_follows(tmp_path: Path) -> None:
    """A drawer is pulled open by references; what the node says of it agrees with a world of this test's own."""
    domain = fresh_domain()
    drawn = draw(CHAIN, np.random.default_rng(2), {"kind": "drawer", "grasp": "weld"})
    node_process = Process(
        "simulated_furniture",
        domain,
        tmp_path,
        urdf=ROOT / "examples" / "robots" / "panda.urdf",
        seed=2,
        kind="drawer",
        grasp="weld",
    )
    with running(node_process), listener(domain) as (node, wait):
        heard: dict[str, list[Any]] = {}
        for kind, topic in (
            (JointState, "joint_states"),
            (WrenchStamped, "wrench"),
            (WrenchStamped, "simulated_furniture/contact_force"),
            (JointState, "simulated_furniture/object_truth"),
        ):
            heard[topic] = []
            node.create_subscription(kind, topic, heard[topic].append, 1000)
        references = node.create_publisher(JointTrajectoryPoint, "joint_references", 10)
        trajectory = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
        wait(lambda: all(heard.values()) and references.get_subscription_count(), 30.0)
        assert list(heard["joint_states"][0].name) == list(CHAIN.names)
        assert np.allclose(heard["joint_states"][-1].position, drawn.q, atol=1e-4)
        assert heard["wrench"][0].header.frame_id == CHAIN.tip

        truth = heard["simulated_furniture/object_truth"]
        q, opened = drawn.q, 0.0
        for step in range(50):
            opened = 0.002 * (step + 1)
            q = inverse(CHAIN, drawn.handle(opened), q, restarts=0, tolerance=1e-7)
            references.publish(JointTrajectoryPoint(positions=q.tolist()))
            count = len(truth)
            wait(lambda count=count: len(truth) > count + 1, 5.0)
        wait(lambda: abs(truth[-1].position[0] - opened) < 0.005, 5.0)

        q = inverse(CHAIN, drawn.handle(0.15), q, restarts=0, tolerance=1e-7)
        message = JointTrajectory(joint_names=list(reversed(CHAIN.names)))
        message.points = [JointTrajectoryPoint(positions=q[::-1].tolist())]
        message.points[0].time_from_start.sec = 1
        trajectory.publish(message)
        wait(lambda: abs(truth[-1].position[0] - 0.15) < 0.005, 10.0)
        contact = heard["simulated_furniture/contact_force"]
        assert max(np.hypot(np.hypot(m.wrench.force.x, m.wrench.force.y), m.wrench.force.z) for m in contact) > 1.0

        references.publish(JointTrajectoryPoint(positions=(q + 1.0).tolist()))
        wait(lambda: "not followed" in node_process.output, 10.0)
        stamps = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in heard["joint_states"]])
        assert np.allclose(np.diff(stamps), 0.004, atol=1e-6)
        assert node_process.stop() == 0


def test_the_grasp_gives_way_like_a_spring() -> None:
    locked = scene("door", "weld", stop=0.0)
    made = world(locked)
    moved = se3.transform(np.eye(3), [1e-3, 0.0, 0.0])
    for k in range(250):
        share = se3.exp(min(1.0, k / 125) * se3.log(moved))
        made.refer(inverse(CHAIN, locked.T_base_handle @ share, made.reference(), restarts=0, tolerance=1e-8))
        made.advance(PERIOD)
    gap = (se3.inverse(made.handle()) @ made.tool())[0, 3]
    assert made.contact()[0] / gap == pytest.approx(GRASP_STIFFNESS, rel=0.12)
