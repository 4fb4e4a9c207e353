"""Sizes of errors that are as likely as a plain search finds them."""

from __future__ import annotations

import numpy as np
import pytest
from camera.fits import alone, images, start
from scipy.optimize import minimize

from modcal_core.camera.corners import common_prior
from modcal_core.camera.equations import Sizes
from modcal_core.camera.fit import START, fit_cameras, likeliest, usual
from modcal_core.geometry.so3 import Array


@pytest.mark.slow
def test_sizes_are_those_of_a_plain_search() -> None:
    """From where nothing is known, and from the end: as likely as simplexes (Nelder & Mead) of all sizes find any."""
    s = images(True)
    table, arm = start(s)
    fit = fit_cameras(alone(table, arm, common_prior(s.lens, s.board.scale), s.lens))

    def misfit(logs: Array) -> float:
        every = START.logs
        every[[0, 1, 2, 3, 5]] = logs
        sizes = Sizes.of_logs(every)
        return fit.equations.solve(sizes).misfit() + usual(sizes)

    begin = START.logs[[0, 1, 2, 3, 5]]
    for size in (1.0, 0.5):
        simplex = np.vstack([begin, begin + size * np.eye(5)])
        options = {"initial_simplex": simplex, "maxfev": 2000, "fatol": 1e-4, "xatol": 1e-3}
        plain = minimize(misfit, begin, method="Nelder-Mead", options=options)
        begin = plain.x
    for found in (likeliest(fit.equations, START, afar=True), likeliest(fit.equations, fit.sizes)):
        assert misfit(found.logs[[0, 1, 2, 3, 5]]) < plain.fun + 0.02
        assert np.abs(found.logs[:2] - plain.x[:2]).max() < 0.1
