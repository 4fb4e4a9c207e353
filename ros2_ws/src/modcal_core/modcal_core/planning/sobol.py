"""Points of a scrambled Sobol sequence: those of ``scipy.stats.qmc.Sobol``, to the last bit.

``scipy.stats`` takes half a second to import, as long as a plan takes to compute; for as many dimensions as arms have
joints the sequence is a few exclusive ors. More dimensions are SciPy's own.

Direction numbers: S. Joe and F. Y. Kuo, "Constructing Sobol sequences with better two-dimensional projections", SIAM
J. Sci. Comput. 30(5), 2008 (new-joe-kuo-6). Scrambling, by random lower triangular matrices and a shift of the digits:
J. Matoušek, "On the L2-discrepancy for anchored boxes", J. Complexity 14, 1998.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modcal_core.geometry.so3 import Array

_BITS = 30
# of each dimension but the first: coefficients of its primitive polynomial, and the first numbers
_DIRECTIONS: tuple[tuple[int, tuple[int, ...]], ...] = (
    (0, (1,)),
    (1, (1, 3)),
    (1, (1, 3, 1)),
    (2, (1, 1, 1)),
    (1, (1, 1, 3, 3)),
    (4, (1, 3, 5, 13)),
    (2, (1, 1, 5, 5, 17)),
    (4, (1, 1, 5, 5, 5)),
    (7, (1, 1, 7, 11, 19)),
    (11, (1, 1, 5, 1, 1)),
    (13, (1, 1, 1, 3, 11)),
    (14, (1, 3, 5, 5, 31)),
    (1, (1, 3, 3, 9, 7, 49)),
    (13, (1, 1, 1, 15, 21, 21)),
    (16, (1, 3, 1, 13, 27, 49)),
)
Digits = NDArray[np.uint32]


def sobol_points(count: int, dimensions: int, rng: np.random.Generator) -> Array:
    """The first points of a scrambled Sobol sequence, (count, dimensions), each number in [0, 1)."""
    whole = 1 << max(count - 1, 0).bit_length()  # the sequence is balanced at powers of two
    if dimensions > len(_DIRECTIONS) + 1:
        from scipy.stats import qmc

        return np.asarray(qmc.Sobol(dimensions, seed=rng).random(whole)[:count])
    rng = rng.spawn(1)[0]  # as SciPy does: the caller goes on with its own stream
    two = np.uint32(1) << np.arange(_BITS, dtype=np.uint32)
    shift = rng.integers(2, size=(dimensions, _BITS), dtype=np.uint32) @ two
    triangular = np.tril(rng.integers(2, size=(dimensions, _BITS, _BITS), dtype=np.uint32))
    v = _scrambled(_direction_numbers(dimensions), triangular)
    n = np.arange(1, count)
    flipped = v[:, np.log2(n & -n).astype(int)]  # from one point to the next one digit of the Gray code changes
    points = np.bitwise_xor.accumulate(np.concatenate([shift[:, None], flipped], axis=1), axis=1)
    return np.asarray(points.T * 2.0**-_BITS)


def _direction_numbers(dimensions: int) -> Digits:
    """(dimensions, bits), the first digit behind the point highest."""
    out = np.ones((dimensions, _BITS), dtype=np.uint32)
    for row, (polynomial, first) in zip(out[1:], _DIRECTIONS, strict=False):
        s = len(first)
        row[:s] = first
        for i in range(s, _BITS):
            row[i] = row[i - s] ^ (row[i - s] << s)
            for k in range(1, s):
                if polynomial >> (s - 1 - k) & 1:
                    row[i] ^= row[i - k] << k
    return out << np.arange(_BITS - 1, -1, -1, dtype=np.uint32)


def _scrambled(v: Digits, triangular: Digits) -> Digits:
    """Direction numbers whose digits are multiplied, modulo 2, by lower triangular matrices with a diagonal of ones."""
    at = np.arange(_BITS - 1, -1, -1, dtype=np.uint32)
    digits = v[:, :, None] >> at & 1  # the first digit first
    matrix = triangular | np.eye(_BITS, dtype=np.uint32)
    mixed = np.einsum("dpk,djk->djp", matrix, digits) & 1
    return np.asarray(mixed @ (np.uint32(1) << at), dtype=np.uint32)
