"""How large groups of values are likely to be, by the very data that they explain (empirical Bayes).

Values x of a group are normal about zero with one standard deviation σ, residuals are linear in them. Of all σ, and of
the noise, the likelihood of the data with x integrated out is greatest where

    σ² = Σ x² / γ,      γ = Σ (1 − V_ii / σ²),      s² = |r|² / (R − Σ γ)

over the values of the group, with V the covariance that the data leaves them: γ is how many numbers the data tells of
the group. These are taken one after the other until they agree (MacKay 1992, *Bayesian interpolation*; for groups
Tipping 2001), sizes a little farther than they ask for, which ends in fewer rounds at the same. A group of which the
data says nothing shrinks to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from modcal_core.calibration.fit import inverse_of_triangle
from modcal_core.geometry import Array

_MAX_ROUNDS = 30  # for time
_SETTLED = 0.05  # change of the logarithm of a size: predictions hardly depend on it
# Times the change that the equations ask for, in the logarithm: where little is told of a group each round takes a part
# of the way, and below 2 no size swings for ever (in two thirds of the rounds it ends nearer to where many lead)
_FARTHER = 1.8
# Numbers told of a group, below which it is as good as nothing where it shrinks, and what it grows by matters as much
# less: by a few per cent a round for ever, of a joint that hardly moves the tool
_NOTHING = 0.3


@dataclass(frozen=True)
class GroupSizes:
    """sizes: standard deviation of each group's values, zero where it is nothing. told: numbers that the data told of
    it. values: most likely ones of all, (K,). noise: the data's, in units of what it was taken for.
    """

    sizes: tuple[float, ...]
    told: tuple[float, ...]
    values: Array
    noise: float


def likely_sizes(
    H: Array, g: Array, square: float, rows: float, prior: Array, groups: Sequence[np.ndarray], begin: Sequence[float]
) -> GroupSizes:
    """The most likely sizes of groups of values.

    H, g, square: JᵀWJ (K, K), JᵀWr (K,) and rᵀWr of residuals about values of zero. rows: of r. prior: standard
    deviations (K,) of values in no group. groups: numbers of the values of each. begin: sizes to begin from.
    """
    std, sizes, told = np.array(prior), list(begin), [0.0] * len(groups)
    alive = [len(own) > 0 and size > 0.0 for own, size in zip(groups, sizes, strict=True)]
    for own, size in zip(groups, sizes, strict=True):
        std[own] = size
    noise, x = 1.0, np.zeros(len(std))
    used, own_H = np.arange(len(std)), H
    for _ in range(_MAX_ROUNDS):
        still = std[used] > 0.0
        if not still.all():
            used = used[still]
            own_H = H[np.ix_(used, used)]
        if not len(used):
            break
        d = std[used]
        A = own_H * (d[:, None] / noise**2)
        A *= d
        A.flat[:: len(A) + 1] += 1.0
        lower, failed = scipy.linalg.lapack.dpotrf(A.T, lower=1, clean=0, overwrite_a=1)
        if failed:  # the data leave no noise to weigh sizes against
            return GroupSizes((0.0,) * len(groups), (0.0,) * len(groups), np.zeros(len(std)), noise)
        x = np.zeros(len(std))
        x[used] = d * scipy.linalg.lapack.dpotrs(lower, d * g[used] / noise**2, lower=1)[0]
        told_each = np.zeros(len(std))
        half = inverse_of_triangle(lower)
        told_each[used] = 1.0 - np.einsum("ij,ij->j", half, half)
        left = square - 2.0 * float(x @ g) + float(x @ H @ x)
        new = float(np.sqrt(max(left, 0.0) / max(rows - float(told_each.sum()), 1.0)))
        change = abs(np.log(max(new, 1e-12) / noise))
        noise = max(new, 1e-12)
        for i, own in enumerate(groups):
            if not alive[i]:
                continue
            told[i] = float(told_each[own].sum())
            size = float(np.sqrt(x[own] @ x[own] / max(told[i], 1e-12)))
            if (told[i] < _NOTHING and size < sizes[i]) or not size > 0.0:
                alive[i], size, told[i] = False, 0.0, 0.0
            else:
                farther = float(np.log(size / sizes[i]))
                change = max(change, abs(farther) * min(told[i] / _NOTHING, 1.0))
                size = sizes[i] * float(np.exp(_FARTHER * farther))
            sizes[i] = size
            std[own] = size
        if change <= _SETTLED:
            break
    return GroupSizes(tuple(sizes), tuple(told), x, noise)
