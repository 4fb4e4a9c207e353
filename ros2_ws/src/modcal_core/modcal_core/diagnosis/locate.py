"""Where what a model leaves over sits and what it correlates with, where the verdict is open and nothing was named.

The candidates of the diagnosis are weighed once against the residual, together with constant errors of base, tool and
joints, which a fit would have taken up and a frozen model has not. No chance is given for the best: the verdict has
found already that something is left. It is named only where it explains a good part.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import Fit, Model, NoiseModel
from modcal_core.diagnosis.choice import EffectChoice, choose
from modcal_core.diagnosis.evidence import Scanner
from modcal_core.effects import candidates
from modcal_core.effects.families import unknown
from modcal_core.measurements import Samples, spread_rows

_WORTH_NAMING = 0.2  # share of the squared residual, beyond what as many amplitudes explain by chance
_NEARLY = 0.9  # share of the best explanation; what only stands elsewhere is plainer than any curve
_MAX_SCANNED = 500  # samples; more are thinned evenly


def located(fit: Fit, samples: Samples) -> EffectChoice | None:
    """The candidate that explains most of what the fit leaves over, None where none explains much.

    Constant errors are looked for where the fit has no parameters of its own.
    """
    rows = spread_rows(len(samples), _MAX_SCANNED)
    drivers = fit.model.drivers(samples.select(rows))
    constant = unknown.constants(drivers) if fit.frozen else ()
    scanner = Scanner([*candidates(drivers), *constant], drivers)
    if not scanner.enough(fit):
        return None
    evidence = scanner.evidence(fit)
    beyond = evidence.explained - np.array([e.shape.size for e in evidence.effects]) / evidence.freedom
    if not len(beyond) or beyond.max() < _WORTH_NAMING:
        return None
    plain = np.array([e.public_driver == "constant" for e in evidence.effects])
    others: set[tuple[str, str, str, str]] = set()
    if plain.any() and beyond[plain].max() > _NEARLY * beyond.max():
        others = {effect.key for effect, is_plain in zip(evidence.effects, plain, strict=True) if not is_plain}
    choice = choose(evidence, scanner, fit, others)
    return None if choice is None or choice.share < _WORTH_NAMING else choice


def frozen(model: Model, noise: NoiseModel, refitted: Fit | None = None) -> Fit:
    """A model as a fit of nothing, or of the base and tool that were found again; its effects as they are."""
    none, square = np.empty(0), np.empty((0, 0))
    if refitted is None:
        return Fit(model, model, (), none, square, noise, none, square, 0, frozen=True)
    return replace(refitted, model=model, start=model, noise=noise, frozen=True)
