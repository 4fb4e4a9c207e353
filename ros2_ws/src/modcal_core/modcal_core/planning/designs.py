"""Sets of postures over the joints' ranges: orthogonal arrays and Sobol sequences.

An orthogonal array of strength 2 shows, in any two of its columns, every pair of levels equally often. For a prime
number of levels s the columns are linear forms over the field of s elements: runs are the vectors u of s^k, columns
the vectors c whose first number that is not zero is 1, and the entry is u · c mod s (Bose & Bush 1952). That gives
(s^k − 1) / (s − 1) columns; with s = 5 and k = 2 it is Taguchi's L25(5^6).
"""

from __future__ import annotations

from itertools import product

import numpy as np

from modcal_core.calibration import joint_ranges
from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.robots import Mechanism, takes

DESIGNS = ("l25", "array", "sobol")
_MAX_RUNS = 20_000  # for time
_DRAWN = 8  # times as many postures as are wanted of a robot that cannot take all of them
_SAME = 1e-6  # rad


def orthogonal_array(factors: int, levels: int) -> np.ndarray:
    """The smallest array of strength 2 with these columns, entries 0 … levels − 1, (levels^k, factors).

    Raises BadTable unless levels is a prime, and where the array would have more than 20 000 rows.
    """
    if levels < 2 or any(levels % d == 0 for d in range(2, int(levels**0.5) + 1)):
        raise BadTable(
            f"orthogonal array of {levels} levels", "the number is not a prime", "choose 2, 3, 5, 7, 11 or 13"
        )
    k = 2
    while (levels**k - 1) // (levels - 1) < factors:
        k += 1
    if levels**k > _MAX_RUNS:
        said = f"{levels**k} runs, {_MAX_RUNS} are the limit"
        raise BadTable(f"orthogonal array of {factors} factors at {levels} levels", said, "choose fewer levels")
    # unit vectors last to first, then the sums: i, j, i + j, i + 2 j … for two
    forms = sorted(
        (c for c in product(range(levels), repeat=k) if any(c) and c[np.flatnonzero(c)[0]] == 1),
        key=lambda c: (sum(x > 0 for x in c), tuple(x > 0 for x in reversed(c)), c),
    )
    runs = np.array(list(product(range(levels), repeat=k)))
    return np.asarray(runs @ np.array(forms[:factors]).T % levels)


def array_postures(chain: Mechanism, levels: int) -> Array:
    """Postures (N, n) [rad, m] of the orthogonal array, every joint at so many levels from its least to its largest.

    Where some levels of a turning joint would be the same angle, its levels are spread over one turn instead.
    """
    low, high = joint_ranges(chain)
    array = orthogonal_array(chain.n, levels)
    q = np.stack(
        [_levels(low[k], high[k], levels, bool(chain.revolute[k]))[array[:, k]] for k in range(chain.n)], axis=1
    )
    return q[takes(chain, q)]


def _levels(low: float, high: float, count: int, turns: bool) -> Array:
    at = np.linspace(low, high, count)
    if turns:
        apart = np.abs(np.angle(np.exp(1j * (at[:, None] - at[None]))))[np.triu_indices(count, 1)]
        if apart.min() < _SAME:
            return np.asarray(0.5 * (low + high) + 2.0 * np.pi * ((np.arange(count) + 0.5) / count - 0.5))
    return at


def sobol_postures(chain: Mechanism, count: int, rng: np.random.Generator) -> Array:
    """Postures (count, n) [rad, m] of a scrambled Sobol sequence over the joints' ranges.

    Of a Delta those that its platform fits, and fewer where hardly any does.
    """
    low, high = joint_ranges(chain)
    q = np.asarray(low + (high - low) * sobol_points(count * (_DRAWN if chain.closed else 1), chain.n, rng))
    return q[takes(chain, q)][:count] if chain.closed else q


def sobol_points(count: int, dimensions: int, rng: np.random.Generator) -> Array:
    """The first points of a scrambled Sobol sequence, (count, dimensions), each number in (0, 1)."""
    whole = 1 << max(count - 1, 0).bit_length()  # the sequence is balanced at powers of two
    from scipy.stats import qmc  # takes half a second, and every calibration imports this file

    return np.asarray(qmc.Sobol(dimensions, seed=rng).random(whole)[:count])


def design(chain: Mechanism, kind: str, rng: np.random.Generator, levels: int = 5, count: int = 64) -> Array:
    """Postures (N, n) of a design by name.

    ``l25``: the source's, five levels, up to six joints. ``array``: that of ``levels`` levels for any number of joints.
    ``sobol``: ``count`` of a Sobol sequence. Raises BadTable.
    """
    if kind == "sobol":
        return sobol_postures(chain, count, rng)
    if kind == "array":
        return array_postures(chain, levels)
    if kind != "l25":
        raise BadTable(f"design '{kind}'", "is not known", f"choose {', '.join(DESIGNS)}")
    if chain.n > 6:
        raise BadTable("design l25", f"it has 6 columns, the arm {chain.n} joints", "use --design array or sobol")
    return array_postures(chain, 5)
