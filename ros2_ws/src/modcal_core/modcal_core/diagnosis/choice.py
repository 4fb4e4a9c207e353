"""Which of many candidates to believe: the best explained, and of those the plainest.

Scores closer than a hundredfold in chance do not tell candidates apart: they are one class, named together. A free
shape always fits a little better than the cause it imitates; so where a plain cause explains nearly as much, or a few
plain causes together do, the plain one is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Fit
from modcal_core.diagnosis.evidence import Evidence, Scanner
from modcal_core.effects import BY_HAND, FREE, Effect, complexity, family_named, one_motion, put_back_first
from modcal_core.geometry import Array

_TIE = 2.0  # in −log10 p: a hundredfold in chance, which of odds is called decisive (Jeffreys 1961)
_NEARLY = 0.93  # share of a free shape's explanation; its further amplitudes take some per cent of pure noise (sweep)
_LOOK_AHEAD = 3  # plain causes that together may beat a free shape
_PLAINLY_MORE = 1.3  # times what the best line explains, for a whole curve, its chance taken off
_RHYTHM = 10.0  # cycles a turn that are one kind of rhythm
_MAX_NAMED = 12  # in a sentence
_MAX_RIVALS = 4  # that are fitted, for time


@dataclass(frozen=True)
class EffectChoice:
    """The chosen effect, the chance that noise would look as good, what would explain it as well, the share of the
    squared residual that it explains, and the first of its rivals as effects. flips: trials that the chance comes from.
    """

    effect: Effect
    p_value: float
    same_as: tuple[str, ...]
    share: float
    rivals: tuple[Effect, ...] = ()
    flips: int = 0


def choose(
    evidence: Evidence,
    scanner: Scanner,
    fit: Fit,
    refused: set[tuple[str, str, str, str]],
    incumbent: Effect | None = None,
) -> EffectChoice | None:
    """The effect to believe, or None when all that explain anything were refused.

    incumbent: an effect that stands already, which another must beat by more than a tie.
    """
    allowed = np.ones(len(evidence.effects), bool)
    for key in refused:
        allowed[scanner.numbers_of(key)] = False
    if not (allowed & (evidence.score > 0.0)).any():
        return None
    plain = allowed & (evidence.complexity < FREE)
    if incumbent is not None and complexity(incumbent) < FREE and plain.any():
        allowed = plain  # a plain cause is not given up for a free shape
    score = np.where(allowed, evidence.score, -1.0)
    top = int(np.argmax(score))
    if not plain[top] and plain.any():
        best_plain = int(np.argmax(np.where(plain, score, -1.0)))
        if _explain_together(evidence, best_plain, scanner, fit, plain, _NEARLY * float(evidence.explained[top])):
            top = best_plain
    pool = plain if plain[top] else allowed
    alike = np.flatnonzero(pool & near(score, top, evidence.inflation)).tolist()
    if incumbent is not None and any(evidence.effects[i].key == incumbent.key for i in alike):
        return None
    best: int = min(alike, key=lambda i: (*_simplicity(evidence.effects[i]), -score[i]))
    best = _outside(evidence, _whole_curve(evidence, best, allowed), allowed)
    chosen = evidence.effects[best]
    if not family_named(chosen.family).plausible(chosen.started(scanner.amplitudes(fit, chosen))):
        return choose(evidence, scanner, fit, refused | {chosen.key}, incumbent)
    rivals = _rivals(evidence, best, alike)
    names = (*one_motion_names(chosen), *(effect.label for effect in rivals))
    share = float(evidence.explained[best])
    started = tuple(rival.started(scanner.amplitudes(fit, rival)) for rival in rivals[:_MAX_RIVALS])
    return EffectChoice(chosen, evidence.p_value, names[:_MAX_NAMED], share, started, evidence.flips)


def near(score: Array, top: int | None = None, inflation: float = 1.0) -> np.ndarray:
    """Which of scores (C,) are no more than a tie below one of them, by default the best. inflation: of scores."""
    best = float(score.max(initial=0.0)) if top is None else float(score[top])
    return np.asarray(score >= best - _TIE * inflation)


def _simplicity(effect: Effect) -> tuple[float, ...]:
    """Less is plainer: the kind of cause, its amplitudes, and whether it asks for many cycles where few would do."""
    cycles = effect.shape.settings.get("cycles", 0.0)
    return complexity(effect), effect.shape.size, round(cycles / _RHYTHM)


def _whole_curve(evidence: Evidence, best: int, allowed: np.ndarray) -> int:
    """A family's whole curve over the same driver, where that explains plainly more than the best single line."""
    line = evidence.effects[best]
    if line.shape.is_free:
        return best
    enough = _PLAINLY_MORE * evidence.explained[best]
    for i in np.flatnonzero(allowed & (evidence.explained > enough)).tolist():
        effect = evidence.effects[i]
        if effect.shape.kind == "spline" and effect.key == line.key:
            by_chance = effect.shape.size / evidence.freedom
            if evidence.explained[i] - by_chance > enough:
                return int(i)
    return best


def _outside(evidence: Evidence, best: int, allowed: np.ndarray) -> int:
    """What outside the arm went the same way at the same time and explains as much, else the best itself."""
    effects, chosen = evidence.effects, evidence.effects[best]
    alike = [i for i, e in enumerate(effects) if (e.driver, e.shape) == (chosen.driver, chosen.shape)]
    same = [i for i in alike if i == best or (allowed[i] and effects[i].place in BY_HAND)]
    left = np.maximum(1.0 - evidence.explained[same], 1e-300)
    outside = [effects[i].place in BY_HAND for i in same]
    likely = -0.5 * evidence.freedom * np.log(left) / max(evidence.inflation, 1.0)
    return same[put_back_first(same.index(best), outside, likely)]


def one_motion_names(effect: Effect) -> tuple[str, ...]:
    """The names, as in ``same_as``, of what moves against the place of an effect: no reading tells which of both."""
    return tuple(f"{place} {effect.direction} by {effect.public_driver}" for place in one_motion(effect.place))


def _explain_together(
    evidence: Evidence, first: int, scanner: Scanner, fit: Fit, plain: np.ndarray, enough: float
) -> bool:
    """Whether a few plain causes, taken one after the other, explain as large a share."""
    left, chosen = 1.0, evidence.effects[first]
    for more in reversed(range(_LOOK_AHEAD)):
        amplitudes, share = scanner.alone(fit, chosen)
        left *= 1.0 - share
        if 1.0 - left >= enough or not more:
            break
        fit = replace(fit, model=fit.model.with_effects((*fit.model.effects, chosen.started(amplitudes))))
        now = scanner.beyond(fit, evidence, plain=True)
        chosen = evidence.effects[int(np.argmax(np.where(plain, now.score, -1.0)))]
    return 1.0 - left >= enough


def _rivals(evidence: Evidence, best: int, alike: list[int]) -> list[Effect]:
    """What explains as much as the best, most telling first, each place and driver once."""
    chosen = evidence.effects[best]
    found: dict[tuple[str, str, str], Effect] = {(chosen.place, chosen.direction, chosen.public_driver): chosen}
    for i in sorted(alike, key=lambda i: -evidence.score[i]):
        effect = evidence.effects[i]
        found.setdefault((effect.place, effect.direction, effect.public_driver), effect)
    return list(found.values())[1:]
