"""What was fitted explains none of what is weighed: held-out samples lie in its columns too, and are freed of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from calibration.test_identify import fit_all
from cells import record, ur10

from modcal_core.diagnosis.evidence import Scanner
from modcal_core.geometry import se3


def test_a_difference_that_the_parameters_can_take_up_is_not_weighed() -> None:
    """The base stands 0.1 mm elsewhere at the held-out stations: that is no candidate's to explain."""
    made = record(3, 160, "point")
    rows = np.arange(len(made.samples))
    fit = fit_all(ur10(), made.samples.select(rows[:80]))
    held_out = made.samples.select(rows[80:])
    moved = replace(held_out, reading=se3.apply(se3.exp([1e-4, 0, 0, 0, 0, 0]), held_out.reading))
    left = []
    for samples in (held_out, moved):
        drivers = fit.model.drivers(samples)
        space = Scanner([], drivers).space_of(fit)
        left.append(float(np.sum(space.residual**2)))
        along = np.einsum("cNp,cN->p", space.Q, space.residual)
        assert np.sum(along**2) < 1e-3 * np.sum(space.residual**2)
    # without that the 0.1 mm, five times the noise, would be 25 / 3 times as much
    assert left[1] < 1.5 * left[0]
