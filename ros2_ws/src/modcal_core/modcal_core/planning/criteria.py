"""What makes a set of stations good, as functions of the information matrix H = JᵀWJ + Λ (in units of the prior).

With σ_1 ≥ … ≥ σ_P the singular values of the whitened, scaled identification Jacobian, so σ² the eigenvalues of JᵀWJ:

    O1 = (σ_1 … σ_P)^(1/P) / √N       Borm & Menq 1991; for given N the same as D-optimality, largest det H
    O2 = σ_P / σ_1                    Driels & Pathre 1990, the inverse of the condition number
    O3 = σ_P                          Nahvi, Hollerbach & Hayward 1994
    O4 = σ_P² / σ_1                   Nahvi & Hollerbach 1996, noise amplification
    O5 = 1 / (1/σ_1 + … + 1/σ_P)      Sun & Hollerbach 2008
    accuracy = −tr(H⁻¹ Γ)             I-optimality: Γ is the mean of GᵀG over the postures where accuracy counts

Each but O2 and O4 can only grow when a station is added. The derivative ∂/∂H stands beside each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array

ACCURACY = "accuracy"
CRITERIA = (ACCURACY, "d", "o1", "o2", "o3", "o4", "o5")

Spectral = Callable[[Array], Array]


@dataclass(frozen=True)
class Criterion:
    """name: one of CRITERIA. gamma: Γ (P, P), for accuracy."""

    name: str
    gamma: Array

    @property
    def by_determinant(self) -> bool:
        """Whether it is D-optimality."""
        return self.name in ("d", "o1")

    @property
    def spectral(self) -> bool:
        """Whether it hangs on single eigenvalues."""
        return self.name in _SPECTRAL

    def value(self, H: Array) -> Array:
        """How good information matrices (..., P, P) are, (...): larger is better; logarithms, but for accuracy."""
        if self.name == ACCURACY:
            return np.asarray(-np.trace(np.linalg.solve(H, np.broadcast_to(self.gamma, H.shape)), axis1=-2, axis2=-1))
        if self.by_determinant:
            return np.asarray(np.linalg.slogdet(H)[1])
        return _SPECTRAL[self.name](np.asarray(np.linalg.eigvalsh(H), dtype=float))

    def gradient(self, H: Array) -> Array:
        """∂ value/∂H, (P, P)."""
        if self.name == ACCURACY:
            inverse = np.linalg.inv(H)
            return np.asarray(inverse @ self.gamma @ inverse)
        if self.by_determinant:
            return np.asarray(np.linalg.inv(H))
        value, vector = np.linalg.eigh(H)
        return np.asarray((vector * _SLOPE[self.name](value)) @ vector.T)


def criterion(name: str, gamma: Array) -> Criterion:
    """The criterion of this name. Raises BadTable."""
    if name not in CRITERIA:
        raise BadTable(f"criterion '{name}'", "is not known", f"choose {', '.join(CRITERIA)}")
    return Criterion(name, gamma)


def _of_ends(v: Array, low: float, high: float) -> Array:
    """The slope of low · log of the smallest + high · log of the largest eigenvalue."""
    out = np.zeros_like(v)
    out[[0, -1]] += low / v[0], high / v[-1]
    return out


# of rising eigenvalues, singular values squared: logarithms of the indices, and their slopes
_SPECTRAL: dict[str, Spectral] = {
    "o2": lambda v: 0.5 * (np.log(v[..., 0]) - np.log(v[..., -1])),
    "o3": lambda v: 0.5 * np.log(v[..., 0]),
    "o4": lambda v: np.log(v[..., 0]) - 0.5 * np.log(v[..., -1]),
    "o5": lambda v: -np.log(np.sum(v**-0.5, axis=-1)),
}
_SLOPE: dict[str, Spectral] = {
    "o2": lambda v: _of_ends(v, 0.5, -0.5),
    "o3": lambda v: _of_ends(v, 0.5, 0.0),
    "o4": lambda v: _of_ends(v, 1.0, -0.5),
    "o5": lambda v: 0.5 * v**-1.5 / np.sum(v**-0.5),
}


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
    value = np.maximum(np.linalg.eigvalsh(information), 0.0)
    rank = int(np.sum(value > 1e-14 * max(float(value[-1]), 1e-300)))
    if rank < len(value):
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0, rank)
    o1 = np.exp(0.5 * np.mean(np.log(value))) / np.sqrt(stations)
    others = {name: float(np.exp(log_of(value))) for name, log_of in _SPECTRAL.items()}
    return Observability(o1=float(o1), rank=rank, **others)
