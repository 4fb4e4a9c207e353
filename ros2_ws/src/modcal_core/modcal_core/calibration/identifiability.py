"""What the data can tell: rank, condition, and by name the combinations that it leaves open.

A direction counts as observed when the data alone fixes it better than the prior does, that is better than 10 mm or
20 mrad. With every parameter measured in units of its prior deviation, the eigenvalues of the data's information are
(prior deviation / data deviation)², so the line is drawn at one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.identify import Fit

_NAMED = 0.3  # share of a direction (of unit length) above which a parameter is named as part of it


@dataclass(frozen=True)
class Identifiability:
    """parameters: how many were fitted. rank: how many combinations the data shows. condition: ratio of the largest to
    the smallest singular value of the observed part, columns scaled to unit length. unobservable: the rest, by name.
    """

    parameters: int
    rank: int
    condition: float
    unobservable: tuple[str, ...]


def identifiability(fit: Fit) -> Identifiability:
    """Rank, condition and unobservable combinations of a fit."""
    prior = np.array([p.prior_std if np.isfinite(p.prior_std) else 1.0 for p in fit.parameters])
    value, vector = np.linalg.eigh(fit.information * np.outer(prior, prior))
    seen = value >= 1.0
    rank = int(seen.sum())
    names = []
    for v in vector[:, ~seen].T:
        parts = [(abs(x), p.name) for x, p in zip(v, fit.parameters, strict=True) if abs(x) >= _NAMED]
        names.append(" with ".join(name for _, name in sorted(parts, reverse=True)))
    size = np.sqrt(np.maximum(np.diag(fit.information), 1e-300))
    scaled = np.linalg.eigvalsh(fit.information / np.outer(size, size))[len(prior) - rank :]
    condition = float(np.sqrt(scaled[-1] / max(scaled[0], 1e-300))) if rank else float("inf")
    return Identifiability(len(prior), rank, condition, tuple(dict.fromkeys(names)))
