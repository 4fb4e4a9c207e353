"""Bounds of one joint while the others accelerate as given, on drives that do not feel each other."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.robots.acceleration import Window

# a gantry of two slides: 2 kg and 5 kg, drives of −10 … 20 N and −30 … 40 N
GANTRY = Window(("x", "y"), np.diag([2.0, 5.0])[None], np.array([[-10.0, -30.0]]), np.array([[20.0, 40.0]]))


@pytest.mark.slow
@pytest.mark.parametrize("of_y", [-6.0, 0.0, 8.0])
def test_a_joint_that_can_do_what_it_is_given_does_not_touch_the_other(of_y: float) -> None:
    lower, upper = GANTRY.given([0.0, of_y])
    assert (lower[0, 0], upper[0, 0]) == (-5.0, 10.0)


@pytest.mark.slow
@pytest.mark.parametrize("of_y", [-6.1, 8.1])
def test_a_joint_that_is_given_too_much_leaves_the_other_nothing(of_y: float) -> None:
    lower, upper = GANTRY.given([0.0, of_y])
    assert np.isnan([lower[0, 0], upper[0, 0]]).all()
