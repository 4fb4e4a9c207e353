"""The chooser: of many candidate stations those that are best together, grown one by one and improved by exchange.

A station adds JᵀJ of rank c, 3 or 6. With P = H⁻¹, S_j = 1 + J_j P J_jᵀ and G_j = J_j P Γ P J_jᵀ, candidate j is worth

    log det(H + J_jᵀJ_j) = log det H + log det S_j,        tr((H + J_jᵀJ_j)⁻¹ Γ) = tr(P Γ) − tr(S_j⁻¹ G_j)

A station k that comes (+) or goes (−) changes P, S and G by matrices of that rank too (Sherman, Morrison & Woodbury):
with U = P J_kᵀ, M = (1 ± J_k U)⁻¹, A_j = J_j U and B_j = J_j P Γ U

    P ∓ U M Uᵀ,    S_j ∓ A_j M A_jᵀ,    G_j ∓ A_j M B_jᵀ ∓ B_j M A_jᵀ + A_j M (Uᵀ Γ U) M A_jᵀ

In Fedorov's exchange one station after the other leaves the set, and the candidate that serves best takes its place;
the first start grows the set, the others begin at random, and the best end is taken. Sets are chosen for the expected
error, −tr(H⁻¹ Γ), or for det H (D-optimality). Of the singular values σ_1 ≥ … ≥ σ_P of the whitened, scaled Jacobian
are reported

    O1 = (σ_1 … σ_P)^(1/P) / √N       Borm & Menq 1991; for given N the same as D-optimality
    O2 = σ_P / σ_1                    Driels & Pathre 1990, the inverse of the condition number
    O3 = σ_P                          Nahvi, Hollerbach & Hayward 1994
    O4 = σ_P² / σ_1                   Nahvi & Hollerbach 1996, noise amplification
    O5 = 1 / (1/σ_1 + … + 1/σ_P)      Sun & Hollerbach 2008
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.geometry import Array

ACCURACY = "accuracy"
CRITERIA = (ACCURACY, "d")


@dataclass(frozen=True)
class Observability:
    """The five indices of a set of stations, and the rank of its Jacobian."""

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float
    rank: int


def observability(information: Array, stations: int) -> Observability:
    """The five observability indices of JᵀWJ (P, P), without the prior, for so many stations; 0 where rank is lost."""
    square = np.maximum(np.linalg.eigvalsh(information), 0.0)
    rank = int(np.sum(square > 1e-14 * max(float(square[-1]), 1e-300)))
    if rank < len(square):
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0, rank)
    s = np.sqrt(square)
    return Observability(
        o1=float(np.exp(np.mean(np.log(s))) / np.sqrt(stations)),
        o2=float(s[0] / s[-1]),
        o3=float(s[0]),
        o4=float(square[0] / s[-1]),
        o5=float(1.0 / np.sum(1.0 / s)),
        rank=rank,
    )


# --- The chooser

_BETTER = 1e-9  # of the criterion, that counts as better
_AFRESH = 4  # stations added, after which all is computed again: from the prior to what they tell is many decades
_ONE_BY_ONE = 40  # stations that are taken one by one; of more some at once, for time
PASSES = 8  # iterations


def information(J: Array) -> Array:
    """JᵀJ of stations with rows J (N, c, K), in units of the prior, (K, K)."""
    flat = J.reshape(-1, J.shape[2])
    return np.asarray(flat.T @ flat)


@dataclass(frozen=True)
class Search:
    """What every candidate is worth now. J: their rows (N, c, K). H: information (K, K); inverse: P. S, G: (N, c, c).
    gamma: Γ (K, K), for the expected error; without it, and without G, det H counts.
    """

    J: Array
    H: Array
    inverse: Array
    S: Array
    gamma: Array | None
    G: Array | None

    @property
    def value(self) -> float:
        """The criterion of the information that is there: larger is better."""
        if self.gamma is None:
            return float(np.linalg.slogdet(self.H)[1])
        return -float(np.sum(self.inverse * self.gamma))

    def beside(self, chosen: Sequence[int] | np.ndarray) -> Search:
        """The same with these candidates there as well."""
        return Search.of(self.J, self.H + information(self.J[chosen]), self.gamma)

    @classmethod
    def of(cls, J: Array, H: Array, gamma: Array | None = None) -> Search:
        """Candidates J (N, c, K) beside information H (K, K)."""
        P = np.asarray(np.linalg.inv(H))
        JP = _times(J, P)
        S = JP @ J.transpose(0, 2, 1) + np.eye(J.shape[1])
        G = None if gamma is None else _times(JP, gamma) @ JP.transpose(0, 2, 1)
        return cls(J, H, P, S, gamma, G)

    def changed(self, k: int, sign: float) -> Search:
        """The same once station k has come (1) or gone (−1)."""
        own = self.J[k]
        H = self.H + sign * own.T @ own
        c, gamma = len(own), self.gamma
        U = self.inverse @ own.T
        M = sign * np.linalg.inv(np.eye(c) + sign * own @ U)
        P = self.inverse - U @ M @ U.T
        if gamma is None or self.G is None:
            A = _times(self.J, U)
            return replace(self, H=H, inverse=P, S=self.S - A @ M @ A.transpose(0, 2, 1))
        AB = _times(self.J, np.hstack([U, self.inverse @ (gamma @ U)]))
        A, B = AB[..., :c], AB[..., c:]
        AM = A @ M
        crossed = AM @ (B - 0.5 * AM @ (U.T @ gamma @ U)).transpose(0, 2, 1)
        S = self.S - AM @ A.transpose(0, 2, 1)
        return replace(self, H=H, inverse=P, S=S, G=self.G - crossed - crossed.transpose(0, 2, 1))

    def gains(self, free: np.ndarray) -> Array:
        """By how much each candidate raises the criterion, (N,); −inf for those that are not free."""
        if self.G is None:
            gain = np.linalg.slogdet(self.S)[1]
        else:
            gain = np.trace(np.linalg.solve(self.S, self.G), axis1=1, axis2=2)
        return np.where(free, gain, -np.inf)


def _times(J: Array, A: Array) -> Array:
    """J (N, c, K) times A (K, r), as one product rather than N small ones."""
    return (J.reshape(-1, J.shape[2]) @ A).reshape(*J.shape[:2], A.shape[1])


def grown(base: Search, count: int, chance: Array | None = None) -> list[int]:
    """Numbers of the ``count`` candidates that raise the criterion most, each beside those before it.

    chance: of each to be measured, (N,), by which its worth counts; 0 leaves it out.
    """
    chance = np.ones(len(base.J)) if chance is None else chance
    free = chance > 0.0
    search = base
    chosen: list[int] = []
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


def exchange(
    base: Search,
    count: int,
    rng: np.random.Generator,
    starts: int = 4,
    passes: int = PASSES,
    begin: np.ndarray | None = None,
) -> np.ndarray:
    """Numbers of the ``count`` candidates that are best together, sorted. begin: instead of starts, one from these."""
    assert 0 < count <= len(base.J), (count, len(base.J))
    begins = [begin] if begin is not None else [np.array(grown(base, count))]
    begins += [rng.choice(len(base.J), count, replace=False) for _ in range(0 if begin is not None else starts - 1)]
    ends = [_improved(base, first, rng, passes) for first in begins]
    return np.sort(max(ends, key=lambda end: end[1])[0])


def _improved(base: Search, chosen: np.ndarray, rng: np.random.Generator, passes: int) -> tuple[np.ndarray, float]:
    chosen = chosen.copy()
    free = np.ones(len(base.J), dtype=bool)
    free[chosen] = False
    search = base.beside(chosen)
    value = search.value
    for _ in range(passes):
        before = value
        for k in rng.permutation(len(chosen)):
            out = int(chosen[k])
            without = search.changed(out, -1.0)
            free[out] = True
            gains = without.gains(free)
            j = int(np.argmax(gains))
            new = without.value + float(gains[j])
            if j != out and new > value + _BETTER * abs(value):
                search, chosen[k], value = without.changed(j, 1.0), j, new
            free[chosen[k]] = False
        search = base.beside(chosen)  # again, so that rounding does not add up
        value = search.value
        if value <= before + 1e-6 * abs(before):
            break
    return chosen, value
