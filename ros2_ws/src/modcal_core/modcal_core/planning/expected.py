"""The claim to be expected of stations that are planned: that of an arm as usual ones are, measured there in numbers.

Its links are off by usual errors, joints and instrument scatter as the site says; the geometry is fitted, and claimed
by the same code as of any calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    Model,
    ModelParameter,
    apply_deviations,
    deviations,
    exact_samples,
    fit_geometry,
)
from modcal_core.claim import USUAL_ANGLE_RAD, USUAL_LENGTH_M, Claim, claim_at_tool
from modcal_core.geometry import Array, so3
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.planning.site import Noise

_SEED = 11  # the same arm every time, so that sets of stations are compared on equal terms
_POSTURES = 200  # for time


def expected_claim(
    model: Model, parameters: Sequence[ModelParameter], q: Array, kind: str, noise: Noise, where: Array
) -> Claim:
    """The claim over postures ``where`` (M, n) of a calibration from stations q (N, n), read as points or poses.

    model: the nominal arm, with its one frame and tool. parameters: that are fitted.
    """
    rng = np.random.default_rng(_SEED)
    usual = np.array([USUAL_LENGTH_M if p.unit == "m" else USUAL_ANGLE_RAD for p in parameters])
    sizes = usual * rng.standard_normal(len(parameters)) * [p.of_arm for p in parameters]
    true = apply_deviations(model, deviations(model, parameters, sizes))
    N, turning = len(q), model.chain.revolute
    repeat = np.where(turning, noise.joint_turn, noise.joint_slide)
    frame, kinds = np.zeros(N, dtype=int), np.full(N, kind, dtype=KIND_NAMES)
    read = exact_samples(true, q + repeat * rng.standard_normal(q.shape), frame, kinds)
    scatter = noise.position + noise.per_metre * np.linalg.norm(read.reading, axis=1)
    samples = replace(
        read,
        q=q,
        reading=read.reading + scatter[:, None] * rng.standard_normal((N, 3)),
        R=read.R @ so3.exp(noise.rotation * rng.standard_normal((N, 3))),
    )
    fit = fit_geometry(model, samples, parameters, Cell())
    made = Calibration(model, fit.model, fit.model, np.stack([q.min(axis=0), q.max(axis=0)]), noise=fit.noise)
    return claim_at_tool(made, samples, Cell(), where[:_POSTURES])
