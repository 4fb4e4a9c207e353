"""How large residuals are, and how much they count."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.noise import score_of_one, standard_score


def test_the_score_of_one_is_that_of_many() -> None:
    squares = np.r_[0.0, np.logspace(-12, 9, 60)]
    for dimensions in (1, 2, 3, 6):
        one = [score_of_one(float(square), dimensions) for square in squares]
        assert np.abs(one / standard_score(squares, dimensions) - 1.0).max() < 1e-12
