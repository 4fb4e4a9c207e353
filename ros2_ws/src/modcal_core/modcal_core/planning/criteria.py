"""What makes a set of stations good, as functions of the information matrix H = JᵀWJ + Λ (in units of the prior).

Sets are chosen for the expected error, −tr(H⁻¹ Γ), or for det H (D-optimality). With σ_1 ≥ … ≥ σ_P the singular values
of the whitened, scaled identification Jacobian, five indices of observability are reported:

    O1 = (σ_1 … σ_P)^(1/P) / √N       Borm & Menq 1991; for given N the same as D-optimality
    O2 = σ_P / σ_1                    Driels & Pathre 1990, the inverse of the condition number
    O3 = σ_P                          Nahvi, Hollerbach & Hayward 1994
    O4 = σ_P² / σ_1                   Nahvi & Hollerbach 1996, noise amplification
    O5 = 1 / (1/σ_1 + … + 1/σ_P)      Sun & Hollerbach 2008
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array

ACCURACY = "accuracy"
CRITERIA = (ACCURACY, "d")


@dataclass(frozen=True)
class Criterion:
    """name: one of CRITERIA. gamma: Γ (P, P), for accuracy. Raises BadTable for another name."""

    name: str
    gamma: Array

    def __post_init__(self) -> None:
        if self.name not in CRITERIA:
            raise BadTable(f"criterion '{self.name}'", "is not known", f"choose {', '.join(CRITERIA)}")

    @property
    def by_determinant(self) -> bool:
        """Whether it is D-optimality."""
        return self.name == "d"

    def value(self, H: Array) -> Array:
        """How good information matrices (..., P, P) are, (...): larger is better."""
        if self.by_determinant:
            return np.asarray(np.linalg.slogdet(H)[1])
        return np.asarray(-np.trace(np.linalg.solve(H, np.broadcast_to(self.gamma, H.shape)), axis1=-2, axis2=-1))


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
