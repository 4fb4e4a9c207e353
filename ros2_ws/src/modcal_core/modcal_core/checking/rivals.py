"""Which change is named of those that explain the readings, and which others explain them as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modcal_core.checking.evidence import JudgedChange, probabilities
from modcal_core.checking.hypotheses import READING, CellChange
from modcal_core.effects import AS_LIKELY
from modcal_core.geometry import Array

_AS_PROBABLE = 3.0  # in log-probability (20 to 1), within which two changes are not told apart


@dataclass(frozen=True)
class FittedChange:
    """A change as it is named. judged: what speaks for it. sizes, std: [m, rad, 1], with their covariance. same_as:
    others that explain the same. probability: that it is this one of all.
    """

    judged: JudgedChange
    probability: float
    same_as: tuple[JudgedChange, ...]
    sizes: Array = field(default_factory=lambda: np.empty(0))
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def hypothesis(self) -> CellChange:
        """What changed."""
        return self.judged.candidate.hypothesis


def most_probable(judged: Sequence[JudgedChange], prior: Array, weight: float = 1.0) -> JudgedChange:
    """The most probable thing to name, by its most probable shape. weight: of what the stations say."""
    chance = probabilities(judged, prior, weight)
    of_key: dict[tuple[str, str], float] = {}
    for j, p in zip(judged, chance, strict=True):
        key = j.candidate.hypothesis.key
        of_key[key] = of_key.get(key, 0.0) + float(p)
    best = max(of_key, key=lambda k: of_key[k])
    return max(
        ((p, j) for j, p in zip(judged, chance, strict=True) if j.candidate.hypothesis.key == best),
        key=lambda pair: pair[0],
    )[1]


def with_rivals(best: JudgedChange, every: Sequence[JudgedChange], prior: Array, weight: float = 1.0) -> FittedChange:
    """What is named, with what explains the readings as well. weight: of what the stations say, as of the null."""
    chance = probabilities(every, prior, weight)
    by_key: dict[tuple[str, str], tuple[float, JudgedChange]] = {}
    for j, p in zip(every, chance, strict=True):
        key = j.candidate.hypothesis.key
        so_far = by_key.get(key)
        top = j if so_far is None or j.log_factor > so_far[1].log_factor else so_far[1]
        by_key[key] = (float(p) + (so_far[0] if so_far else 0.0), top)
    own = by_key.get(best.candidate.hypothesis.key, (1.0, best))
    likely = own[1].likelihood
    rivals = []
    for key, (p, j) in by_key.items():
        if key == best.candidate.hypothesis.key or j.candidate.hypothesis.kind == READING:
            continue
        as_probable = p > own[0] * np.exp(-_AS_PROBABLE)
        contained = bool(j.candidate.hypothesis.sizes) and j.likelihood > likely - AS_LIKELY / weight
        if as_probable or contained:
            rivals.append((p, j))
    rivals.sort(key=lambda pair: -pair[0])
    return FittedChange(own[1], own[0], tuple(j for _, j in rivals))
