"""The physics of the simulated cell against formulas and engines that are not its own, and what the arm does with a plan."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yaml
from deltas import FILE, nominal
from geometry_msgs.msg import PointStamped, PoseStamped
from nodes.processes import ROOT, Process, beside, fresh_domain, running
from robots.random_arms import Pinocchio
from robots.test_kinematics import chain_of, urdf
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadCommand, BadRobot, BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.planning.typed_table import trajectory_from_data
from modcal_core.robots.acceleration import read_drives
from modcal_core.robots.bodies import STANDARD_GRAVITY
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import passable
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_nodes.ros.parameters import SIMULATED_CELL
from modcal_nodes.simulation.delta_world import make_delta_world
from modcal_nodes.simulation.mjcf import World
from modcal_nodes.simulation.plant import SWITCHES, Grid, Switches, make_world
from modcal_nodes.simulation.program import Program, legs, tour, within_limits

CHAIN = chain_of("ur10")
COMPLIANCE = np.array([1e-5, 2e-5, 3e-5, 0.0, 5e-5, 6e-5])
PAYLOAD = 4.0


def postures(count: int = 30, seed: int = 4) -> Array:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (count, CHAIN.n))


def perfect(compliance: Array | float = 0.0, T_tip_tool: Array | None = None) -> World:
    """The nominal UR10 with its stated masses."""
    inertias = read_inertias(urdf("ur10"), CHAIN)
    return World(CHAIN, np.random.default_rng(0), 0.0, 0.0, None, T_tip_tool, inertias, compliance)


def gravity(q: Array, payload: float = 0.0) -> Array:
    """Pinocchio's torques (N, n) that hold the arm up."""
    model = Pinocchio(urdf("ur10"), CHAIN).model
    model.gravity.linear = np.array([0.0, 0.0, -STANDARD_GRAVITY])
    tip = pin.SE3(CHAIN.origins[-1])
    model.appendBodyToJoint(model.njoints - 1, pin.Inertia(payload, np.zeros(3), np.zeros((3, 3))), tip)
    data = model.createData()
    assert list(model.names)[1:] == list(CHAIN.names)
    return np.array([pin.computeGeneralizedGravity(model, data, row) for row in q])


def test_torques_that_hold_the_arm_with_a_load() -> None:
    world, q = perfect(), postures()
    world.carry(PAYLOAD)
    assert np.abs(world.holding(q) - gravity(q, PAYLOAD)).max() < 1e-6
    assert np.abs(gravity(q, PAYLOAD)).max() > 50.0


def test_joints_give_way_by_compliance_times_torque() -> None:
    """The torque is that of the posture which is reached."""
    world, q = perfect(COMPLIANCE), postures()
    reached = world.settle(q)
    assert np.abs(reached - q + COMPLIANCE * gravity(reached)).max() < 1e-11
    assert np.abs(reached - q).max() > 1e-3
    assert np.array_equal(reached[:, 3], q[:, 3])
    assert np.abs(world.tool_in_base(q) - perfect().tool_in_base(reached)).max() < 1e-12


def test_joints_that_are_too_soft_are_refused() -> None:
    with pytest.raises(BadRobot, match="joint elbow_joint: is too soft"):
        perfect(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])).settle(postures())


def test_a_bump_displaces_the_tool_by_exactly_so_much() -> None:
    world, q = perfect(T_tip_tool=se3.exp([0.1, 0.0, 0.2, 0.3, -0.2, 0.1])), postures()
    before = world.tool_in_tracker(q)
    move, turn = np.array([1e-3, -2e-3, 5e-4]), np.array([0.01, 0.02, -0.03])
    world.bump(move, turn)
    by = se3.inverse(before) @ world.tool_in_tracker(q)
    assert np.abs(by - se3.transform(so3.exp(turn), move)).max() < 1e-12
    world.bump(np.zeros(3))
    assert np.array_equal(world.tool_in_tracker(q), before)


