"""Moves of base and tool during a recording, and fits that begin about where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from modcal_core.calibration.distances import AnyDistance
from modcal_core.calibration.identify import CONVERGED, Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects.effect import is_move
from modcal_core.measurements.samples import Samples

_ROUGHLY = 1.0  # standard deviations to which a fit is brought before anything may be rejected
What = Literal["base", "tool", "both"]
WHATS: tuple[What, ...] = ("base", "tool", "both")


@dataclass(frozen=True)
class Move:
    """Base, tool or both moved at a time [s] between two stations."""

    at: float
    what: What


def identify_moved(
    start: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    distances: Sequence[AnyDistance] = (),
    tolerance: float = CONVERGED,
    reject: bool = True,
) -> Fit:
    """The fit of a model whose base or tool moved; as :func:`identify` where nothing did.

    A move is known as well as the arm that it was estimated with. Its stations may then lie far outside what the fitted
    arm leaves, and must not be rejected before the move itself has been fitted.
    """
    if not any(is_move(effect) for effect in start.effects):
        return identify(start, samples, parameters, distances, tolerance=tolerance, reject=reject)
    first = identify(start, samples, parameters, distances, tolerance=_ROUGHLY, reject=False)
    start = start.with_effects(first.model.effects)
    return identify(start, samples, parameters, distances, tolerance=tolerance, begin=first.values, reject=reject)
