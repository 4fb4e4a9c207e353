"""Other forms of one cause: a delay of a joint is a share of commanded − measured, or a time.

The scan is linear, and there a time and a share of what a steadily following joint has still to go are one column. What
tells them apart is of second order: the joint's acceleration times half a delay and a lead of the commands. It is as
small as a gear ratio of 1e-5, and would be called one beside the wrong form. So the forms are fitted, and compared.
"""

from __future__ import annotations

from collections.abc import Iterable

from modcal_core.effects import Effect

_NOT_LINEAR = "velocity"  # the driver of delays, whose second order is in the fit and not in the scan


def other_forms(effect: Effect, candidates: Iterable[Effect]) -> tuple[Effect, ...]:
    """The candidates of the same family, place and direction by another driver, where the scan sees one of the two to
    first order only; each has as many amplitudes as the effect. Empty for an effect that has one form.
    """
    late = effect.driver == _NOT_LINEAR
    return tuple(
        other
        for other in candidates
        if (late or other.driver == _NOT_LINEAR)
        and other.driver != effect.driver
        and (other.family, other.place, other.direction) == (effect.family, effect.place, effect.direction)
        and other.shape.size == effect.shape.size
    )