def test_a_tracker_that_moves_sees_all_move_the_other_way() -> None:
    world = make_world(CHAIN, np.random.default_rng(2), 5e-4, 1e-3)
    q = postures()
    before, in_base = world.tool_in_tracker(q), world.tool_in_base(q)
    world.move_tracker([0.01, 0.02, -0.03])
    after = world.tool_in_tracker(q)
    assert np.abs(after[:, :3, 3] - before[:, :3, 3] + [0.01, 0.02, -0.03]).max() < 1e-14
    assert np.array_equal(after[:, :3, :3], before[:, :3, :3])
    assert np.array_equal(world.tool_in_base(q), in_base)


def test_a_link_grows_along_itself() -> None:
    world, q = perfect(), postures()
    before = world.tool_in_base(q)
    world.grow("upper_arm_link", 3e-4)
    moved = (world.tool_in_base(q) - before)[:, :3, 3]
    model = Pinocchio(urdf("ur10"), CHAIN).model
    data = model.createData()
    for row, by in zip(q, moved, strict=True):
        pin.forwardKinematics(model, data, row)
        along = data.oMi[3].translation - data.oMi[2].translation
        assert np.abs(by - 3e-4 * along / np.linalg.norm(along)).max() < 1e-12
    world.grow("upper_arm_link", 0.0)
    assert np.array_equal(world.tool_in_base(q), before)


def test_the_truth_of_a_seed_stays_what_it_was() -> None:
    """Recordings and figures were made with it."""
    world = make_world(CHAIN, np.random.default_rng(11), 5e-4, 1e-3)
    total = world.tool_in_tracker(np.random.default_rng(5).uniform(-2, 2, (5, 6))).sum()
    assert total == pytest.approx(-4.167326896173078, abs=1e-12)


def switches(world: World | None = None, **values: object) -> Switches:
    chosen = {name: SIMULATED_CELL[name].default for name in SWITCHES}
    return Switches(world or perfect(), {**chosen, **values})


def test_warming_up_is_exponential_and_so_is_cooling() -> None:
    world = perfect()
    before = world.tool_in_base(np.zeros(6))[:3, 3]
    s = switches(world, warm_up_link="forearm_link", warm_up_s=20.0)
    s.set("warm_up_m", 4e-4, 100.0)

    def grown(t: float) -> float:
        s.pass_to(t)
        return float(np.linalg.norm(world.tool_in_base(np.zeros(6))[:3, 3] - before))

    for t in (100.0, 105.0, 120.0, 300.0):
        assert grown(t) == pytest.approx(4e-4 * (1 - np.exp(-(t - 100.0) / 20.0)), abs=1e-13)
    link, kelvin = s.temperature(120.0) or ("", 0.0)
    assert link == "forearm_link"
    assert kelvin == pytest.approx(20.0 + 4e-4 * (1 - np.exp(-1)) / (23e-6 * world.length("forearm_link")))
    s.set("warm_up_m", 0.0, 120.0)
    for t in (120.0, 130.0, 170.0):
        assert grown(t) == pytest.approx(4e-4 * (1 - np.exp(-1)) * np.exp(-(t - 120.0) / 20.0), abs=1e-13)
    s.rebase(130.0, 0.0)
    assert grown(10.0) == pytest.approx(4e-4 * (1 - np.exp(-1)) * np.exp(-1.0), abs=1e-13)


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ({"tool_bump_m": [0.0, 0.1]}, "three finite numbers"),
        ({"tool_bump_m": [0.0, 0.1, np.nan]}, "three finite numbers"),
        ({"tool_bump_m": [0.9, 0.9, 0.0]}, "longer than 1"),
        ({"tool_turn_rad": [4.0, 0.0, 0.0]}, "longer than 3.142"),
        ({"tracker_move_m": [11.0, 0.0, 0.0]}, "longer than 10"),
        ({"payload_kg": np.nan}, "finite number"),
        ({"warm_up_m": 1e-4}, "warm_up_link must name"),
        ({"warm_up_link": "wing"}, "link 'wing'"),
        ({"warm_up_link": "shoulder_link"}, "no length"),
    ],
)
def test_values_that_make_no_sense(wanted: dict[str, object], said: str) -> None:
    assert said in (switches().refusal(wanted) or "")
    with pytest.raises(BadTable, match=next(iter(wanted))):
        switches(**wanted)


