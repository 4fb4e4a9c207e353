"""Joint uncertainty of the sizes of all named changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.checking.evidence import ChangeCandidate, ChangeJudge, is_noise
from modcal_core.checking.hypotheses import curve_root
from modcal_core.checking.noise import FrozenKnowledge, NullModel, parameter_rows
from modcal_core.checking.rivals import FittedChange
from modcal_core.checking.state import CheckState
from modcal_core.geometry import Array


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
