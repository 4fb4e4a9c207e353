"""A Delta against MuJoCo's closed chains and six rods, differences, and itself backwards; and what it refuses."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from deltas import FILE, nominal, postures, record_delta
from finite_differences import assert_jacobian

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import PAIRS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import BadRobot, BadTable, NotReachable
from modcal_core.files import to_yaml
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.delta import OFFSET, Delta, delta_from_data, delta_to_data
from modcal_core.robots.delta_kinematics import (
    RODS,
    ROWS,
    delta_inverse,
    forward,
    frames,
    looseness,
    payload_wrench,
    position_jacobians,
    reachable,
    stretch,
    tool_pose,
)
from modcal_core.robots.mechanism import passable
from modcal_nodes.io.inputs import read_delta
from modcal_nodes.simulation.delta_world import PLATFORM_KG, PLATFORM_RADIUS, ROD_SPACING, DeltaWorld, displaced

GRAVITY = 9.80665


both = pytest.mark.parametrize("linear", [False, True])


def odd(shaft: bool = True, size: float = 1.0, linear: bool = False) -> Delta:
    """A Delta whose constants are all different; its towers lean, where it has some."""
    drawn = nominal(shaft, linear)
    return displaced(
        drawn.with_vector(np.r_[drawn.vector[:-3], 0.2, -0.1, 0.4]), np.random.default_rng(3), 5e-3 * size, 0.01 * size
    )


@both
@pytest.mark.parametrize("shaft", [True, False])
def test_forward_is_where_closed_chains_of_mujoco_meet(shaft: bool, linear: bool) -> None:
    delta = odd(shaft, linear=linear)
    q = postures(delta, 40)
    true = DeltaWorld(delta).tool_in_base(q)
    assert np.abs(true - tool_pose(delta, q)).max() < 1e-10
    # the platform of six rods stays upright by itself, wherever it is
    assert np.ptp(true[:, 2, 3]) > 0.2


@both
def test_inverse_undoes_forward(linear: bool) -> None:
    delta = odd(linear=linear)
    for q in postures(delta, 100):
        T = forward(delta, q)
        back = delta_inverse(delta, T[:3, 3], np.arctan2(T[1, 0], T[0, 0]))
        assert np.abs(back - q).max() < 1e-9


@both
def test_jacobians_are_derivatives(linear: bool) -> None:
    delta = odd(linear=linear)
    q = postures(delta, 2)
    p, by_parameters, by_joints = position_jacobians(delta, q)
    assert np.abs(p - tool_pose(delta, q)[:, :3, 3]).max() < 1e-15
    for k in range(len(q)):
        assert_jacobian(lambda X: tool_pose(delta.with_vector(X), q[k])[:3, 3], by_parameters[k], delta.vector)  # noqa: B023
        assert_jacobian(lambda x: tool_pose(delta, x)[:3, 3], by_joints[k], q[k])


@both
def test_weight_on_the_platform_is_what_mujoco_holds(linear: bool) -> None:
    delta = odd(linear=linear)
    q = postures(delta, 20)
    world = DeltaWorld(delta)
    world.carry(3.0)
    torque = payload_wrench(delta, q, GRAVITY * (PLATFORM_KG + 3.0))[:, 2 if linear else 5].T
    motors = torque[:, :3] * delta.constants[1]  # an arm's torque, as its motor feels it
    assert np.abs(world.holding(q)[:, :3] + motors).max() < 1e-7
    assert np.abs(motors).max() > 1.0


@pytest.mark.parametrize(
    ("position", "said"),
    [
        ([0.0, 0.0, -1.5], "mm too far away for arm arm_1"),
        ([0.0, 0.0, -0.1], "mm too near for arm arm_1"),
        ([0.3, 0.0, -1.0], "rad beyond its limits"),
        ([0.5, 0.0, -0.5], "mm too far away for tower tower_2"),
        ([0.1, 0.0, 0.2], " m beyond its limits"),
    ],
)
def test_inverse_says_what_is_out_of_reach_and_by_how_much(position: list[float], said: str) -> None:
    with pytest.raises(NotReachable, match=said):
        delta_inverse(nominal(linear="tower" in said or said.startswith(" m")), position)


def test_forward_says_that_no_platform_fits_and_by_how_much() -> None:
    wide = Delta.build(["a", "b", "c"], offset=0.5, proximal=0.3, distal=0.7)
    with pytest.raises(NotReachable, match="100.0 mm too short") as refused:
        forward(wide, np.zeros((1, 3)))
    assert abs(refused.value.position - 0.1) < 1e-9
    assert "a 0.000, b 0.000, c 0.000" in str(refused.value)


def test_a_loose_platform_is_refused() -> None:
    """With the rods all but level the weight of a feather moves the platform: no forward kinematics is worth having."""
    delta = Delta.build(["a", "b", "c"], offset=0.5, proximal=0.3, distal=0.80005)
    assert looseness(frames(delta, np.zeros((1, 3))))[0] < 0.05
    with pytest.raises(NotReachable, match="the platform is loose"):
        forward(delta, np.zeros(3))
    assert not reachable(delta, np.zeros((1, 3)))[0]


def test_a_stretched_arm_is_refused_and_moves_nothing() -> None:
    drawn = nominal(shaft=False)
    offset, proximal, distal = drawn.constants[3:, 0]
    delta = Delta.build(drawn.names, offset, proximal, distal, lower=[-3.0] * 3, upper=[3.0] * 3)
    along = np.array([np.cos(1.9), 0.0, -np.sin(1.9)])

    def short_of_stretched(gap: float) -> Array:
        return np.array([offset, 0.0, 0.0]) + (proximal + distal - gap) * along

    with pytest.raises(NotReachable, match="arm arm_1 is 0.78 degrees from in line with its rod"):
        delta_inverse(delta, short_of_stretched(2e-5))
    q = delta_inverse(delta, short_of_stretched(1e-4))[None]
    far = delta_inverse(delta, short_of_stretched(0.2))[None]
    pull = [np.linalg.norm(position_jacobians(delta, at)[2][0, :, 0]) for at in (q, far)]
    assert pull[0] < 0.15 * pull[1]
    assert stretch(delta, frames(delta, q))[0, 0] < 0.05


def test_ways_between_postures() -> None:
    """Arms that all point outwards leave no room for a platform; above and below there is."""
    delta = Delta.build(["a", "b", "c"], offset=0.5, proximal=0.3, distal=0.7, lower=[-2.0] * 3, upper=[2.0] * 3)
    up, down = np.full(3, -1.2), np.full(3, 1.2)
    assert reachable(delta, np.stack([up, down])).all()
    assert passable(delta, down, down - 0.2)
    assert not passable(delta, up, down)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"names": ["a", "b"]}, "three arms"),
        ({"names": ["a", "b", "a"]}, "three arms"),
        ({"proximal": 300.0}, "0.001 to 10 m"),
        ({"distal": [0.8, np.nan, 0.8]}, "not finite"),
        ({"ratio": [1.0, 0.0, 1.0]}, "moves nothing"),
        ({"azimuth": [0.0, 0.1, 2.0]}, "5.7 degrees apart"),
        ({"lower": [0.0, 0.0, 1.0], "upper": [1.0, 1.0, 1.0]}, "not below its upper"),
        ({"lower": [0.0, 0.0]}, "limits must be 3"),
        ({"tool": [0.0] * 5}, "tool must be 6"),
    ],
)
def test_what_is_no_delta(changes: dict[str, object], said: str) -> None:
    given: dict[str, object] = {"names": ["a", "b", "c"], "offset": 0.15, "proximal": 0.3, "distal": 0.8}
    with pytest.raises(BadRobot, match=said):
        Delta.build(**{**given, **changes})  # type: ignore[arg-type]


# the file

STATED: dict[str, Any] = yaml.safe_load(FILE.read_text())


@both
def test_a_delta_comes_back_from_its_file_as_it_was(tmp_path: Path, linear: bool) -> None:
    delta = displaced(nominal(linear=linear), np.random.default_rng(0), 1e-3, 1e-3)
    file = tmp_path / "delta.yaml"
    file.write_text(to_yaml(delta_to_data(delta)))
    again = read_delta(file)
    assert again.names == delta.names
    q = postures(delta, 10)
    assert np.array_equal(tool_pose(again, q), tool_pose(delta, q))
    assert np.array_equal(again.lower, delta.lower)


def test_radii_or_their_difference() -> None:
    by_offset = deepcopy(STATED)
    del by_offset["arms"]["fixed_radius_m"], by_offset["arms"]["platform_radius_m"]
    by_offset["arms"]["offset_m"] = 0.15
    a, b = delta_from_data(STATED, "a"), delta_from_data(by_offset, "b")
    assert np.allclose(a.constants, b.constants, rtol=0.0, atol=1e-15)
    assert np.allclose(a.constants[OFFSET], 0.15)


@pytest.mark.parametrize(
    ("part", "changes", "said"),
    [
        ("", {"modcal_delta": 2}, "modcal_delta: 2 is not one of 1"),
        ("", {"joints": "arm"}, "joints: 'arm' is not a list"),
        ("", {"colour": 1.0}, "unknown key colour"),
        ("arms", {"distal_m": None}, "arms: 'distal_m' is not stated"),
        ("arms", {"platform_radius_m": None}, "offset_m, or both"),
        ("arms", {"offset_m": 0.15}, "offset_m, or both"),
        ("arms", {"proximal_m": [0.3, 0.3]}, "proximal_m: it has 2 entries, 3 are allowed"),
        ("limits_rad", {"knee": [0.0, 1.0]}, "knee is no joint of it"),
        ("limits_rad", {"arm_1": [0.0]}, "arm_1: it has 1 entries, 2 are allowed"),
        ("limits_m", {"arm_1": [0.0, 1.0]}, "arm_1 turns"),
        ("", {"towers": {"distal_m": 0.6}}, "either arms, which turn, or towers"),
    ],
)
def test_what_is_not_understood_is_named(part: str, changes: dict[str, Any], said: str) -> None:
    data = deepcopy(STATED)
    (data.setdefault(part, {}) if part else data).update(changes)
    with pytest.raises(BadTable, match=said):
        delta_from_data(data, "delta.yaml")


APART = np.array([6e-4, -6e-4, 3e-4])


def twists(difference: np.ndarray, more: float, count: int) -> dict[int, np.ndarray]:
    """What the arms' places have in common with rods that differ by this, per spacing."""
    out = {}
    for i, e in enumerate(difference):
        out[1 + i] = np.zeros((ROWS, count))
        out[1 + i][RODS], out[1 + i][RODS + 1] = e, e * more
    return out


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("shaft", [True, False])
def test_the_platform_stands_where_six_rods_put_it(stated: bool, shaft: bool) -> None:
    """The radius as the file states it, or as an effect brings it."""
    delta = nominal(shaft)
    q = postures(delta, 30)
    world = DeltaWorld(delta, np.eye(4), delta.T_tip_tool, unequal=APART)
    true = world.tool_in_tracker(q)
    known = PLATFORM_RADIUS if stated else 0.0
    robot = delta_from_data({**delta_to_data(delta), "arms": arms(delta, known)}, "test")
    assert robot.platform_radius == pytest.approx(known)
    f = frames(robot, q, twists(APART / (2.0 * ROD_SPACING), PLATFORM_RADIUS - known, len(q)), delta.T_tip_tool)
    assert np.abs(f.p[-1].T - true[:, :3, 3]).max() < 1e-6  # by rigid pairs it would be 1.7 mm
    turn = so3.log(np.swapaxes(f.rotation(-1), 1, 2) @ true[:, :3, :3])
    assert np.abs(turn).max() < 1e-6


