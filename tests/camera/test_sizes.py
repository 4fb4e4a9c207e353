"""Sizes of errors that are as likely as a plain search finds them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from camera.fits import alone, images, start
from scipy.optimize import minimize

from modcal_core.camera.corners import common_prior
from modcal_core.camera.equations import Sizes
from modcal_core.camera.fit import START, CameraFit, fit_cameras, likeliest, usual
from modcal_core.geometry.so3 import Array


@cache
def fitted(on_tip: bool) -> CameraFit:
    s = images(on_tip)
    table, arm = start(s)
    return fit_cameras(alone(table, arm, common_prior(s.lens, s.board.scale), s.lens))


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_sizes_are_those_of_a_plain_search(on_tip: bool) -> None:
    """From where nothing is known, and from the end: as likely as simplexes (Nelder & Mead) of all sizes find any."""
    fit = fitted(on_tip)

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
