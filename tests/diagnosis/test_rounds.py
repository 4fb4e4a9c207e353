"""Effects that one scan shows together are those that are there, and each has to be worth having by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from calibration.test_identify import fit_all
from cells import ur10
from diagnosis.test_exchange import STALE, backlash_in_three_joints

from modcal_core.calibration.covariance import uncertainty
from modcal_core.calibration.fit import FITTED, Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import errors, squared_residuals
from modcal_core.diagnosis.choice import EffectChoice, choose
from modcal_core.diagnosis.evidence import Evidence, Scanner
from modcal_core.diagnosis.rounds import chosen_together, surely_worth
from modcal_core.effects.registry import candidates
from modcal_core.measurements.samples import Samples


@dataclass(frozen=True)
class Scanned:
    """A fit of geometry, what its scan shows, and stations that were not fitted."""

    fit: Fit
    scanner: Scanner
    evidence: Evidence
    first: EffectChoice
    fitted: Samples
    others: Samples


@pytest.fixture(scope="module")
def scanned() -> Scanned:
    """An arm of which three joints have backlash."""
    samples = backlash_in_three_joints(240)
    fitted, others = samples.select(slice(None, 160)), samples.select(slice(160, None))
    fit = fit_all(ur10(), fitted)
    drivers = fit.model.drivers(fitted)
    scanner = Scanner(list(candidates(drivers)), drivers)
    evidence = scanner.evidence(fit, trials=True)
    first = choose(evidence, scanner, fit, set())
    assert first is not None
    return Scanned(fit, scanner, evidence, first, fitted, others)


def test_one_scan_shows_all_that_are_there(scanned: Scanned) -> None:
    s = scanned
    chosen = chosen_together(s.first, s.evidence, s.scanner, s.fit, set(), 30)
    names = ur10().names
    assert {(c.started.family, c.started.place) for c in chosen} == {("backlash", names[j]) for j in STALE}
    for one in chosen:  # with what each is, beside the others
        size = STALE[names.index(one.started.place)]
        np.testing.assert_allclose(np.abs(one.started.amplitudes), size, rtol=0.3)
    assert len(chosen_together(s.first, s.evidence, s.scanner, s.fit, set(), 2)) == 2


def test_what_is_not_there_is_not_worth_having(scanned: Scanned) -> None:
    """Of effects that are fitted together those that predict are told from one that does not."""
    s = scanned
    chosen = [c.started for c in chosen_together(s.first, s.evidence, s.scanner, s.fit, set(), 30)]
    absent = next(e for e in s.evidence.effects if (e.family, e.place) == ("backlash", ur10().names[5]))
    new = (*chosen[:1], absent.started(np.array([1e-4])), *chosen[1:])
    start = s.fit.start.with_effects(new)
    fit = identify(start, s.fitted, s.fit.parameters, tolerance=FITTED, begin=s.fit.values)

    def missed_by(model: Model) -> float:
        return float(np.mean(squared_residuals(errors(model, s.others), s.others, s.fit.noise)))

    known = uncertainty(fit.model, s.fitted, fit.parameters, fit)
    worth = surely_worth(fit.model, known, 0, missed_by(s.fit.model), missed_by)
    assert [i for i, _ in worth] == [0, *range(2, len(new))]
    assert [len(model.effects) for _, model in worth] == list(range(1, len(new)))
    alone = identify(s.fit.start.with_effects(chosen[:1]), s.fitted, s.fit.parameters, tolerance=FITTED)
    assert missed_by(worth[0][1]) == pytest.approx(missed_by(alone.model), rel=0.05)


def test_what_moves_all_ways_is_begun_in_all_ways(scanned: Scanned) -> None:
    s = scanned
    drift = next(e for e in s.scanner.effects if (e.family, e.direction) == ("drift", "all"))
    assert len(s.scanner.amplitudes(s.fit, drift)) == 6
    beside, share = s.scanner.together(s.fit, (s.first.effect, drift))
    alone = s.scanner.together(s.fit, (s.first.effect,))[1]
    assert beside.shape == (6,)
    assert share > alone
