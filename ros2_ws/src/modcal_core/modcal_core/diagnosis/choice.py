"""Which of many candidates to believe: the best explained, and of those the plainest.

Scores closer than a hundredfold in chance do not tell candidates apart: they are one class, named together. A free
shape always fits a little better than the cause it imitates; so where a plain cause explains nearly as much, or a few
plain causes together do, the plain one is taken.

A delay of a joint is a share of commanded − measured, or a time. The scan is linear, and there both are one column.
What tells them apart is of second order, as small as a gear ratio of 1e-5, and would be called one beside the wrong
form. So the forms are fitted, and compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Fit, Model, NoiseModel
from modcal_core.diagnosis.evidence import Evidence, Scanner
from modcal_core.effects import FREE, Effect, by_hand, candidates, complexity, family_named, one_motion, put_back_first
from modcal_core.effects.families import unknown
from modcal_core.measurements import Samples, spread_rows

SIGNIFICANT = 0.002  # of noise, one scan in 500 has a best as good; what passes is judged on *explain* (sweep)
_TIE = 2.0  # in −log10 p: a hundredfold in chance, which of odds is called decisive (Jeffreys 1961)
# Share of a free shape's explanation, whose further amplitudes take some per cent of pure noise (sweep); and of the
# best explanation: what only stands elsewhere is plainer than any curve
_NEARLY = 0.9
_LOOK_AHEAD = 3  # plain causes that together may beat a free shape
_PLAINLY_MORE = 1.3  # times what the best line explains, for a whole curve, its chance taken off
_RHYTHM = 10.0  # cycles a turn that are one kind of rhythm
_MAX_NAMED = 12  # in a sentence
_MAX_RIVALS = 4  # that are fitted, for time
_NOT_LINEAR = ("velocity", "clock")  # the drivers of delays, whose second order is in the fit and not in the scan
_WORTH_NAMING = 0.2  # share of the squared residual, beyond what as many amplitudes explain by chance
_MAX_SCANNED = 500  # samples; more are thinned evenly


@dataclass(frozen=True)
class EffectChoice:
    """The chosen effect, the chance that noise would look as good, what would explain it as well, the share of the
    squared residual that it explains, and the first of its rivals as effects.
    """

    effect: Effect
    p_value: float
    same_as: tuple[str, ...]
    share: float
    rivals: tuple[Effect, ...] = ()


def choose(
    evidence: Evidence,
    scanner: Scanner,
    fit: Fit,
    refused: set[tuple[str, str, str, str]],
) -> EffectChoice | None:
    """The effect to believe, or None when all that explain anything were refused."""
    allowed = np.ones(len(evidence.effects), bool)
    for key in refused:
        allowed[scanner.numbers_of(key)] = False
    for known in fit.model.effects:  # twice the same is once, and what a second order leaves
        allowed[[i for i in scanner.numbers_of(known.key) if scanner.effects[i].shape == known.shape]] = False
    if not (allowed & (evidence.score > 0.0)).any():
        return None
    plain = allowed & (evidence.complexity < FREE)
    score = np.where(allowed, evidence.score, -1.0)
    top = int(np.argmax(score))
    if not plain[top] and plain.any():
        best_plain = int(np.argmax(np.where(plain, score, -1.0)))
        enough = _NEARLY * float(evidence.explained[top])
        if any(share >= enough for share in _explain_together(evidence, best_plain, scanner, fit, plain)):
            top = best_plain
    pool = plain if plain[top] else allowed
    alike = np.flatnonzero(pool & (score >= score[top] - _TIE * evidence.inflation)).tolist()
    best: int = min(alike, key=lambda i: (*_simplicity(evidence.effects[i]), -score[i]))
    best = _outside(evidence, _whole_curve(evidence, best, allowed), allowed)
    chosen = evidence.effects[best]
    if not family_named(chosen.family).plausible(chosen.started(scanner.amplitudes(fit, chosen))):
        return choose(evidence, scanner, fit, refused | {chosen.key})
    rivals = _rivals(evidence, best, alike)
    names = (*one_motion_names(chosen), *(effect.label for effect in rivals))
    share = float(evidence.explained[best])
    started = tuple(rival.started(scanner.amplitudes(fit, rival)) for rival in rivals[:_MAX_RIVALS])
    return EffectChoice(chosen, evidence.chance(score[top]), names[:_MAX_NAMED], share, started)


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
    same = [i for i in alike if i == best or (allowed[i] and by_hand(effects[i].place))]
    left = np.maximum(1.0 - evidence.explained[same], 1e-300)
    outside = [by_hand(effects[i].place) for i in same]
    likely = -0.5 * evidence.freedom * np.log(left) / max(evidence.inflation, 1.0)
    return same[put_back_first(same.index(best), outside, likely)]


def one_motion_names(effect: Effect) -> tuple[str, ...]:
    """The names, as in ``same_as``, of what moves against the place of an effect: no reading tells which of both."""
    return tuple(f"{place} {effect.direction} by {effect.public_driver}" for place in one_motion(effect.place))


def _explain_together(evidence: Evidence, first: int, scanner: Scanner, fit: Fit, plain: np.ndarray) -> Iterator[float]:
    """The share that one plain cause explains, two, … together, each the best of what those before it leave."""
    left, best, chosen = 1.0, first, [evidence.effects[first]]
    while True:
        left *= 1.0 - float(evidence.explained[best])
        yield 1.0 - left
        if len(chosen) == _LOOK_AHEAD:
            return
        evidence = scanner.evidence(fit, beside=chosen)
        best = int(np.argmax(np.where(plain, evidence.score, -1.0)))
        chosen.append(evidence.effects[best])


def _rivals(evidence: Evidence, best: int, alike: list[int]) -> list[Effect]:
    """What explains as much as the best, most telling first, each place and driver once."""
    chosen = evidence.effects[best]
    found: dict[tuple[str, str, str], Effect] = {(chosen.place, chosen.direction, chosen.public_driver): chosen}
    for i in sorted(alike, key=lambda i: -evidence.score[i]):
        effect = evidence.effects[i]
        found.setdefault((effect.place, effect.direction, effect.public_driver), effect)
    return list(found.values())[1:]


def other_forms(effect: Effect, candidates: Iterable[Effect]) -> tuple[Effect, ...]:
    """The candidates of the same family, place and direction by another driver, where the scan sees one of the two to
    first order only; each has as many amplitudes as the effect. Empty for an effect that has one form.
    """
    late = effect.driver in _NOT_LINEAR
    return tuple(
        other
        for other in candidates
        if (late or other.driver in _NOT_LINEAR)
        and other.driver != effect.driver
        and (other.family, other.place, other.direction) == (effect.family, effect.place, effect.direction)
        and other.shape.size == effect.shape.size
    )


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
