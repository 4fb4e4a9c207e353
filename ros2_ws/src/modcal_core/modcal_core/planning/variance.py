"""Variance-based (Sobol) indices of the position error, estimated from arms with errors drawn at random.

With Y the error, S_k = V(E[Y | g_k]) / V(Y) is the share that g_k makes alone, S_Tk = 1 − V(E[Y | all but g_k]) / V(Y)
the share that goes when everything but g_k is known. Two samples A, B of arms and, for every k, A with the k-th error
of B (Saltelli et al. 2010, Computer Physics Communications 181:259) give

    V_k = mean f(B) (f(A_B^k) − f(A)),        V_Tk = ½ mean (f(A_B^k) − f(A))²            (Saltelli; Jansen)

Y has many components: x, y, z at every posture, or the distance at every posture. Their variances are added up before
they are divided (Lamboni, Monod & Makowski 2011), so postures where nothing happens count little. For an error vector
that is linear in the parameters, both indices are the parameters' shares of the mean square; the distance is not
linear, and S_T − S shows it. The whole is repeated with differently scrambled Sobol sequences, which gives a standard
error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from modcal_core.geometry.so3 import Array
from modcal_core.planning.closed_chain import ClosedChain
from modcal_core.planning.designs import sobol_points

OUTPUTS = ("vector", "distance")
ARMS = 128  # for time


@dataclass(frozen=True)
class SobolIndices:
    """first, total: (P,). std_first, std_total: their standard errors, (P,). variance: of the output [m²], mean."""

    first: Array
    total: Array
    std_first: Array
    std_total: Array
    variance: float


def sobol_indices(
    closed: ClosedChain,
    q: Array,
    sizes: Array,
    rng: np.random.Generator,
    output: str = "vector",
    arms: int = ARMS,
    repeats: int = 6,
) -> SobolIndices:
    """Sobol indices of the position error over postures q (N, n), errors Gaussian with standard deviations sizes (P,).

    output: ``vector``, the error's components, or ``distance``, its length. arms: in each of the samples A and B.
    repeats: independent estimates, from whose scatter the standard errors come.
    """
    assert output in OUTPUTS, output
    nominal = closed.positions(q, np.zeros(len(sizes)))

    def f(errors: Array) -> Array:
        moved = closed.positions(q, errors) - nominal
        return (moved if output == "vector" else np.linalg.norm(moved, axis=-1)).reshape(len(errors), -1)

    both = [_once(f, sizes, rng, arms) for _ in range(repeats)]
    first, total, variance = (np.array(part) for part in zip(*both, strict=True))
    scatter = np.sqrt(repeats)
    components = 3 if output == "vector" else 1
    return SobolIndices(
        first.mean(axis=0),
        total.mean(axis=0),
        first.std(axis=0, ddof=1) / scatter,
        total.std(axis=0, ddof=1) / scatter,
        float(variance.mean()) * components,
    )


def _once(f: object, sizes: Array, rng: np.random.Generator, arms: int) -> tuple[Array, Array, float]:
    assert callable(f)
    P = len(sizes)
    A, B = np.split(ndtri(sobol_points(arms, 2 * P, rng)) * np.tile(sizes, 2), 2, axis=1)
    fA, fB = f(A), f(B)
    centre = 0.5 * (fA.mean(axis=0) + fB.mean(axis=0))  # the estimators do not change with it, their scatter does
    fA, fB = fA - centre, fB - centre
    variance = float(0.5 * (np.mean(fA**2) + np.mean(fB**2)))
    first, total = np.empty(P), np.empty(P)
    for k in range(P):
        mixed = A.copy()
        mixed[:, k] = B[:, k]
        step = f(mixed) - centre - fA
        first[k] = np.mean(fB * step) / variance
        total[k] = 0.5 * np.mean(step**2) / variance
    return first, total, variance
