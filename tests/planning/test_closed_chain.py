"""The closed chain against arms written out by hand, against MuJoCo's arm, and against the calibration's derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from cells import record, slider_arm, ur10
from finite_differences import assert_jacobian
from planning.arms import POINT, dh_point, irb1410, irb1410_table

from modcal_core.calibration.linearisation import model_at
from modcal_core.calibration.parameters import View
from modcal_core.calibration.structure import choose_parameters
from modcal_core.errors import BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.planning.closed_chain import (
    ClosedChain,
    calibration_chain,
    dh_closed_chain,
    one_frame_model,
    sizes_of,
)
from modcal_core.planning.sensitivity_study import sobol_postures
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward


def test_errors_move_the_point_as_in_an_arm_written_by_hand(rng: np.random.Generator) -> None:
    table, closed = irb1410_table(), dh_closed_chain(irb1410(), point=POINT)
    q = sobol_postures(irb1410(), 6, rng)

    def point(x: Array) -> Array:
        named = dict(zip(closed.names, x, strict=True))
        return np.concatenate([dh_point(table, posture, named, POINT) for posture in q])

    assert_jacobian(point, closed.jacobian(q)[:, :3].reshape(-1, 33), np.zeros(33), step=1e-3)


@pytest.mark.parametrize("kind", ["point", "pose"])
@pytest.mark.parametrize("chain", [ur10(), slider_arm(), irb1410()], ids=["ur10", "sliders", "irb1410"])
def test_what_calibrate_fits_moves_its_model(chain: Chain, kind: str, rng: np.random.Generator) -> None:
    T, tool = se3.exp([0.4, -0.2, 0.3, 0.5, 0.1, -0.7]), se3.exp([0.1, 0.05, 0.2, 0.4, -0.3, 0.2])
    closed, model = calibration_chain(chain, T, tool, kind), one_frame_model(chain, T, tool)
    parameters = choose_parameters(model, (View(kind, 0),)).parameters
    q = sobol_postures(chain, 4, rng)

    def point(x: Array) -> Array:
        return model_at(model, parameters, x).predict(q)[:, :3, 3].ravel()

    P = len(parameters)
    assert closed.names == tuple(p.name for p in parameters)
    assert_jacobian(point, closed.jacobian(q)[:, :3].reshape(-1, P), np.zeros(P), step=1e-3)
    turned = np.array([[T @ chain_forward(chain, q)[i] @ tool for i in range(4)]])[0]
    axis = closed.jacobian(q)[:, 3:]
    step = 1e-5 * np.eye(P)
    for k in range(P):
        R = model_at(model, parameters, step[k]).predict(q)[:, :3, :3]
        assert np.abs(so3.log(R @ turned[:, :3, :3].transpose(0, 2, 1)) / 1e-5 - axis[..., k]).max() < 1e-4


def test_an_arm_of_mujoco_is_met_by_what_calibrate_fits_and_not_by_dh() -> None:
    """Axes 2 and 3 are parallel: a tilt between them out of the drawing's plane has no DH parameter."""
    made = record(5, 60, "point", irb1410(), length_std=1e-5, angle_std=1e-5)
    T = made.world.tool_in_tracker(made.samples.q)
    T_tip_tool = se3.exp(np.r_[0.05, 0.03, 0.12, np.random.default_rng(5).normal(size=9)[6:]])
    tool = se3.transform(p=T_tip_tool[:3, 3])

    nominal = se3.apply(made.world.T_tracker_base @ chain_forward(irb1410(), made.samples.q), tool[:3, 3])

    def left(closed: ClosedChain) -> float:
        P = len(closed.factors)
        gap = (T[:, :3, 3] - nominal).ravel()
        J = closed.jacobian(made.samples.q)[:, :3].reshape(-1, P)
        return float(np.abs(gap - J @ np.linalg.lstsq(J, gap, rcond=1e-10)[0]).max())

    assert left(calibration_chain(irb1410(), made.world.T_tracker_base, tool)) < 5e-9
    assert left(dh_closed_chain(irb1410(), made.world.T_tracker_base, tool[:3, 3])) > 1e-6


def test_sizes_by_name_and_pattern() -> None:
    closed = dh_closed_chain(irb1410())
    sizes = sizes_of(closed, 5e-4, 1e-3, {"point/*": 0.0, "joint_3/a": 2e-3})
    by_name = dict(zip(closed.names, sizes, strict=True))
    assert (by_name["point/y"], by_name["joint_3/a"], by_name["joint_2/a"], by_name["base/rx"]) == (0, 2e-3, 5e-4, 1e-3)
    with pytest.raises(BadTable, match="matches no parameter"):
        sizes_of(closed, 5e-4, 1e-3, {"joint_9/a": 1.0})
    with pytest.raises(BadTable, match="at least 0 is needed"):
        sizes_of(closed, -1.0, 1e-3)
