"""Unequal rods of a parallelogram: the platform stands where MuJoCo's six rods put it, and derivatives are right."""

from __future__ import annotations

import numpy as np
import pytest
from deltas import nominal, postures, record_delta
from finite_differences import assert_jacobian

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import PAIRS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.geometry import so3
from modcal_core.robots.delta import delta_from_data, delta_to_data
from modcal_core.robots.delta_kinematics import RODS, ROWS, frames
from modcal_nodes.simulation.delta_world import PLATFORM_RADIUS, ROD_SPACING, DeltaWorld

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
