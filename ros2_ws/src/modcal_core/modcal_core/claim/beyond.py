"""What is left grows away from the recorded postures, as far as it is a smooth function of posture.

Scatter that joints do not repeat is the same anywhere. What a model misses smoothly is as large as its residuals where
stations stand as close as the recorded ones, and grows with the distance to the nearest. It is seen where neighbours
miss by the same: with a correlation exp(-h / L), what is smooth over their distance h is at most e times as much.
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration import Model, RowView, block_length, errors, independent_unit
from modcal_core.claim.neighbourhood import joint_motion
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows

_MOST = 400  # stations that are compared with each other
_SAME = 1e-6  # m; postures that are closer are one


def growth(model: Model, samples: Samples, q: Array, z: Array) -> Array:
    """How many times larger what is left is at postures q (M, n) than at these samples', in draws (D, M), 1 or more.

    z: standard normal numbers (D,). Postures are as far from each other as joints one by one move the tool between.
    """
    rows = np.unique(independent_unit(samples), return_index=True)[1][:: block_length(samples)]
    some = samples.select(rows[spread_rows(len(rows), _MOST)])
    view = RowView.of(model, some, model.drivers(some))
    motions = [joint_motion(view, model.chain, j)[: 3 * len(some)] for j in range(model.chain.n)]
    lever = np.sqrt((np.array(motions) ** 2).sum(axis=1) / len(some))
    x = some.q * lever
    apart = _distances(x, x)
    apart[apart < _SAME] = np.inf
    left = errors(model, some).position
    alike = (left * left[apart.argmin(axis=1)]).sum() / max((left**2).sum(), 1e-300) + z / np.sqrt(left.size)
    smooth = np.clip(np.e * alike, 0.0, 1.0)
    farther = np.maximum(_distances(q * lever, x).min(axis=1) / np.median(apart.min(axis=1)), 1.0)
    return np.asarray(np.sqrt(1.0 + smooth[:, None] * (farther**2 - 1.0)))


def _distances(a: Array, b: Array) -> Array:
    """Between rows (A, n) and (B, n), (A, B)."""
    return np.asarray(np.sqrt(sum(np.subtract.outer(x, y) ** 2 for x, y in zip(a.T, b.T, strict=True))))
