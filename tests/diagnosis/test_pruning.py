"""What the final model does not need is taken out of it, and removal in closed form is what a fit without it gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from diagnosis.test_diagnosis import at_joint, recorded

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import Uncertainty, uncertainty, without
from modcal_core.calibration.fit import identify
from modcal_core.calibration.noise import as_normal, errors
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.diagnosis.pruning import is_nothing, joint_size, needless
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape

JOINT = "elbow_joint"
TRUE = Effect("gear_harmonic", JOINT, AXIS, f"position:{JOINT}", Shape("turn", {"cycles": 2.0}))
NOTHING = Effect("coupling", "wrist_1_joint", AXIS, f"position:{JOINT}", Shape("linear"))
TWIN = Effect("gear_harmonic", JOINT, AXIS, f"position:{JOINT}", Shape("turn", {"cycles": 2.0}))


def test_effects_that_are_nothing_or_stand_twice_are_taken_out() -> None:
    samples = recorded(3, at_joint(2, lambda q: 4e-4 * np.sin(2.0 * q[:, 2])))
    train, explain = samples.select(np.arange(100)), samples.select(np.arange(100, 160))
    cell = fit_cell(ur10(), train, Cell())
    choice = choose_parameters(cell.model, views_of(samples))
    started = tuple(e.started(np.full(n, 1e-4)) for e, n in ((TRUE, 2), (NOTHING, 1), (TWIN, 2)))
    fit = identify(cell.model.with_effects(started), train, choice.parameters)
    pruned, gone, known = needless(fit, train, explain, fit.noise)
    assert 1 in gone
    assert len(gone) == 2
    (left,) = pruned.model.effects
    assert left.key == TRUE.key
    assert abs(np.hypot(*left.amplitudes) - 4e-4) < 5e-5
    assert known is not None
    np.testing.assert_array_equal(
        known.covariance, uncertainty(pruned.model, train, pruned.parameters, pruned).covariance
    )
    removed = errors(without(pruned.model, known, [0]), explain).position_norm
    refitted = errors(identify(cell.model, train, choice.parameters).model, explain).position_norm
    assert abs(np.mean(removed**2) / np.mean(refitted**2) - 1.0) < 0.15
    assert needless(fit, train, explain, fit.noise, keep=3)[1:] == ((), None)


def test_amplitudes_that_trade_with_geometry_are_judged_together() -> None:
    """Two amplitudes of which only the sum is known: nothing each, and together ten standard deviations."""
    effect = replace(TRUE.started(np.array([1e-4, 1e-4])), std=np.full(2, 1e-3))
    known = Uncertainty((), 1e-6 * np.array([[1.0, -1.0], [-1.0, 1.0]]) + 1e-10 * np.ones((2, 2)))
    assert joint_size((effect,), 0, known) == pytest.approx(as_normal(100.0, 2), rel=1e-2)
    assert not is_nothing((effect,), 0, known)
    small = effect.with_values(np.array([1e-4, -1e-4]), effect.std)
    assert is_nothing((small,), 0, known)
