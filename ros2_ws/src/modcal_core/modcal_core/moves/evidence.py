"""How much more probable readings are with a change than without, its size not being known.

A change of unknown size has a prior of its own: sizes along its columns as large as make the readings move by τ
standard deviations of their noise, τ from one half to a thousand, each factor of two alike (Zellner 1986 for the
columns' own metric). So a change of six directions pays for them, and none pays for the units it is written in.

The mean over all changes, with their prior probabilities, of how much more probable they make the readings is an
*e-value*: while nothing has changed it exceeds 1/α with a chance of at most α, whatever the number of changes that are
looked for and however alike they are (Markov's inequality; Vovk & Wang 2021).

Errors of neighbouring stations are alike, in ways that no model of theirs has in full. So what n stations say together
is raised to the power m/n, where m is how many far apart they stand for: an e-value to a power below one is one as
well (Jensen's inequality), and of neighbours more is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from modcal_core.geometry import Array
from modcal_core.moves.noise import NullModel
from modcal_core.moves.rows import NOISE, READING, CellChange

SIZES = 2.0 ** np.arange(-1.0, 11.0)  # standard deviations of the noise, RMS over the readings
_RANK = 1e-10  # of the largest square; directions below it are not seen at these postures
_NOISIER = (1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0)  # factors of a spread that grew


@dataclass(frozen=True)
class ChangeCandidate:
    """A change fitted to the readings. residual: what it leaves, (n,). columns: its derivatives there, (n, k); of a
    free curve those that its random sums are of. sizes: that were put in.
    """

    hypothesis: CellChange
    residual: Array
    columns: Array
    sizes: Array = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class JudgedChange:
    """A change and what speaks for it. log_factor: logarithm of its Bayes factor against no change. likelihood: the
    largest logarithm of the likelihood, its sizes at their best. size: the τ that suits it best. noise: by which
    factors position and orientation scatter more.
    """

    hypothesis: CellChange
    log_factor: float
    likelihood: float
    size: float
    noise: tuple[float, float] = (1.0, 1.0)


class ChangeJudge:
    """What one null says of candidates: its covariances are factored once."""

    def __init__(self, null: NullModel) -> None:
        self.null = null
        factors = np.linalg.cholesky(np.stack(null.covariances))
        self._half_logdet = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
        self._whiten = np.stack([scipy.linalg.lapack.dtrtri(L, lower=1)[0] for L in factors])
        self._z = self._whiten @ null.residual
        self._square = np.sum(self._z**2, axis=1)
        self._each = null.log_prior - self._half_logdet - 0.5 * self._square
        self.log_null = float(np.logaddexp.reduce(self._each))
        self.best = int(np.argmax(self._each))

    @property
    def square(self) -> float:
        """Squared residuals in variances, at the noise that suits them best."""
        return float(self._square[self.best])

    def whitened(self, vectors: Array, member: int) -> Array:
        """Vectors (n, …) in standard deviations of one member of the grid."""
        return np.asarray(self._whiten[member] @ vectors)

    def judged(self, candidate: ChangeCandidate) -> JudgedChange:
        """The Bayes factor of one candidate, over all members of the grid and sizes."""
        h, A = candidate.hypothesis, self._directions(candidate)
        z = self._z if candidate.residual is self.null.residual else self._whiten @ candidate.residual
        squares, vectors = np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)  # (G, k), (G, k, k)
        kept = squares > _RANK * squares.max(axis=1, keepdims=True, initial=1e-300)
        along = (np.swapaxes(vectors, 1, 2) @ (np.swapaxes(A, 1, 2) @ z[..., None]))[..., 0]
        seen = np.where(kept, along**2 / np.where(kept, squares, 1.0), 0.0)  # of z, along each direction
        square = np.sum(z**2, axis=1)  # about the sizes of a large change another one than without it
        weight = np.where(kept, squares, 0.0) if h.free else kept  # sums of a curve have sizes of their own
        spread = weight * (len(self.null.residual) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300))
        spread = SIZES[:, None, None] ** 2 * spread  # (12, G, k)
        share = spread / (1.0 + spread)
        most = share.max(axis=2, initial=0.0)
        bent = np.maximum(self._square - square, -seen.sum(axis=1))
        each = self._each + 0.5 * (most * bent + (share * seen).sum(axis=2) - np.log1p(spread).sum(axis=2))
        factor = float(np.logaddexp.reduce(each, axis=None)) - np.log(len(SIZES)) - self.log_null
        left = square - ((2.0 * share - share**2 if h.free else np.ones_like(share)) * seen).sum(axis=2)
        likely = float((self.null.log_prior - self._half_logdet - 0.5 * left).max())
        return JudgedChange(h, factor, likely, float(SIZES[np.unravel_index(int(np.argmax(each)), each.shape)[0]]))

    def _directions(self, candidate: ChangeCandidate) -> Array:
        """Its columns in standard deviations of each member, (G, n, k), of whatever length."""
        columns, h = candidate.columns, candidate.hypothesis
        if h.kind == READING:  # single rows, each by itself: no product is needed
            return self._whiten[:, :, np.argmax(columns, axis=0)]
        return self._whiten @ (columns if h.free else columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))

    def noisier(self, hypothesis: CellChange) -> JudgedChange:
        """The Bayes factor of readings that scatter more, in position, orientation, or both."""
        turned = bool((self.null.rows.component >= 3).any())
        pairs = [(a, b) for a in _NOISIER for b in (_NOISIER if turned else (1.0,)) if max(a, b) > 1.0]
        if len(self.null.residual) > 400:
            pairs = [(a, b) for a, b in pairs if a == b or min(a, b) == 1.0]
        logs = []
        for pair in pairs:
            L = np.linalg.cholesky(self.null.covariances[self.null.reference] + self.null.rows.extra(*pair))
            z = scipy.linalg.solve_triangular(L, self.null.residual, lower=True)
            logs.append(-float(np.log(np.diag(L)).sum() + 0.5 * z @ z))
        factor = float(np.logaddexp.reduce(logs)) - np.log(len(logs)) - self.log_null
        at = int(np.argmax(logs))
        return JudgedChange(hypothesis, factor, logs[at], 1.0, pairs[at])


def e_value(judged: Sequence[JudgedChange], log_prior: Array, weight: float = 1.0) -> float:
    """Logarithm of the mean Bayes factor over all changes, raised to the stations' weight."""
    return weight * float(np.logaddexp.reduce([j.log_factor for j in judged] + log_prior))


def by_name(
    judged: Sequence[JudgedChange], log_prior: Array, weight: float
) -> dict[tuple[str, str], tuple[float, JudgedChange]]:
    """What can be named: its probability, one of them being the case, and its most probable shape."""
    each = weight * np.array([j.log_factor for j in judged]) + log_prior
    out: dict[tuple[str, str], tuple[float, JudgedChange]] = {}
    for j, p in zip(judged, np.exp(each - np.logaddexp.reduce(each)), strict=True):
        so_far, top = out.get(j.hypothesis.key, (0.0, j))
        out[j.hypothesis.key] = so_far + float(p), top if top.log_factor > j.log_factor else j
    return out


def most_probable(judged: Sequence[JudgedChange], log_prior: Array, weight: float = 1.0) -> JudgedChange:
    """The most probable thing to name, by its most probable shape. weight: of what the stations say."""
    return max(by_name(judged, log_prior, weight).values(), key=lambda pair: pair[0])[1]


def is_noise(judged: JudgedChange) -> bool:
    """Whether it is the readings that scatter more."""
    return judged.hypothesis.kind == NOISE
