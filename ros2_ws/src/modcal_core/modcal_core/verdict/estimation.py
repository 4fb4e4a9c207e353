"""What the parameters' own covariance costs at the postures that are scored."""

from __future__ import annotations

import numpy as np

from modcal_core.measurements import spread_rows
from modcal_core.verdict.case import Case, derivatives

_MAX = 400  # scored samples; the mean over more is the same


def estimation(case: Case) -> tuple[float, float]:
    """Mean squared error at the tool that the parameters' covariance makes: position [mm²], orientation [deg²].

    The trace of J C Jᵀ at the scored postures.
    """
    if not len(case.held_out):
        return 0.0, 0.0
    rows = case.held_out[spread_rows(len(case.held_out), _MAX)]
    samples = case.samples.select(rows)
    _, J = derivatives(case.model, case.known.parameters, samples)
    K = len(J)
    if not K:  # nothing is known of its own error, as of one that cameras made
        return 0.0, 0.0
    moved = (case.known.covariance @ J.reshape(K, -1)).reshape(J.shape)
    variance = np.einsum("kcn,kcn->c", J, moved)
    poses = int(samples.is_pose.sum())
    position = 1e6 * float(variance[:3].sum()) / len(samples)
    rotation = float(np.degrees(np.degrees(variance[3:].sum()))) / poses if poses else 0.0
    return position, rotation
