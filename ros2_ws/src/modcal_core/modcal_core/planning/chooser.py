"""The chooser: of many candidate stations those that are best together, grown one by one, exchanged and moved about.

A station adds JᵀJ of rank c, 3 or 6, to the information H. Sets are chosen for the expected error, −tr(H⁻¹ Γ). With
P = H⁻¹, S_j = 1 + J_j P J_jᵀ and G_j = J_j P Γ P J_jᵀ, candidate j is worth

    tr(P Γ) − tr((H + J_jᵀJ_j)⁻¹ Γ) = tr(S_j⁻¹ G_j)

A station k that comes (+) or goes (−) changes P, S and G by matrices of that rank too (Sherman, Morrison & Woodbury):
with U = P J_kᵀ, M = (1 ± J_k U)⁻¹, A_j = J_j U and B_j = J_j P Γ U

    P ∓ U M Uᵀ,    S_j ∓ A_j M A_jᵀ,    G_j ∓ A_j M B_jᵀ ∓ B_j M A_jᵀ + A_j M (Uᵀ Γ U) M A_jᵀ

In Fedorov's exchange each station in turn leaves the set for the candidate that serves best, then for postures near it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.geometry import Array
from modcal_core.planning.outlook import Outlook, information
from modcal_core.planning.pool import Ground

_BETTER = 1e-9  # of the error, that counts as better
_AFRESH = 4  # stations added, after which all is computed again: from the prior to what they tell is many decades
_ONE_BY_ONE = 40  # stations that are taken one by one; of more some at once, for time
ROUNDS = 8  # iterations of an exchange
_MOVED, _EACH = 800, 60  # postures tried about all stations that are moved, and about each at most, for time


@dataclass(frozen=True)
class Search:
    """What every candidate is worth now. J: their rows (N, c, K). H: information (K, K); inverse: P. gamma: Γ (K, K).
    S, G: (N, c, c).
    """

    J: Array
    H: Array
    inverse: Array
    gamma: Array
    S: Array
    G: Array

    @classmethod
    def of(cls, J: Array, H: Array, gamma: Array) -> Search:
        """Candidates J (N, c, K) beside information H (K, K)."""
        P = np.asarray(np.linalg.inv(H))
        JP = _times(J, P)
        turned = JP.transpose(0, 2, 1)
        return cls(J, H, P, gamma, JP @ J.transpose(0, 2, 1) + np.eye(J.shape[1]), _times(JP, gamma) @ turned)

    @property
    def value(self) -> float:
        """What is to become small: tr(H⁻¹ Γ)."""
        return float(np.sum(self.inverse * self.gamma))

    def beside(self, chosen: Sequence[int] | np.ndarray) -> Search:
        """The same with these candidates there as well."""
        return Search.of(self.J, self.H + information(self.J[chosen]), self.gamma)

    def changed(self, k: int, sign: float) -> Search:
        """The same once station k has come (1) or gone (−1)."""
        own = self.J[k]
        c = len(own)
        U = self.inverse @ own.T
        M = sign * np.linalg.inv(np.eye(c) + sign * own @ U)
        AB = _times(self.J, np.hstack([U, self.inverse @ (self.gamma @ U)]))
        A, B = AB[..., :c], AB[..., c:]
        AM = A @ M
        crossed = AM @ (B - 0.5 * AM @ (U.T @ self.gamma @ U)).transpose(0, 2, 1)
        return replace(
            self,
            H=self.H + sign * own.T @ own,
            inverse=self.inverse - U @ M @ U.T,
            S=self.S - AM @ A.transpose(0, 2, 1),
            G=self.G - crossed - crossed.transpose(0, 2, 1),
        )

    def gains(self, free: np.ndarray) -> Array:
        """By how much each candidate lowers the error, (N,); −inf for those that are not free."""
        return np.where(free, np.trace(np.linalg.solve(self.S, self.G), axis1=1, axis2=2), -np.inf)


def _times(J: Array, A: Array) -> Array:
    """J (N, c, K) times A (K, r), as one product rather than N small ones."""
    return (J.reshape(-1, J.shape[2]) @ A).reshape(*J.shape[:2], A.shape[1])


def grown(base: Search, count: int, chance: Array | float = 1.0) -> list[int]:
    """Numbers of the ``count`` candidates that lower the error most, each beside those before it.

    chance: of each to be measured, (N,), by which its worth counts; 0 leaves it out.
    """
    chance = chance * np.ones(len(base.J))
    free, search, chosen = chance > 0.0, base, list[int]()
    count = min(count, int(free.sum()))
    while len(chosen) < count:
        gains = search.gains(free)
        gains[free] *= chance[free]
        more = np.argsort(-gains, kind="stable")[: min(1 + len(chosen) // _ONE_BY_ONE, count - len(chosen))].tolist()
        before, free[more] = len(chosen), False
        chosen += more
        if before // _AFRESH < len(chosen) // _AFRESH:
            search = base.beside(chosen)
        else:
            for j in more:
                search = search.changed(j, 1.0)
    return chosen


def exchanged(
    base: Search, chosen: Sequence[int], rng: np.random.Generator, chance: Array | float = 1.0, rounds: int = ROUNDS
) -> list[int]:
    """Numbers of candidates that are better together than the chosen ones, in their places; chance: see grown."""
    kept, free = list(chosen), np.ones(len(base.J), dtype=bool)
    free[kept] = False
    search = base.beside(kept)
    for _ in range(rounds):
        before = search.value
        for k in rng.permutation(len(kept)):
            out = kept[k]
            without = search.changed(out, -1.0)
            free[out] = True
            gains = np.where(free, without.gains(free) * chance, -np.inf)
            j = int(np.argmax(gains))
            if gains[j] > gains[out] + _BETTER * search.value:
                search, kept[k] = without.changed(j, 1.0), j
            free[kept[k]] = False
        search = base.beside(kept)  # again, so that rounding does not add up
        if search.value >= (1.0 - 1e-6) * before:
            break
    return kept


@dataclass(frozen=True)
class Chosen:
    """Chosen stations; where they were grown only, the most useful first. q: (k, n). rows: (k, c, K). numbers: of the
    postures offered that they are, or were before they were moved, (k,).
    """

    q: Array
    rows: Array
    numbers: np.ndarray


@dataclass(frozen=True)
class Chooser:
    """view: what stations are worth. ground: where chosen ones are moved about, by these sizes [rad, m] in turn.
    rounds: of the exchange, without which they are grown only. chance: of postures (N, n) to be seen, (N,).
    """

    view: Outlook
    ground: Ground | None = None
    moves: tuple[float, ...] = ()
    rounds: int = 0
    chance: Callable[[Array], Array] = lambda q: np.ones(len(q))

    def best(
        self, q: Array, count: int, rng: np.random.Generator, ways: Array | None = None, first: int | None = None
    ) -> Chosen:
        """The ``count`` of these postures (N, n) from which most is gained. ways: in which joints come to them (N, n).
        first: so many of them are moved; None: all.
        """
        ways = np.zeros(q.shape) if ways is None else ways
        search, chance = self._search(q, ways), self.chance(q)
        numbers = grown(search, count, chance)
        if self.rounds:
            numbers = exchanged(search, numbers, rng, chance, self.rounds)
        q, ways = q[numbers], ways[numbers]
        k = len(q) if first is None else min(first, len(q))
        for size in self.moves if k else ():
            if self.ground is None:  # stations of a recording stand where they were
                break
            near, of = self.ground.around(q[:k], size, min(_EACH, _MOVED // k), rng)
            around, sides = np.concatenate([q[:k], near]), np.concatenate([ways[:k], ways[of]])
            kept = exchanged(self._search(around, sides), range(k), rng, self.chance(around))
            q[:k], ways[:k] = around[kept], sides[kept]
        return Chosen(q, self.view.rows(q, ways), np.array(numbers, dtype=int))

    def _search(self, q: Array, ways: Array) -> Search:
        return Search.of(self.view.rows(q, ways), self.view.H, self.view.gamma)
