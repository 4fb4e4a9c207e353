"""How far the point moves for each parameter's error: at one posture, and over many.

    Θ_k(q) = ‖∂p/∂g_k · Δg_k‖                          single-point index (SFDPE)
    Θ_k    = Σ_i P_k(Θ_k(q_i)) Θ_k(q_i) / Σ_i P_k(…)    multi-point index (SFCDPE)

where P_k is the probability of the interval (the bin of the histogram of Θ_k over the postures) that a value falls in.
Divided by that of a base factor they are the relative indices RSFDPE and RSFCDPE. The weights favour what is usual: a
value that hardly any posture shows counts little. They are made to sum to one, so that an index that is the same
everywhere keeps its value; the plain mean and the range stand beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.planning.closed_chain import ClosedChain

_ROUNDING = 1e-9  # share of a value within which values are the same


@dataclass(frozen=True)
class Sensitivity:
    """Indices of P parameters at N postures.

    names: of the parameters. base: number of the base factor. sizes: Δg (P,) [m, rad]. single: (N, P) [m]. multi: (P,)
    [m].
    """

    names: tuple[str, ...]
    base: int
    sizes: Array
    single: Array
    multi: Array

    @property
    def relative_single(self) -> Array:
        """Single-point indices over that of the base factor at the same posture, (N, P)."""
        return self.single / self.single[:, self.base, None]

    @property
    def relative_multi(self) -> Array:
        """Multi-point indices over that of the base factor, (P,)."""
        return self.multi / self.multi[self.base]

    @property
    def mean(self) -> Array:
        """Plain means over the postures [m], (P,)."""
        return self.single.mean(axis=0)

    @property
    def spread(self) -> Array:
        """Largest less smallest value over the postures [m], (P,)."""
        return np.ptp(self.single, axis=0)


def sensitivity(closed: ClosedChain, q: Array, sizes: Array, base: str, bins: int | None = None) -> Sensitivity:
    """Single- and multi-point indices of every parameter over postures q (N, n).

    base: name of the base factor. bins: intervals of the histograms; Sturges' 1 + log2 N where it is not given. Raises
    BadTable for a base factor that is not there or moves nothing.
    """
    single = np.linalg.norm(closed.jacobian(q)[:, :3], axis=1) * sizes
    reference = closed.index(base)
    if not (single[:, reference] > _ROUNDING * single.max()).all():
        raise BadTable(f"base factor '{base}'", "moves nothing at some posture", "choose a shift, such as base/x")
    bins = int(np.ceil(np.log2(len(q)))) + 1 if bins is None else bins
    multi = np.array([_multi_point(column, bins) for column in single.T])
    return Sensitivity(closed.names, reference, sizes, single, multi)


def interval_probabilities(values: Array, bins: int) -> Array:
    """For each value (N,) the share of all values in the interval of the histogram that it falls in, (N,)."""
    low, high = float(values.min()), float(values.max())
    if high - low <= _ROUNDING * max(abs(high), abs(low)):
        return np.ones(len(values))
    index = np.minimum(((values - low) / (high - low) * bins).astype(int), bins - 1)
    return np.asarray(np.bincount(index, minlength=bins)[index] / len(values))


def _multi_point(values: Array, bins: int) -> float:
    weight = interval_probabilities(values, bins)
    return float(weight @ values / weight.sum())
