"""What each candidate would be worth beside the stations that are chosen, kept up as these come and go.

A station k that is added (+) or taken out (−) changes P = H⁻¹ by a matrix of rank c, its c readings:

    P± = P ∓ U M Uᵀ,      U = P J_kᵀ,      M = (1 ± J_k P J_kᵀ)⁻¹

What a candidate j is worth hangs on S_j = 1 + J_j P J_jᵀ and, for accuracy, G_j = J_j P Γ P J_jᵀ alone, which change
with A_j = J_j U and B_j = J_j P Γ U:

    S_j± = S_j ∓ A_j M A_jᵀ,      G_j± = G_j ∓ A_j M B_jᵀ ∓ B_j M A_jᵀ + A_j M (Uᵀ Γ U) M A_jᵀ

(Sherman, Morrison & Woodbury). So a change costs one product of all candidates' rows with 2 c columns, in place of two
with all P parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.planning.criteria import Criterion
from modcal_core.planning.rows import StationRows


@dataclass(frozen=True)
class Worth:
    """One moment. inverse: P (P, P). S, G: of every candidate, (c, c, N). logdet: of H. J: rows, (c, P, N)."""

    criterion: Criterion
    J: Array
    inverse: Array
    S: Array
    G: Array
    logdet: float

    @classmethod
    def of(cls, rows: StationRows, criterion: Criterion, H: Array, J: Array | None = None) -> Worth:
        """What the candidates are worth beside information H (P, P). J: of another moment of the same candidates."""
        J = np.ascontiguousarray(rows.J.transpose(1, 2, 0)) if J is None else J
        inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
        JP = np.matmul(inverse, J)
        S = _products(J, JP) + np.eye(len(J))[:, :, None]
        G = S[:, :, :0] if criterion.by_determinant else _products(np.matmul(criterion.gamma, JP), JP)
        return cls(criterion, J, inverse, S, G, float(np.linalg.slogdet(H)[1]))

    def changed(self, k: int, sign: float) -> Worth:
        """With station k added (1) or taken out (−1)."""
        c, gamma = len(self.J), self.criterion.gamma
        own = self.J[:, :, k]
        U = self.inverse @ own.T
        inside = np.eye(c) + sign * own @ U
        M = sign * np.linalg.inv(inside)
        inverse = self.inverse - U @ M @ U.T
        logdet = self.logdet + float(np.linalg.slogdet(inside)[1])
        if self.criterion.by_determinant:
            A = np.matmul(U.T, self.J)
            return replace(self, inverse=inverse, S=self.S - _products(np.matmul(M, A), A), logdet=logdet)
        AB = np.matmul(np.hstack([U, self.inverse @ (gamma @ U)]).T, self.J)
        A, B = AB[:, :c], AB[:, c:]
        MA = np.matmul(M, A)
        crossed = _products(MA, B - 0.5 * np.matmul(U.T @ gamma @ U, MA))
        G = self.G - crossed - crossed.transpose(1, 0, 2)
        return replace(self, inverse=inverse, S=self.S - _products(MA, A), G=G, logdet=logdet)

    def values(self) -> Array:
        """The criterion with each of the candidates added, (N,)."""
        if self.criterion.by_determinant:
            return self.logdet + np.log(_determinant(self.S))
        return -float(np.sum(self.inverse * self.criterion.gamma)) + _trace(self.S, self.G)


def _products(A: Array, B: Array) -> Array:
    """Σ_k A[r, k] B[s, k], (c, c, N)."""
    return np.asarray(np.einsum("rkn,skn->rsn", A, B))


def _determinant(S: Array) -> Array:
    if len(S) != 3:
        return _eliminated(S)[0]
    return np.asarray(S[0, 0] * _cofactor(S, 0, 0) + S[0, 1] * _cofactor(S, 0, 1) + S[0, 2] * _cofactor(S, 0, 2))


def _trace(S: Array, G: Array) -> Array:
    """tr(S⁻¹ G) of symmetric matrices (c, c, N), (N,)."""
    if len(S) != 3:
        return np.asarray(np.einsum("iin->n", _eliminated(S, G)[1]))
    straight = sum(_cofactor(S, i, i) * G[i, i] for i in range(3))
    across = sum(_cofactor(S, i, j) * G[i, j] for i, j in ((0, 1), (0, 2), (1, 2)))
    return np.asarray((straight + 2.0 * across) / _determinant(S))


def _eliminated(S: Array, *G: Array) -> tuple[Array, Array]:
    """det S (N,) and S⁻¹ G (c, c, N) of positive matrices, which need no pivots: all N at once."""
    c = len(S)
    both = np.concatenate([S, *G], axis=1)
    determinant = np.ones(S.shape[2])
    for k in range(c):
        determinant *= both[k, k]
        both[k, k + 1 :] /= both[k, k]
        for i in range(c):
            if i != k:
                both[i, k + 1 :] -= both[i, k] * both[k, k + 1 :]
    return determinant, both[:, c:]


def _cofactor(S: Array, i: int, j: int) -> Array:
    (a, b), (c, d) = ([k for k in range(3) if k != omitted] for omitted in (i, j))
    return np.asarray((-1) ** (i + j) * (S[a, c] * S[b, d] - S[a, d] * S[b, c]))
