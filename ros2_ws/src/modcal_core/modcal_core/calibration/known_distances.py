"""Known distances beside what a fit makes of them: whether the data contradict what was stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.distances import CONTRADICTED, AnyDistance, Distance, distance_rows
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.scale import ScaleEstimate, scale_without_distances
from modcal_core.calibration.uncertainty import Uncertainty, uncertainty
from modcal_core.measurements.samples import Samples

_ROUNDING = 1e-9  # share of a stated distance's variance; where less is left, nothing but the statement tells it


@dataclass(frozen=True)
class KnownDistance:
    """A known distance: its ends by name, as stated with its deviation [m], and what the readings make of it.

    residual: stated minus that of the fit [m]. found, std: what the readings say of it by themselves, without this
    statement, and its deviation, with what the model does not explain of the two ends [m].
    """

    name: str
    stated: float
    stated_std: float
    residual: float
    found: float
    std: float

    @property
    def contradicted(self) -> bool:
        """Whether stated and found differ by more than their deviations allow."""
        return abs(self.stated - self.found) > CONTRADICTED * float(np.hypot(self.stated_std, self.std))

    @property
    def sentence(self) -> str:
        """What a person should know of a contradiction."""
        return (
            f"The known distance {self.name} is stated as {1e3 * self.stated:.3f} ± {1e3 * self.stated_std:.3f} mm, "
            f"the readings say {1e3 * self.found:.3f} ± {1e3 * self.std:.3f} mm"
        )


def distances_of(fit: Fit, samples: Samples, distances: Sequence[AnyDistance]) -> tuple[KnownDistance, ...]:
    """Every known distance as a fit to these samples has it."""
    if not distances:
        return ()
    known = known_distances(fit, uncertainty(fit.model, samples, fit.parameters, fit, distances), distances)
    scale = scale_without_distances(fit, samples, distances) if len(distances) == 1 else None
    return known if scale is None else (_by_scale(known[0], scale, fit),)


def _by_scale(only: KnownDistance, scale: ScaleEstimate, fit: Fit) -> KnownDistance:
    """The only known distance, beside what fixed points and the drawing say of the scale without it."""
    std = float(np.hypot(scale.std * only.stated, np.sqrt(2.0) * fit.noise.position))
    return replace(only, found=(1.0 + scale.longer) * only.stated, std=std)


def known_distances(fit: Fit, known: Uncertainty, distances: Sequence[AnyDistance]) -> tuple[KnownDistance, ...]:
    """Every known distance as a fit has it.

    known: the uncertainty of the fit's model, the distances included in it. With the stated variance s², the residual r
    and the row J of a distance, its leverage is h = J C Jᵀ / s²; without it the residual were r / (1 − h) and the
    variance of the modelled distance h s² / (1 − h). What the model leaves unexplained of either end comes on top, for
    it is no noise that many readings average away.
    """
    parameters = known.parameters
    values = np.concatenate([np.zeros(len(parameters)), *(e.values for e in fit.model.effects)])
    rows = distance_rows(fit.model, parameters, values, distances)
    of_found = np.einsum("kd,kl,ld->d", rows.J, known.covariance, rows.J)
    out = []
    for distance, r, v in zip(distances, rows.residual.tolist(), of_found.tolist(), strict=True):
        free = max(1.0 - v / distance.std**2, _ROUNDING)
        std = float(np.sqrt(max(v, 0.0) / free + 2.0 * fit.noise.position**2))
        found = distance.distance - r / free
        out.append(KnownDistance(_name(distance), distance.distance, distance.std, r, found, std))
    return tuple(out)


def _name(distance: AnyDistance) -> str:
    if isinstance(distance, Distance):
        return f"{distance.between[0]} to {distance.between[1]}"
    return f"between the stations at {distance.stamps[0]:.3f} and {distance.stamps[1]:.3f} s"


def contradictions(known: Sequence[KnownDistance]) -> tuple[str, ...]:
    """A sentence for each distance that the data contradict."""
    return tuple(distance.sentence for distance in known if distance.contradicted)
