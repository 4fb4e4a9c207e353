"""The one checker of derivatives, for every Jacobian in the project."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def assert_jacobian(
    f: Callable[[Vector], Vector],
    J: Vector,
    x: Vector,
    step: float = 1e-5,
    tolerance: float = 1e-8,
    difference: Callable[[Vector, Vector], Vector] = np.subtract,
) -> None:
    """J (m, n) is the derivative of f at x (n,), to a share of its largest entry.

    Fourth-order central differences. ``difference(a, b)`` is a − b, for outputs that do not lie in a plain space.
    """
    columns = []
    for j in range(len(x)):
        d = np.zeros(len(x))
        d[j] = step
        near = difference(f(x + d), f(x - d)) / (2.0 * step)
        far = difference(f(x + 2.0 * d), f(x - 2.0 * d)) / (4.0 * step)
        columns.append((4.0 * near - far) / 3.0)
    expected = np.stack(columns, axis=-1)
    assert J.shape == expected.shape, (J.shape, expected.shape)
    gap = np.abs(J - expected)
    limit = tolerance * max(1.0, float(np.abs(expected).max()))
    worst = np.unravel_index(int(gap.argmax()), gap.shape)
    assert gap.max() <= limit, f"entry {worst}: {J[worst]:.12g} is not {expected[worst]:.12g} (limit {limit:.1g})"
