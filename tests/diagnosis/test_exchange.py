"""An effect is exchanged for what explains more in its place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from calibration.test_identify import fit_all
from cells import record, samples_of, ur10

from modcal_core.calibration.fit import FITTED, Fit, identify
from modcal_core.diagnosis.choice import better_choice, choose
from modcal_core.diagnosis.evidence import Scanner
from modcal_core.effects.effect import Effect
from modcal_core.effects.registry import candidates
from modcal_core.measurements.samples import Samples

PAN, ELBOW, WRIST_2 = 0, 2, 4
STALE = {PAN: 3e-4, ELBOW: 4e-4, WRIST_2: 3e-4}  # rad, of the side that each comes from


def backlash_in_three_joints(count: int) -> Samples:
    """Stations of an arm of which three joints have backlash."""
    made = record(8, count)
    rng = np.random.default_rng(4)
    q = made.samples.q
    came = np.sign(np.diff(q, axis=0, prepend=np.zeros((1, 6))))
    actual = q + 2e-5 * rng.standard_normal(q.shape)
    for joint, size in STALE.items():
        actual[:, joint] += size * came[:, joint]
    T = made.world.tool_in_tracker(actual)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
    return replace(samples_of(ur10(), q, T), approach=came)


@dataclass(frozen=True)
class Scanned:
    """A fit of geometry, and what candidates there are."""

    fit: Fit
    scanner: Scanner
    samples: Samples


@pytest.fixture(scope="module")
def scanned() -> Scanned:
    """An arm of which three joints have backlash."""
    samples = backlash_in_three_joints(160)
    fit = fit_all(ur10(), samples)
    drivers = fit.model.drivers(samples)
    return Scanned(fit, Scanner(list(candidates(drivers)), drivers), samples)


def fit_with(s: Scanned, *effects: Effect) -> Fit:
    start = s.fit.start.with_effects(effects)
    return identify(start, s.samples, s.fit.parameters, tolerance=FITTED, begin=s.fit.values)


def backlash(s: Scanned, joint: int) -> Effect:
    found = next(e for e in s.scanner.effects if (e.family, e.place) == ("backlash", ur10().names[joint]))
    return found.started(np.array([1e-4]))


def test_a_scan_proposes_one_of_the_causes(scanned: Scanned) -> None:
    evidence = scanned.scanner.evidence(scanned.fit, trials=True)
    assert evidence.p_value < 1e-6
    choice = choose(evidence, scanned.scanner, scanned.fit, set())
    assert choice is not None
    assert (choice.effect.family, choice.effect.place) in {("backlash", ur10().names[j]) for j in STALE}
    assert choice.p_value >= evidence.p_value


def test_what_is_there_stands(scanned: Scanned) -> None:
    fitted = fit_with(scanned, *(backlash(scanned, joint) for joint in STALE))
    assert scanned.scanner.evidence(fitted, trials=True).p_value > 0.01
    assert all(better_choice(number, fitted, scanned.scanner) is None for number in range(len(STALE)))


def test_what_stands_in_for_a_cause_gives_way_to_it(scanned: Scanned) -> None:
    """With a wave of a joint in the place of another's backlash."""
    first, *others = STALE
    wave = next(e for e in scanned.scanner.effects if e.shape.kind == "sine")
    fit = fit_with(scanned, wave.started(np.array([1e-5, 1e-5])), *(backlash(scanned, j) for j in others))
    found = better_choice(0, fit, scanned.scanner)
    assert found is not None
    choice, started = found
    assert (choice.effect.family, choice.effect.place) == ("backlash", ur10().names[first])
    assert abs(started.amplitudes[0]) == pytest.approx(STALE[first], rel=0.3)
