"""What the data can tell: rank, condition, and by name the combinations that it leaves open.

A direction counts as observed when the data alone fixes it better than the prior does, that is better than 10 mm or
20 mrad. With every parameter measured in units of its prior deviation, the eigenvalues of the data's information are
(prior deviation / data deviation)², so the line is drawn at one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.identify import Fit
from modcal_core.geometry.so3 import Array

_NAMED = 0.3  # share of a direction (of unit length) above which a parameter is named as part of it
_FEW_NAMED = 3  # parameters that are named where none is that large
_WEAK = 0.2  # of the prior's deviation, above which a combination that is seen counts as hardly seen
_MAX_WEAK = 5  # named in one report


@dataclass(frozen=True)
class Identifiability:
    """parameters: how many were fitted. rank: how many combinations the data shows. condition: ratio of the largest to
    the smallest singular value of the observed part, columns scaled to unit length. unobservable: the rest, by name.
    deviations: of every combination its deviation by the data alone, in deviations of the prior, the best known first.
    weak: those that are observed, but hardly: their names and spreads, the weakest first.
    """

    parameters: int
    rank: int
    condition: float
    unobservable: tuple[str, ...]
    deviations: tuple[float, ...] = ()
    weak: tuple[tuple[str, float], ...] = ()


def identifiability(fit: Fit) -> Identifiability:
    """Rank, condition and unobservable combinations of a fit."""
    prior = np.array([p.expected if np.isfinite(p.expected) else 1.0 for p in fit.parameters])
    value, vector = np.linalg.eigh(fit.information * np.outer(prior, prior))
    seen = value >= 1.0
    rank = int(seen.sum())
    names = [_name(v, fit) for v in vector[:, ~seen].T]
    deviations = 1.0 / np.sqrt(np.maximum(value, 1e-300))
    hardly = [k for k in np.flatnonzero(seen) if deviations[k] > _WEAK][:_MAX_WEAK]
    weak = tuple((_name(vector[:, k], fit), float(deviations[k])) for k in hardly)
    size = np.sqrt(np.maximum(np.diag(fit.information), 1e-300))
    scaled = np.linalg.eigvalsh(fit.information / np.outer(size, size))[len(prior) - rank :]
    condition = float(np.sqrt(scaled[-1] / max(scaled[0], 1e-300))) if rank else float("inf")
    known = tuple(float(x) for x in deviations[::-1])
    return Identifiability(len(prior), rank, condition, tuple(dict.fromkeys(names)), known, weak)


def _name(direction: Array, fit: Fit) -> str:
    """The parameters that a direction (P,) mostly consists of."""
    parts = sorted(((abs(x), p.name) for x, p in zip(direction, fit.parameters, strict=True)), reverse=True)
    # where many parameters share a direction, none of them is a large part of it
    large = [name for size, name in parts if size >= _NAMED] or [name for _, name in parts[:_FEW_NAMED]]
    return " with ".join(large)
