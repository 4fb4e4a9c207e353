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

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from modcal_core.geometry import Array
from modcal_core.moves.noise import NullModel
from modcal_core.moves.rows import CHANCES, NOISE, CellChange

SIZES = 2.0 ** np.arange(-1.0, 11.0)  # standard deviations of the noise, RMS over the readings
_RANK = 1e-10  # of the largest square; directions below it are not seen at these postures
_NOISIER = (1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0)  # factors of a spread that grew


@dataclass(frozen=True)
class ChangeCandidate:
    """A change fitted to the readings. residual: what it leaves, (n,). columns: its derivatives there, (n, k); of a
    free curve those that its random sums are of. free: whether it is one. sizes: that were put in.
    """

    hypothesis: CellChange
    residual: Array
    columns: Array
    sizes: Array

    @property
    def free(self) -> bool:
        """Whether it is a curve that may take any course."""
        return self.hypothesis.curve >= 0


@dataclass(frozen=True)
class JudgedChange:
    """A candidate and what speaks for it. log_factor: logarithm of its Bayes factor against no change. likelihood: the
    largest logarithm of the likelihood, its sizes at their best. left: squared residuals then, in variances. size: the
    τ that suits it best. noise: by which factors position and orientation scatter more.
    """

    candidate: ChangeCandidate
    log_factor: float
    likelihood: float
    left: float
    size: float
    noise: tuple[float, float] = (1.0, 1.0)

    @property
    def label(self) -> str:
        """What is named."""
        return self.candidate.hypothesis.label


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
        n = len(self.null.residual)
        same = candidate.residual is self.null.residual
        z = self._z if same else self._whiten @ candidate.residual
        A = self._directions(candidate)
        squares, vectors = np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)  # (G, k), (G, k, k)
        kept = squares > _RANK * squares.max(axis=1, keepdims=True, initial=1e-300)
        squares = np.where(kept, squares, 1.0)
        along = (np.swapaxes(vectors, 1, 2) @ (np.swapaxes(A, 1, 2) @ z[..., None]))[..., 0]
        seen = np.where(kept, along**2 / squares, 0.0)  # of z, along each direction
        square = np.sum(z**2, axis=1)  # about the angles of a large curve another one than without it
        rest = square - seen.sum(axis=1)
        if candidate.free:
            total = np.where(kept, squares, 0.0)
            spread = SIZES[:, None, None] ** 2 * (total * (n / np.maximum(total.sum(axis=1, keepdims=True), 1e-300)))
            share = spread / (1.0 + spread)
            bent = 0.5 * (self._square - square)
            logs = (bent - 0.5 * np.log1p(spread).sum(axis=2) + 0.5 * (share * seen).sum(axis=2)).T
            left = (square - ((2.0 * share - share**2) * seen).sum(axis=2)).T
        else:
            k = kept.sum(axis=1)[:, None]
            gain = np.maximum(self._square - rest, 0.0)[:, None]
            g = SIZES**2 * n / np.maximum(k, 1)
            logs = -0.5 * k * np.log1p(g) + 0.5 * gain * g / (1.0 + g)
            left = np.broadcast_to(self._square[:, None] - gain, logs.shape)
        each = self._each[:, None] + logs
        factor = float(np.logaddexp.reduce(each, axis=None)) - np.log(len(SIZES)) - self.log_null
        at = np.unravel_index(int(np.argmax(each)), each.shape)
        likely = float((self.null.log_prior[:, None] - self._half_logdet[:, None] - 0.5 * left).max())
        return JudgedChange(candidate, factor, likely, float(left[at]), float(SIZES[at[1]]))

    def _directions(self, candidate: ChangeCandidate) -> Array:
        """Its columns in standard deviations of each member, (G, n, k), of whatever length."""
        columns = candidate.columns
        if candidate.hypothesis.sample >= 0:  # single rows, each by itself: no product is needed
            return self._whiten[:, :, np.argmax(columns, axis=0)]
        if candidate.free:
            return self._whiten @ columns
        return self._whiten @ (columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))

    def noisier(self, hypothesis: CellChange) -> JudgedChange:
        """The Bayes factor of readings that scatter more, in position, orientation, or both."""
        turned = bool((self.null.rows.component >= 3).any())
        pairs = [(a, b) for a in _NOISIER for b in (_NOISIER if turned else (1.0,)) if max(a, b) > 1.0]
        if len(self.null.residual) > 400:
            pairs = [(a, b) for a, b in pairs if a == b or min(a, b) == 1.0]
        V, rows = self.null.covariances[self.null.reference], self.null.rows
        logs, squares = [], []
        for a, b in pairs:
            extra = np.where(rows.component >= 3, b**2 - 1.0, a**2 - 1.0) * rows.variance
            L = np.linalg.cholesky(V + np.diag(extra))
            z = scipy.linalg.solve_triangular(L, self.null.residual, lower=True)
            squares.append(float(z @ z))
            logs.append(-float(np.log(np.diag(L)).sum()) - 0.5 * squares[-1])
        factor = float(np.logaddexp.reduce(logs)) - np.log(len(logs)) - self.log_null
        at = int(np.argmax(logs))
        empty = ChangeCandidate(hypothesis, self.null.residual, np.zeros((len(self.null.residual), 0)), np.empty(0))
        return JudgedChange(empty, factor, logs[at], squares[at], 1.0, pairs[at])


def log_priors(hypotheses: Sequence[CellChange]) -> Array:
    """Log prior probability of each change, (H,): equal for every kind, divided among its members."""
    return _log_priors(tuple((h.kind, h.place) for h in hypotheses))


@lru_cache(maxsize=64)
def _log_priors(keys: tuple[tuple[str, str], ...]) -> Array:
    places = {kind: len({p for k, p in keys if k == kind}) for kind, _ in keys}
    total, variants = sum(CHANCES[kind] for kind in places), Counter(keys)
    return np.array([np.log(CHANCES[k] / total / places[k] / variants[k, p]) for k, p in keys])


def e_value(judged: Sequence[JudgedChange], log_prior: Array, weight: float = 1.0) -> float:
    """Logarithm of the mean Bayes factor over all changes, raised to the stations' weight."""
    return weight * float(np.logaddexp.reduce([j.log_factor for j in judged] + log_prior))


def probabilities(judged: Sequence[JudgedChange], log_prior: Array, weight: float = 1.0) -> Array:
    """Posterior probability of each change, one of them being the case, (H,)."""
    each = weight * np.array([j.log_factor for j in judged]) + log_prior
    return np.asarray(np.exp(each - np.logaddexp.reduce(each)))


def is_noise(judged: JudgedChange) -> bool:
    """Whether it is the readings that scatter more."""
    return judged.candidate.hypothesis.kind == NOISE
