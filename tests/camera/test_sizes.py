"""The minimum that is found downhill, and sizes of errors that are as likely as a plain search finds them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from camera.fits import images, start
from scipy.optimize import minimize

from modcal_core.camera.corners import common_prior
from modcal_core.camera.descent import downhill
from modcal_core.camera.equations import Sizes
from modcal_core.camera.fit import START, CameraFit, fit_camera, likeliest, usual
from modcal_core.geometry.so3 import Array

LOW, HIGH = np.full(4, -5.0), np.full(4, 5.0)


class Valley:
    """cosh of four values seen askew, which no parabola is; it counts how often it was asked."""

    def __init__(self, lowest: Array) -> None:
        rng = np.random.default_rng(3)
        self.lowest, self.calls = lowest, 0
        self.askew = np.linalg.qr(rng.normal(size=(4, 4)))[0] * [8.0, 3.0, 1.5, 0.8]

    def __call__(self, x: Array) -> float:
        self.calls += 1
        return float(np.sum(np.cosh(np.clip(0.2 * (x - self.lowest) @ self.askew, -50.0, 50.0))))


def test_the_lowest_place_is_found_from_near_and_far() -> None:
    lowest = np.array([0.3, -1.0, 2.0, 0.5])
    for away, most in ((0.0, 9), (0.1, 60), (2.0, 130)):
        valley = Valley(lowest)
        begin = lowest + away * np.array([1.0, -0.5, 0.3, 0.8])
        found = downhill(valley, begin, LOW, HIGH, np.full(4, 1e-3), 1e-5, 1000)
        assert valley(found) - 4.0 < 3e-5
        assert valley.calls - 1 <= most


def test_bounds_hold_and_the_rest_is_lowest_beside_them() -> None:
    """Of values that are tied to each other the others move where one may not go on."""
    tied = np.array([[2.0, 1.0], [1.0, 3.0]])

    def bowl(x: Array) -> float:
        return float(0.5 * (x - 4.0) @ tied @ (x - 4.0))

    found = downhill(bowl, np.array([0.5, 0.0]), np.full(2, -1.0), np.array([1.0, 9.0]), np.full(2, 1e-3), 1e-9, 400)
    assert found[0] == 1.0
    assert found[1] == pytest.approx(4.0 + 1.0, abs=1e-4)  # the slope by the second: 1 (1 - 4) + 3 (x - 4) = 0


def test_no_step_is_begun_after_so_many_calls() -> None:
    valley = Valley(np.zeros(4))
    downhill(valley, np.full(4, 3.0), LOW, HIGH, np.full(4, 1e-3), 0.0, 20)
    assert valley.calls < 20 + 4 + 20


@cache
def fitted(on_tip: bool) -> CameraFit:
    s = images(on_tip)
    table, arm = start(s)
    return fit_camera(table, arm, common_prior(s.lens, s.board.scale), s.lens)


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