def test_velocity_is_the_derivative_of_position() -> None:
    """On the way, at rest, and when one program replaces another in the middle, where neither of the two jumps."""
    program = Program(np.zeros(6))
    program.reset(0.0, tour(CHAIN, 5, 0.6, 0.3, np.random.default_rng(1)))
    for now in (1.2, 1.9):
        q, v = program.state(now)
        assert np.abs(v).max() > 0.1
        program.reset(now, [(now + 0.1, np.full(6, 0.2)), (now + 1.0, np.full(6, -0.4))])
        q_after, v_after = program.state(now)
        assert np.array_equal(q_after, q)
        assert np.abs(v_after - v).max() < 1e-12
        for t in np.arange(now + 1e-3, now + 1.5, 7.3e-3):
            slope = (program.at(t + 1e-6) - program.at(t - 1e-6)) / 2e-6
            assert np.abs(program.state(t)[1] - slope).max() < 1e-4
        assert np.array_equal(program.at(now + 1.1), np.full(6, -0.4))


@pytest.mark.parametrize("rates", [(125.0, 50.0), (200.0, 1000.0)])
def test_a_reading_never_has_the_stamp_of_a_joint_state(rates: tuple[float, float]) -> None:
    """It would say that both are of a finished station."""
    fast, slow = Grid(rates[0]), Grid(rates[1], (2.0**0.5 - 1.0) * rates[1] / rates[0])
    joints, readings = [round(1e9 * t) for t in fast.take(60.0)], [round(1e9 * t) for t in slow.take(60.0)]
    assert len(joints) == pytest.approx(60.0 * rates[0], abs=1)
    assert len(readings) == pytest.approx(60.0 * rates[1], abs=2)
    assert not set(joints) & set(readings)
    assert not list(fast.take(60.0))


def command(*points: tuple[float, list[float]], names: tuple[str, ...] = CHAIN.names) -> JointTrajectory:
    message = JointTrajectory(joint_names=list(names))
    for at, positions in points:
        point = JointTrajectoryPoint(positions=positions)
        point.time_from_start.sec, point.time_from_start.nanosec = int(at), round(1e9 * (at % 1.0))
        message.points.append(point)
    return message


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (command((1.0, [0.0] * 6), names=("a", *CHAIN.names[1:])), "this arm has"),
        (command((1.0, [0.0] * 5)), "wrong positions"),
        (command((1.0, [0.0] * 5 + [np.nan])), "wrong positions"),
        (command((0.0, [0.0] * 6)), "not later"),
        (command((1.0, [0.0] * 6), (1.0, [0.1] * 6)), "point 1: is not later"),
        (command((1.0, [0.0, 0.0, 4.0, 0.0, 0.0, 0.0])), "outside the joint limits"),
    ],
)
def test_trajectories_that_are_not_followed(message: JointTrajectory, said: str) -> None:
    with pytest.raises(BadCommand, match=said):
        legs(CHAIN, message)


ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"


def loads(chain: Chain, text: str, legs: list[tuple[float, Array]]) -> tuple[Array, Array, float]:
    """(largest speed, largest torque, duration): shares of what the URDF states (n,), and seconds."""
    program = Program(np.zeros(chain.n))
    program.reset(0.0, legs)
    step = 0.01
    t = np.arange(0.0, program.end, step)
    q = np.array([program.at(x) for x in t])
    v = np.gradient(q, step, axis=0)
    a = np.gradient(v, step, axis=0)
    world = World(chain, np.random.default_rng(0), 0.0, 0.0, None, None, read_inertias(text, chain))
    drives, torque = read_drives(text, chain), np.empty_like(q)
    for i in range(len(t)):
        world.data.qpos[:], world.data.qvel[:], world.data.qacc[:] = q[i], v[i], a[i]
        mujoco.mj_inverse(world.model, world.data)
        torque[i] = world.data.qfrc_inverse
    return np.abs(v).max(axis=0) / drives.speed, np.abs(torque).max(axis=0) / drives.torque, program.end


