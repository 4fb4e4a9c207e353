"""Fedorov's exchange: one station after the other leaves the set, and the candidate that serves best takes its place.

A station adds a matrix of rank c, JᵀJ with c = 3 or 6 rows, so what it is worth follows from small matrices: with
P = H⁻¹ and S = 1 + J P Jᵀ (c × c),

    log det(H + JᵀJ) = log det H + log det S,        tr((H + JᵀJ)⁻¹ Γ) = tr(P Γ) − tr(S⁻¹ J P Γ P Jᵀ)

for all candidates at once, and what changes with a station is of that rank too (:mod:`modcal_core.planning.worth`). The
indices that hang on single eigenvalues have no such form: candidates are ranked by the slope tr(∂/∂H · JᵀJ), and the
best of these are computed exactly. The first start grows the set station by station, the others begin at random; the
best end is taken.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import Array
from modcal_core.planning.criteria import ACCURACY, Criterion
from modcal_core.planning.worth import StationRows, Worth

_SHORTLIST = 24  # for time: candidates that are tried in full
_BETTER = 1e-9  # of the criterion, that counts as better
PASSES = 8  # iterations
_AFRESH = 4  # stations added, after which all is computed afresh: from the prior to what they tell is six decades


@dataclass(frozen=True)
class Exchange:
    """chosen: rows of the candidates, sorted, (k,). value: of the criterion. starts: values of all starts. passes: of
    the best start.
    """

    chosen: np.ndarray
    value: float
    starts: tuple[float, ...]
    passes: int


def exchange(
    rows: StationRows,
    count: int,
    criterion: Criterion,
    rng: np.random.Generator,
    starts: int = 4,
    passes: int = PASSES,
    given: Array | None = None,
    begin: np.ndarray | None = None,
) -> Exchange:
    """The ``count`` of the candidates that are best together.

    given: information (P, P), in units of the prior, that is there already; the prior is added to it. begin: candidates
    to begin from; there is then this one start.
    """
    assert 0 < count <= len(rows), (count, len(rows))
    P = rows.J.shape[2]
    base = np.eye(P) + (0.0 if given is None else given)
    ends = []
    if begin is not None:
        ends.append(_improved(rows, begin, criterion, base, rng, passes))
    for start in range(0 if begin is not None else starts):
        chosen = _grown(rows, count, criterion, base) if start == 0 else rng.choice(len(rows), count, replace=False)
        ends.append(_improved(rows, chosen, criterion, base, rng, passes))
    best = int(np.argmax([value for _, value, _ in ends]))
    chosen, value, used = ends[best]
    return Exchange(np.sort(chosen), value, tuple(v for _, v, _ in ends), used)


class _CandidateSearch:
    """The candidates beside the stations that are chosen: which is best to add, as stations come and go."""

    def __init__(self, rows: StationRows, criterion: Criterion, H: Array) -> None:
        self._rows, self._criterion = rows, criterion
        spectral = not criterion.by_determinant and criterion.name != ACCURACY  # hangs on single eigenvalues
        self._H, self._worth = H, None if spectral else Worth.of(rows, criterion, H)

    def begin(self, H: Array) -> None:
        """Go on from this information, so that rounding does not add up."""
        self._H, self._worth = H, self._worth and Worth.of(self._rows, self._criterion, H, self._worth.J)

    def changed(self, k: int, sign: float) -> None:
        """Station k comes (1) or goes (−1)."""
        if self._worth is not None:
            self._worth = self._worth.changed(k, sign)
        else:
            self._H = self._H + sign * self._rows.J[k].T @ self._rows.J[k]

    def best(self, free: np.ndarray) -> tuple[int, float]:
        """The free candidate that is best added, and the criterion with it."""
        if self._worth is None:
            return best_candidate(self._rows, self._H, self._criterion, free)
        values = np.where(free, self._worth.values(), -np.inf)
        j = int(np.argmax(values))
        return j, float(values[j])

    def without(self, k: int) -> _CandidateSearch:
        """The same with station k taken out; this one stays as it is."""
        out = copy(self)
        out.changed(k, -1.0)
        return out


def _grown(rows: StationRows, count: int, criterion: Criterion, base: Array) -> np.ndarray:
    search, free = _CandidateSearch(rows, criterion, base), np.ones(len(rows), dtype=bool)
    chosen = np.empty(count, dtype=int)
    for k in range(count):
        j, _ = search.best(free)
        chosen[k], free[j] = j, False
        if k % _AFRESH == _AFRESH - 1:
            search.begin(base + rows.information(chosen[: k + 1]))
        else:
            search.changed(j, 1.0)
    return chosen


def _improved(
    rows: StationRows, chosen: np.ndarray, criterion: Criterion, base: Array, rng: np.random.Generator, passes: int
) -> tuple[np.ndarray, float, int]:
    chosen = chosen.copy()
    free = np.ones(len(rows), dtype=bool)
    free[chosen] = False
    H = base + rows.information(chosen)
    search = _CandidateSearch(rows, criterion, H)
    value, used = float(criterion.value(H)), 0
    for used in range(1, passes + 1):  # noqa: B007 (reported)
        before = value
        for k in rng.permutation(len(chosen)):
            out = int(chosen[k])
            without = search.without(out)
            free[out] = True
            j, new = without.best(free)
            if j != out and new > value + _BETTER * abs(value):
                without.changed(j, 1.0)
                search, chosen[k], value = without, j, new
            free[chosen[k]] = False
        H = base + rows.information(chosen)
        search.begin(H)
        value = float(criterion.value(H))
        if value <= before + 1e-6 * abs(before):
            break
    return chosen, value, used


def best_candidate(rows: StationRows, H: Array, criterion: Criterion, free: np.ndarray) -> tuple[int, float]:
    """The free candidate that is best added to H, and the criterion with it."""
    J = rows.J
    if criterion.by_determinant or criterion.name == ACCURACY:
        inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
        JP = _times(J, inverse)
        S = JP @ J.transpose(0, 2, 1) + np.eye(J.shape[1])
        if criterion.by_determinant:
            values = np.linalg.slogdet(H)[1] + np.linalg.slogdet(S)[1]
        else:
            seen = _times(JP, criterion.gamma) @ JP.transpose(0, 2, 1)
            gained = np.trace(np.linalg.solve(S, seen), axis1=1, axis2=2)
            values = -np.sum(inverse * criterion.gamma) + gained
        values = np.where(free, values, -np.inf)
        j = int(np.argmax(values))
        return j, float(values[j])
    slope = np.where(free, np.sum(_times(J, criterion.gradient(H)) * J, axis=(1, 2)), -np.inf)
    few = np.argsort(-slope, kind="stable")[:_SHORTLIST]
    few = few[free[few]]
    exact = criterion.value(H + J[few].transpose(0, 2, 1) @ J[few])
    j = int(np.argmax(exact))
    return int(few[j]), float(exact[j])


def _times(J: Array, A: Array) -> Array:
    """J (N, c, P) times A (P, P), as one product rather than N small ones."""
    return (J.reshape(-1, J.shape[2]) @ A).reshape(J.shape)
