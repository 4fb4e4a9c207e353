"""What explains more than an effect that a fit has already, were that not there.

Beside an effect candidates have no more new directions than without it, so that what they would explain without it is
no more than by their products beside it, which the next scan asks for in any case. Waves, nine in ten of all, are
hardly ever near: where even so none of them comes up to the effect, they are not weighed again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import Fit
from modcal_core.diagnosis.choice import EffectChoice, choose, near
from modcal_core.diagnosis.evidence import Scanner
from modcal_core.effects import FREE, Effect, complexity


def better_choice(number: int, fit: Fit, scanner: Scanner) -> tuple[EffectChoice, Effect] | None:
    """The choice that explains more than one of a fit's effects, and its effect with amplitudes to begin from; None
    where none does, or one that is the same entry of a report.
    """
    effects = fit.model.effects
    old = effects[number]
    without = replace(fit, model=fit.model.with_effects(effects[:number] + effects[number + 1 :]))
    plain = complexity(old) < FREE  # a plain cause is not given up for a curve
    if plain and not old.refined and _stands(old, without, fit, scanner):  # what waves explain is not known then
        return None
    evidence = scanner.evidence(without, plain=plain)
    better = choose(evidence, scanner, without, set(), incumbent=old)
    if better is None or better.effect.key == old.key:
        return None
    return better, better.effect.started(scanner.amplitudes(without, better.effect))


def _stands(effect: Effect, without: Fit, beside: Fit, scanner: Scanner) -> bool:
    """Whether it is among those that explain most, whatever waves explain."""
    found = scanner.at_most(without, beside)
    if found is None:
        return False
    score, exact = found
    alike = near(np.where(scanner.complexity < FREE, score, -1.0))
    return any(exact[i] and alike[i] for i in scanner.numbers_of(effect.key))