@pytest.mark.parametrize("robot", ["ur10", "panda"])
def test_no_leg_asks_more_of_the_drives_than_the_urdf_states(robot: str) -> None:
    text = (ROBOTS / f"{robot}.urdf").read_text()
    chain = read_chain(text)
    legs = tour(chain, 8, 0.5, 0.3, np.random.default_rng(3))
    slowed = within_limits(legs, np.zeros(chain.n), text, chain)
    assert slowed.overloads == ()
    assert [list(q) for _, q in slowed.legs] == [list(q) for _, q in legs]
    before, after = loads(chain, text, legs), loads(chain, text, slowed.legs)
    assert before[0].max() > 1.0
    assert after[0].max() <= 1.0
    assert after[1].max() <= 1.0
    # as slow as needed, no slower: some drive is near what it can do
    assert max(after[0].max(), after[1].max()) > 0.85
    assert before[2] < after[2] < 8.0 * before[2]


def test_what_no_slowness_helps_is_said() -> None:
    text = (ROBOTS / "ur10.urdf").read_text()
    chain = read_chain(text)
    legs = tour(chain, 8, 0.5, 0.3, np.random.default_rng(3))
    said = within_limits(legs, np.zeros(6), text, chain, payload=30.0).overloads[0]
    assert said.startswith("shoulder_lift_joint: gravity takes ")
    assert "of its effort of 330 on the way" in said


URDF = ROOT / "examples" / "robots" / "ur10.urdf"
NAMES = list(read_chain(URDF.read_text()).names)


def planned(*postures: tuple[float, list[float]]) -> dict[str, Any]:
    points = [
        {"positions": q, "velocities": [0.0] * len(q), "time_from_start": {"sec": int(t), "nanosec": int(t % 1 * 1e9)}}
        for t, q in postures
    ]
    return {"joint_names": NAMES, "points": points}


GOOD = planned((0.0, [0.02] * 6), (0.5, [0.02] * 6), (1.5, [0.3, -0.2, 0.1, 0.2, -0.1, 0.4]))


def test_a_trajectory_is_led_up_to() -> None:
    trajectory = trajectory_from_data(GOOD, "t")
    led = trajectory.led_up_to(np.zeros(6), 0.2, 0.1)
    assert led.t.tolist() == [0.5, 1.0, 2.0]
    far = trajectory.led_up_to(np.full(6, -0.5), 0.2, 1.0)
    assert far.t[0] == pytest.approx(1.5 * 0.52 / 0.2)  # a cubic's peak is half as much again as its mean
    with pytest.raises(BadCommand, match="0.1 is the limit: bring the arm to the first point"):
        trajectory.led_up_to(np.full(6, 0.5), 0.2, 0.1)
    with pytest.raises(BadCommand):
        trajectory.led_up_to(np.full(6, np.nan), 0.2, 0.1)


@pytest.mark.parametrize(
    "data",
    [
        None, [], "x", {}, {"joint_names": NAMES}, {"joint_names": NAMES, "points": []},
        {"joint_names": 3, "points": GOOD["points"]}, {"joint_names": NAMES[:5], "points": GOOD["points"]},
        {"joint_names": [*NAMES[:5], NAMES[0]], "points": GOOD["points"]},
        planned((0.0, [0.0] * 6), (0.0, [0.1] * 6)), planned((0.0, [0.0] * 5 + [float("nan")])),
        {"joint_names": NAMES, "points": [{"positions": [0.0] * 6}]},
        {"joint_names": NAMES, "points": [{"positions": "abcdef", "time_from_start": 3}]},
    ],
)  # fmt: skip
def test_what_is_no_trajectory_is_refused(data: Any) -> None:
    with pytest.raises(BadTable, match="t: "):
        trajectory_from_data(data, "t")


