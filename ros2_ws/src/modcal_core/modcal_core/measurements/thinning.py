"""Some rows of many, spread evenly over them, that no raster of postures meets.

Of a raster, every n-th row may have one joint in the same place each time: what depends on that joint is then not seen
at all. The rows i with the smallest fractional parts of i φ, φ the golden ratio, come at three distances, near one
another (three-distance theorem), and take each residue of every period equally often (Weyl): they are as even as every
n-th row, and have no period.
"""

from __future__ import annotations

import numpy as np

_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # of all numbers the one that fractions approach most slowly


def spread_rows(count: int, most: int) -> np.ndarray:
    """Ascending numbers out of 0 … count − 1, spread over them: all of them, or ``most`` where there are more."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.argsort(np.arange(count) * _GOLDEN % 1.0, kind="stable")[:most])