def arms(delta: object, radius: float) -> dict[str, object]:
    data = dict(delta_to_data(delta)["arms"])  # type: ignore[arg-type]
    data.pop("platform_radius_m", None)
    return data | ({"platform_radius_m": radius} if radius else {})


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["point", "pose"])
def test_derivatives_by_rods_and_radius(kind: str) -> None:
    cell = record_delta(2, 12, kind)
    model = fit_cell(cell.nominal, cell.samples, Cell()).model
    shape = Shape("pairs", {"radius": 0.06, "known_radius": 0.05, "x": 0.02, "y": -0.03, "z": -0.1})
    effect = Effect("parallelogram", "tool", PAIRS, "constant", shape).with_values(
        [7e-3, -8e-3, 5e-3, 0.06, 0.02, -0.03, -0.1]
    )
    wobble = Effect("axis_wobble", "arm_1", "across", "position:arm_1", Shape("turn", {"cycles": 1.0})).with_values(
        np.zeros(4)
    )
    start = model.with_effects((effect, wobble))
    parameters = choose_parameters(model, views_of(cell.samples)).parameters
    values = np.r_[1e-4 * np.arange(len(parameters)) / 10.0, effect.values, wobble.values]
    at, N = linearise(start, parameters, values, cell.samples), 3 * len(cell.samples)
    moving = np.array([p.place != 0 for p in parameters] + [True] * (len(values) - len(parameters)))

    def positions(x: np.ndarray) -> np.ndarray:
        whole = values.copy()
        whole[moving] = x
        return -linearise(start, parameters, whole, cell.samples, jacobian=False).position.ravel()

    assert_jacobian(positions, at.J[moving, :N].T, values[moving], tolerance=2e-6)