@pytest.mark.dds
def test_the_simulated_arm_goes_where_the_plan_says(tmp_path: Path) -> None:
    """One is sent and arrives; one that begins elsewhere, and one that nobody listens to, are refused."""
    domain = fresh_domain()
    (tmp_path / "good.yaml").write_text(yaml.safe_dump(GOOD))
    (tmp_path / "far.yaml").write_text(yaml.safe_dump(planned((0.0, [1.0] * 6), (1.0, [1.1] * 6))))
    remap = ("-r", "~/joint_trajectory:=joint_trajectory")
    cell = Process("simulated_cell", domain, tmp_path, urdf=URDF, joint_rate_hz=100.0, tracker_rate_hz=10.0)
    with running(cell):
        deaf = Process("trajectory_sender", domain, tmp_path, trajectory="good.yaml", patience_s=4.0)
        far = Process("trajectory_sender", domain, tmp_path, *remap, trajectory="far.yaml")
        with running(deaf, far):
            assert far.popen.wait(60.0) == 2
            assert deaf.popen.wait(60.0) == 2
        assert "from the first point, 0.1 is the limit" in far.output
        assert "no node subscribes to /trajectory_sender/joint_trajectory" in deaf.output
        good = Process("trajectory_sender", domain, tmp_path, *remap, trajectory="good.yaml")
        with running(good):
            assert good.popen.wait(60.0) == 0, good.output
        assert "3 points sent to /joint_trajectory" in good.output
        assert "arrived" in good.output
        assert cell.stop() == 0


SEED = 3


@pytest.mark.dds
def test_it_goes_where_it_is_sent_and_nowhere_else(tmp_path: Path) -> None:
    delta = nominal()
    goal = [0.4, -0.2, 0.6, 1.0]
    states: list[JointState] = []
    truths: list[PoseStamped] = []
    with beside(tmp_path, "simulated_cell", delta=FILE, seed=SEED, noise_m=0.0, noise_rad=0.0) as (cell, node, wait):
        node.create_subscription(JointState, "joint_states", states.append, 1000)
        node.create_subscription(PoseStamped, "simulated_cell/true_tool_in_base", truths.append, 1000)
        send = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
        wait(lambda: states and send.get_subscription_count(), 60.0)
        assert list(states[0].name) == list(delta.names)
        far = trajectory(delta.names, [2.0, -0.2, 0.6, 1.0])
        # again and again: the first may come before the cell has found who speaks
        wait(lambda: send.publish(far) or "lies outside the joint limits" in cell.output, 30.0)
        send.publish(trajectory(delta.names, goal))
        wait(lambda: np.allclose(states[-1].position, goal, rtol=0.0, atol=1e-12), 30.0)
        after = stamp(states[-1])
        wait(lambda: truths and stamp(truths[-1]) > after, 30.0)
        assert cell.stop() == 0
    true = make_delta_world(delta, np.random.default_rng(SEED), 5e-4, 1e-3).tool_in_base(goal)
    at = truths[-1].pose.position
    assert np.abs(np.array([at.x, at.y, at.z]) - true[:3, 3]).max() < 1e-9


@pytest.mark.dds
def test_a_tour_keeps_to_ways_that_its_platform_fits() -> None:
    delta = nominal()
    legs = tour(delta, 40, 0.5, 0.5, np.random.default_rng(0))
    stops = np.array([np.zeros(4), *(q for _, q in legs)])
    assert all(passable(delta, a, b) for a, b in pairwise(stops))
    assert len(np.unique(stops.round(9), axis=0)) == 41


def trajectory(names: tuple[str, ...], goal: list[float]) -> JointTrajectory:
    point = JointTrajectoryPoint(positions=goal)
    point.time_from_start.sec = 1
    return JointTrajectory(joint_names=list(names), points=[point])


def stamp(message: PointStamped | PoseStamped | JointState) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
