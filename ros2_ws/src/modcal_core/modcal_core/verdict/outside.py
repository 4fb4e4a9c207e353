"""A frozen calibration outside what it has seen: whether it misses there by more than it did where it was found.

Returns in another recording know its floor to a factor only, six of them to about two. How far the calibration missed
on its own recording is known far better. Where joints, temperatures or time lie outside what that held, and the error
is surely larger than there, the model does not hold here, even where the returns alone would allow it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from modcal_core.verdict.case import Case
from modcal_core.verdict.floor import Floor
from modcal_core.verdict.tails import Tail
from modcal_core.verdict.verdict import Repeatability

MAX_ABOVE_OWN = 1.44  # E² in units of that of the calibration's own recording: a fifth more in RMS


def worse_outside(case: Case, tail: Tail, outside: tuple[str, ...]) -> Iterator[str]:
    """A sentence where a frozen model misses by more than it did on its own recording, and is used outside of it.

    tail: of positions here; what is no larger than its floor is the instrument's or the arm's scatter. outside:
    sentences on what lies outside.
    """
    if case.fitted or not outside:
        return
    own = 1e6 * 3.0 * case.noise.position**2
    here = max(own, tail.floor.square if tail.floor else 0.0)
    if replace(tail, floor=Floor(here, (here, here), Repeatability(None, None), 0.0)).above(MAX_ABOVE_OWN):
        yield (
            f"Position: {np.sqrt(tail.square):.3g} mm RMS is left, and {np.sqrt(own):.3g} mm was on the calibration's "
            f"own recording, and it is used outside that recording here. {' '.join(outside)}"
        )
