"""The Sobol points of plans are SciPy's, bit by bit, and leave the caller's stream of random numbers where SciPy does."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import qmc

from modcal_core.planning.sobol import sobol_points


@pytest.mark.parametrize("dimensions", [1, 2, 6, 7, 16, 17, 66])
def test_points_are_those_of_scipy(dimensions: int) -> None:
    for count in (1, 2, 5, 64, 1000):
        ours, theirs = np.random.default_rng(count), np.random.default_rng(count)
        points = sobol_points(count, dimensions, ours)
        whole = 1 << max(count - 1, 0).bit_length()
        assert np.array_equal(points, qmc.Sobol(dimensions, seed=theirs).random(whole)[:count])
        assert ours.random() == theirs.random()


def test_a_plan_does_without_scipy_stats() -> None:
    """Which takes half a second to import: as long as the plan itself."""
    code = (
        "import sys; import modcal_core.planning.plan, modcal_core.report.planning; print('scipy.stats' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "False\n"
