"""Which change is named of those that explain the readings, what explains them as well, and how sure its sizes are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modcal_core.checking.evidence import ChangeCandidate, ChangeJudge, JudgedChange, is_noise, probabilities
from modcal_core.checking.hypotheses import READING, CellChange, curve_root
from modcal_core.checking.noise import FrozenKnowledge, NullModel, parameter_rows
from modcal_core.checking.state import CheckState
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


@dataclass(frozen=True)
class SizeCovariance:
    """What is known of the sizes of all changes together. covariance: (k, k). cross: with what the calibration does not
    know of itself, (K, k): the error of a size makes up for a part of that.
    """

    covariance: Array
    cross: Array

    @classmethod
    def none(cls, known: FrozenKnowledge) -> SizeCovariance:
        """Covariance without any change."""
        return cls(np.empty((0, 0)), np.empty((len(known.covariance), 0)))


def with_sizes(
    changes: Sequence[FittedChange], fits: Sequence[ChangeCandidate], state: CheckState, begin: NullModel, member: int
) -> tuple[list[FittedChange], SizeCovariance]:
    """The changes with their sizes, and what is known of these beside each other.

    member: of the null's grid, that which suits the readings best with the changes in; without them it would be a wider
    spread, for it would have to explain them.
    """
    known = state.known
    if not changes:
        return [], SizeCovariance.none(known)
    for change in changes:
        if is_noise(change.judged):
            begin = begin.with_noise(*change.judged.noise)
    judge = ChangeJudge(begin)
    n = len(begin.residual)
    blocks, roots = [], []
    for change, fit in zip(changes, fits, strict=True):
        if fit.free:
            A = judge.whitened(fit.columns, member)
            spread = change.judged.size * np.sqrt(n / max(float(np.sum(A**2)), 1e-300))
            blocks.append(spread * A)
            roots.append(spread * curve_root(fit.hypothesis.curve, state.model, state.samples))
        else:
            sized = bool(fit.hypothesis.sizes)
            blocks.append(judge.whitened(state.columns(fit.hypothesis), member) if sized else np.zeros((n, 0)))
            roots.append(np.empty((0, 0)))
    J = np.concatenate(blocks, axis=1)
    prior = np.concatenate([np.full(b.shape[1], float(f.free)) for b, f in zip(blocks, fits, strict=True)])
    covariance = np.linalg.pinv(J.T @ J + np.diag(prior), hermitian=True)
    mean = covariance @ (J.T @ judge.whitened(state.residual, member))  # of curves; of sizes it is the last step
    own = parameter_rows(state.model, state.view, state.drivers, known.parameters, known.effects)
    cross = -known.covariance @ judge.whitened(own.T, member).T @ J @ covariance
    out: list[FittedChange] = []
    kept: list[int] = []
    first = 0
    for change, fit, block, root in zip(changes, fits, blocks, roots, strict=True):
        rows = slice(first, first + block.shape[1])
        first += block.shape[1]
        part = covariance[rows, rows]
        change = replace(
            change, judged=replace(change.judged, candidate=replace(change.judged.candidate, hypothesis=fit.hypothesis))
        )
        if fit.free:
            out.append(replace(change, sizes=root @ mean[rows], covariance=root @ part @ root.T))
        else:
            out.append(replace(change, sizes=fit.sizes, covariance=part))
            kept += range(rows.start, rows.stop)
    return out, SizeCovariance(covariance[np.ix_(kept, kept)], cross[:, kept])
