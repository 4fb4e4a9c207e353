"""What is left grows away from the recorded postures, as far as it is a smooth function of posture.

Scatter that joints do not repeat is the same anywhere. What no arm near the calibrated one explains may be smooth: then
neighbours miss by the same, and what stations do not show of it grows in proportion to the distance to the nearest.
Each draw of the arm is asked, for a fit takes correlation away. As likely as not beforehand, nothing of it is smooth:
it has to show.
"""

from __future__ import annotations

import numpy as np
import scipy

from modcal_core.calibration import RowView, block_length, independent_unit, linearise
from modcal_core.claim.neighbourhood import Neighbourhood, joint_motion
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import dimensions

_MOST = 400  # stations that are compared with each other
_SAME = 1e-6  # m; postures that are closer are one


def growth(about: Neighbourhood, drawn: Array, samples: Samples, q: Array, rng: np.random.Generator) -> Array:
    """How many times larger what is left is at postures q (M, n) than at these samples', (D, M), 1 or more.

    drawn: values of the true arm less those of the calibrated model (D, K). Postures are as far from each other as
    joints one by one move the tool between.
    """
    rows = np.unique(independent_unit(samples), return_index=True)[1][:: block_length(samples)]
    some = samples.select(rows[spread_rows(len(rows), _MOST)])
    N, model = len(some), about.model
    view = RowView.of(model, some, model.drivers(some))
    motions = [joint_motion(view, model.chain, j)[: 3 * N] for j in range(model.chain.n)]
    lever = np.sqrt((np.array(motions) ** 2).sum(axis=1) / N)
    x = some.q * lever
    apart = _distances(x, x)
    apart[apart < _SAME] = np.inf
    at = linearise(model, about.parameters, about.values, some)
    left = (at.residual[: 3 * N] - drawn @ at.J[:, : 3 * N]).reshape(len(drawn), 3, N)
    for kind in some.kinds:  # each in its unit
        left[:, :, some.kind == kind] /= max(float(np.sqrt(np.mean(left[:, :, some.kind == kind] ** 2))), 1e-300)
    near = apart.argmin(axis=1)
    alike = np.einsum("dij,dij->d", left, left[:, :, near]) / (3 * N)
    smooth = _smooth(alike, float(np.sqrt((1.0 + np.mean(near[near] == np.arange(N))) / dimensions(some).sum())), rng)
    farther = np.maximum(_distances(q * lever, x).min(axis=1) / np.median(apart.min(axis=1)), 1.0)
    return np.asarray(np.sqrt(1.0 + smooth[:, None] * (farther**2 - 1.0)))


def _smooth(alike: Array, std: float, rng: np.random.Generator) -> Array:
    """Shares of what is left that are smooth, (D,), where neighbours are found to be as much alike, to a deviation."""
    low, high = (scipy.special.ndtr((end - alike) / std) for end in (0.0, 1.0))
    none = np.exp(-0.5 * (alike / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
    share = alike + std * scipy.special.ndtri(low + (high - low) * rng.random(len(alike)))
    return np.where(rng.random(len(alike)) * (high - low + none) < high - low, np.clip(share, 0.0, 1.0), 0.0)


def _distances(a: Array, b: Array) -> Array:
    """Between rows (A, n) and (B, n), (A, B)."""
    return np.asarray(np.sqrt(sum(np.subtract.outer(x, y) ** 2 for x, y in zip(a.T, b.T, strict=True))))
