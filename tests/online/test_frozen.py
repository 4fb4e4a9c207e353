"""Single samples, quickly seen, say what the linearisation of all of them says."""

from __future__ import annotations

import numpy as np
import pytest
from calibration.test_linearise import SHIFT, TURN, cell
from cells import slider_arm, ur10

from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.parameters import ordered_candidates
from modcal_core.calibration.structure import views_of
from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.online.estimator import FixedLinearisation
from modcal_core.robots.chain import Chain


@pytest.mark.parametrize("chain", [ur10(), slider_arm()], ids=["ur10", "sliders"])
@pytest.mark.parametrize("bent", [False, True], ids=["geometry", "effect"])
def test_rows_are_those_of_all_samples_at_once(chain: Chain, bent: bool) -> None:
    model, samples = cell(chain, ("pose", "point", "pose"))
    parameters = ordered_candidates(chain, model.frames, views_of(samples))
    x = np.random.default_rng(2).normal(size=len(parameters)) * [TURN if p.turns else SHIFT for p in parameters]
    if bent:
        joint = chain.names[2]
        bend = Effect("gear_ratio", joint, "axis", f"position:{joint}", Shape("linear")).started(np.array([1e-3]))
        model, x = model.with_effects((bend,)), np.r_[x, 2e-3]
    at = linearise(model, parameters, x, samples)
    frozen = FixedLinearisation(model, parameters, x)
    N, turned = len(samples), np.cumsum(samples.is_pose) - 1
    M = int(samples.is_pose.sum())
    for i in range(N):
        rows = [i, N + i, 2 * N + i]
        if samples.is_pose[i]:
            rows += [3 * N + k * M + turned[i] for k in range(3)]
        residual, J = frozen(samples.select(np.array([i])))
        assert np.abs(residual - at.residual[rows]).max() < 1e-12
        assert np.abs(J - at.J[:, rows].T).max() < 1e-12
