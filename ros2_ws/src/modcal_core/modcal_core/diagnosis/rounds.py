"""Effects that one scan shows together: the best, and what explains much of what that leaves, at other places.

Each is significant in the scan, and beside those before it explains many times what it must, without a fit; else the
round ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from modcal_core.calibration import Fit, Model, Uncertainty, without
from modcal_core.diagnosis.choice import SIGNIFICANT, EffectChoice, choose, other_forms
from modcal_core.diagnosis.evidence import Evidence, Scanner
from modcal_core.diagnosis.pruning import MIN_GAIN
from modcal_core.effects import Effect, is_large_move, is_turned

_MANY = 10.0  # times what an effect must gain, which it explains: such a one is hardly ever refused once it is fitted
_SURELY = 2.0  # times what an effect must gain, where that is judged by the curvature of a fit with others


@dataclass(frozen=True)
class StartedChoice:
    """A choice, and its effect with the amplitudes to begin from beside those chosen before it."""

    choice: EffectChoice
    started: Effect


def chosen_together(
    first: EffectChoice,
    evidence: Evidence,
    scanner: Scanner,
    fit: Fit,
    refused: set[tuple[str, str, str, str]],
    most: int,
) -> tuple[StartedChoice, ...]:
    """The first choice of a scan and those that follow it, each beside those before it, at another place than they.

    evidence: of that scan, the last that was made. most: how many. A choice of which a fit alone knows what it leaves
    stands alone: a wave whose cycles are fitted, one of several forms, a large move.
    """
    found: list[StartedChoice] = []
    choice: EffectChoice | None = first
    before, apart = 0.0, set(refused)
    while choice is not None and choice.p_value <= SIGNIFICANT:
        amplitudes, share = scanner.together(fit, [*(one.choice.effect for one in found), choice.effect])
        started = choice.effect.started(amplitudes)
        if share - before < _MANY * MIN_GAIN or _stands_alone(started, scanner.effects):
            break
        found.append(StartedChoice(choice, started))
        if len(found) == most:
            break
        before = share
        apart |= {effect.key for effect in scanner.effects if effect.place == started.place}
        choice = choose(evidence, scanner, fit, apart)
    return tuple(found)


def surely_worth(
    model: Model, known: Uncertainty, first: int, missed: float, missed_by: Callable[[Model], float]
) -> list[int]:
    """Which effects of a model, counted from the first of its new ones, are surely worth having beside those before
    them.

    known: covariance of the model's fit, by which others are taken out. missed: what *explain* is missed by without the
    new ones. missed_by: the same of a model.
    """
    found: list[int] = []
    count = len(model.effects) - first
    for i in range(count):
        gone = [first + j for j in range(count) if j not in (*found, i)]
        now = missed_by(without(model, known, gone))
        if now < (1.0 - _SURELY * MIN_GAIN) * missed:
            found.append(i)
            missed = now
    return found


def _stands_alone(effect: Effect, candidates: Sequence[Effect]) -> bool:
    """Whether what an effect leaves is known by its fit alone."""
    bent = is_large_move(effect) or is_turned(effect) or bool(effect.refined)
    return bent or bool(other_forms(effect, candidates))
