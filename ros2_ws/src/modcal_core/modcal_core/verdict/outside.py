"""A frozen calibration outside what it has seen: whether it misses there by more than it did where it was found.

Returns in another recording know its floor to a factor only, six of them to about two. How far the calibration missed
on its own recording is known far better. Where joints, temperatures or time lie outside what that held, and the error
is surely larger than there, the model does not hold here, even where the returns alone would allow it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.verdict.case import Case
from modcal_core.verdict.contributions import mean_square, resampled
from modcal_core.verdict.estimation import estimation
from modcal_core.verdict.floor import Floors

MAX_ABOVE_OWN = 1.44  # E² in units of that of the calibration's own recording: a fifth more in RMS


def worse_outside(case: Case, known: Floors, outside: tuple[str, ...]) -> Iterator[str]:
    """A sentence where a frozen model misses by more than it did on its own recording, and is used outside of it.

    known: the floors of this recording; what is no larger than them is the instrument's or the arm's scatter here.
    outside: sentences on what lies outside.
    """
    if case.fitted or not outside:
        return
    own = 1e6 * 3.0 * case.noise.position**2
    square, (low, _) = resampled(mean_square(case.errors["final"], angle=False), case.samples.station[case.held_out])
    here = max(own, known.position.square if known.position else 0.0)
    if low > MAX_ABOVE_OWN * here + estimation(case)[0]:
        yield (
            f"Position: {np.sqrt(square):.3g} mm RMS is left, and {np.sqrt(own):.3g} mm was on the calibration's own "
            f"recording, and it is used outside that recording here. {' '.join(outside)}"
        )
