"""An effect is exchanged for what explains more in its place; what waves explain at most decides whether it stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from diagnosis.test_rounds import STALE, Scanned, scanned  # noqa: F401

from modcal_core.calibration.fit import FITTED, Fit, identify
from modcal_core.diagnosis.choice import better_choice, choose
from modcal_core.effects.effect import Effect
from modcal_core.effects.family import FREE


def fit_with(s: Scanned, *effects: Effect) -> Fit:
    start = s.fit.start.with_effects(effects)
    return identify(start, s.fitted, s.fit.parameters, tolerance=FITTED, begin=s.fit.values)


def backlash(s: Scanned, joint: int) -> Effect:
    found = next(e for e in s.evidence.effects if (e.family, e.place) == ("backlash", ur10().names[joint]))
    return found.started(np.array([1e-4]))


@pytest.fixture(scope="module")
def fitted(scanned: Scanned) -> Fit:  # noqa: F811
    """With all that is there."""
    return fit_with(scanned, *(backlash(scanned, joint) for joint in STALE))


@pytest.mark.parametrize("number", range(len(STALE)))
def test_scores_at_most_are_none_too_small(scanned: Scanned, fitted: Fit, number: int) -> None:  # noqa: F811
    scanner, effects = scanned.scanner, fitted.model.effects
    without = replace(fitted, model=fitted.model.with_effects(effects[:number] + effects[number + 1 :]))
    found = scanner.at_most(without, fitted)
    assert found is not None
    score, exact = found
    anew = scanner.evidence(without, plain=True).score
    plain = scanner.complexity < FREE
    waves = np.array([e.shape.kind in ("sine", "double") for e in scanner.effects])
    assert (score[plain] >= anew[plain] - 1e-6).all()
    np.testing.assert_allclose(score[exact & plain], anew[exact & plain], rtol=1e-9)
    assert not (exact & waves).any()
    assert np.median(score[waves] - anew[waves]) < 0.2  # and hardly too large


def test_what_is_there_stands(scanned: Scanned, fitted: Fit) -> None:  # noqa: F811
    assert all(better_choice(number, fitted, scanned.scanner) is None for number in range(len(STALE)))


def test_what_stands_in_for_a_cause_gives_way_to_it(scanned: Scanned) -> None:  # noqa: F811
    """With a wave of a joint in the place of another's backlash; and a choice by a scan anew is the same."""
    first, *others = STALE
    wave = next(e for e in scanned.scanner.effects if e.shape.kind == "sine")
    fit = fit_with(scanned, wave.started(np.array([1e-5, 1e-5])), *(backlash(scanned, j) for j in others))
    without = replace(fit, model=fit.model.with_effects(fit.model.effects[1:]))
    found = better_choice(0, fit, scanned.scanner)
    assert found is not None
    choice, started = found
    assert (choice.effect.family, choice.effect.place) == ("backlash", ur10().names[first])
    assert abs(started.amplitudes[0]) == pytest.approx(STALE[first], rel=0.3)
    anew = scanned.scanner.evidence(without, plain=True)
    again = choose(anew, scanned.scanner, without, set(), incumbent=fit.model.effects[0])
    assert again is not None
    assert again.effect is choice.effect


def test_beside_a_wave_nothing_is_said_of_it(scanned: Scanned) -> None:  # noqa: F811
    wave = next(e for e in scanned.scanner.effects if e.shape.kind == "sine")
    beside = replace(scanned.fit, model=scanned.fit.model.with_effects((wave.started(np.array([1e-5, 1e-5])),)))
    assert scanned.scanner.at_most(scanned.fit, beside) is None
