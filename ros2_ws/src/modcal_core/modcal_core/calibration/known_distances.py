"""Known distances beside what a fit makes of them: whether the data contradict what was stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.distances import AnyDistance, Distance, distance_rows
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.uncertainty import Uncertainty, uncertainty
from modcal_core.measurements.samples import Samples

CONTRADICTED = 4.0  # combined standard deviations
_CHECKED = 1e-2  # share of a stated distance's variance that must be left for the data to have a say in it


@dataclass(frozen=True)
class KnownDistance:
    """A known distance: its ends by name, as stated with its deviation, and as the fit has it [m].

    std: deviation of the found distance. allowed: deviation of stated minus found, what the model does not explain
    included; None where nothing but the statement itself tells the distance.
    """

    name: str
    stated: float
    stated_std: float
    found: float
    std: float
    allowed: float | None

    @property
    def contradicted(self) -> bool:
        """Whether stated and found differ by more than their deviations allow."""
        return self.allowed is not None and abs(self.stated - self.found) > CONTRADICTED * self.allowed

    @property
    def sentence(self) -> str:
        """What a person should know of a contradiction."""
        return (
            f"The known distance {self.name} is stated as {1e3 * self.stated:.3f} ± {1e3 * self.stated_std:.3f} mm, "
            f"the readings have {1e3 * self.found:.3f} mm"
        )


def distances_of(fit: Fit, samples: Samples, distances: Sequence[AnyDistance]) -> tuple[KnownDistance, ...]:
    """Every known distance as a fit to these samples has it."""
    if not distances:
        return ()
    return known_distances(fit, uncertainty(fit.model, samples, fit.parameters, fit, distances), distances)


def known_distances(fit: Fit, known: Uncertainty, distances: Sequence[AnyDistance]) -> tuple[KnownDistance, ...]:
    """Every known distance as a fit has it.

    known: the uncertainty of the fit's model, the distances included in it. With the stated variance s² and the row J
    of a distance, the residual's own variance is s² − J C Jᵀ; what the model leaves unexplained of either end comes on
    top, for it is no noise that many readings average away.
    """
    parameters = known.parameters
    values = np.concatenate([np.zeros(len(parameters)), *(e.values for e in fit.model.effects)])
    rows = distance_rows(fit.model, parameters, values, distances)
    of_found = np.einsum("kd,kl,ld->d", rows.J, known.covariance, rows.J)
    return tuple(
        _known(d, float(r), float(v), fit.spread.position, rows.std[i])
        for i, (d, r, v) in enumerate(zip(distances, rows.residual, of_found, strict=True))
    )


def _known(distance: AnyDistance, residual: float, variance: float, unexplained: float, stated: float) -> KnownDistance:
    free = stated**2 - variance
    # both ends are off by what the model does not explain, along the line between them
    allowed = float(np.sqrt(free + 2.0 * unexplained**2)) if free > _CHECKED * stated**2 else None
    found = distance.distance - residual
    return KnownDistance(_name(distance), distance.distance, stated, found, float(np.sqrt(max(variance, 0.0))), allowed)


def _name(distance: AnyDistance) -> str:
    if isinstance(distance, Distance):
        return f"{distance.between[0]} to {distance.between[1]}"
    return f"between the stations at {distance.stamps[0]:.3f} and {distance.stamps[1]:.3f} s"


def contradictions(known: Sequence[KnownDistance]) -> tuple[str, ...]:
    """A sentence for each distance that the data contradict."""
    return tuple(distance.sentence for distance in known if distance.contradicted)
