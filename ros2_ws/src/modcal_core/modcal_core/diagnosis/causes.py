"""What a diagnosis says: the effects that were chosen, each with why, and what is left."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Fit, beyond_normal
from modcal_core.diagnosis.choice import EffectChoice, one_motion_names
from modcal_core.diagnosis.evidence_map import EvidenceMap
from modcal_core.effects import Effect
from modcal_core.measurements import Samples, joints_instead


@dataclass(frozen=True)
class Cause:
    """An effect that was chosen, and why. p_value: that noise would look as good. same_as, rivals: what explains it
    as well, by name and as effects. fit: to *train* with this effect and the ones before it. sampled: trials with the
    signs of stations flipped that p_value was compared with; below one in so many it is extrapolated.
    """

    effect: Effect
    p_value: float
    same_as: tuple[str, ...]
    rivals: tuple[Effect, ...]
    fit: Fit
    sampled: int = 0


def causes_of_moves(fit: Fit, samples: Samples) -> tuple[Cause, ...]:
    """The causes of a fit's moves of base and tool, each with those before it: they were found before all others."""
    effects = fit.model.effects
    out = []
    for i, effect in enumerate(effects):
        model = fit.model.with_effects(effects[: i + 1])
        same = (*one_motion_names(effect), *joints_instead(samples, effect.shape.settings["at"]))
        size = float(np.max(np.abs(effect.values) / np.maximum(effect.std, 1e-300)))
        out.append(Cause(effect, max(2.0 * beyond_normal(size), 1e-300), same, (), replace(fit, model=model)))
    return tuple(out)


@dataclass(frozen=True)
class Diagnosis:
    """fit: to *train*, with the effects. causes: in the order found, with their fitted effects. left: what is
    significant still but could not be turned into an effect that predicts, None where the rest is noise. maps: what
    the first scan saw and what the last one did. again: True for samples of *train* that the fit had rejected and that
    were taken in again, (N,); None where none were.
    """

    fit: Fit
    causes: tuple[Cause, ...]
    left: EffectChoice | None
    maps: tuple[EvidenceMap, ...] = ()
    again: np.ndarray | None = None
