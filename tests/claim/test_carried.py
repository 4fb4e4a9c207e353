"""What a frozen calibration takes to other readings, what a covariance holds, and what is said to show the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record
from claim.test_claim import calibrated, missed, postures, touches

from modcal_core.calibration.cell import Cell
from modcal_core.claim.claim import Claim, claim_at_tool
from modcal_core.claim.neighbourhood import arms_near
from modcal_core.claim.remedy import open_direction
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.evaluation import evaluate
from modcal_core.geometry.so3 import Array
from modcal_core.verdict.tolerance import Asked


def p95(claim: Claim | None) -> float:
    assert claim is not None
    return claim.mm["p95"].ci95[1]


@pytest.mark.slow
def test_ten_stations_claim_what_the_calibration_knows_and_no_more() -> None:
    covered, wider = 0, []
    for seed in range(8):
        cell = record(seed, 70, "point")
        found = calibrated(cell.samples.select(np.arange(60)))
        late = cell.samples.select(np.arange(60, 70))
        q = postures(cell.samples)
        known = claim_at_tool(found.calibration, late, Cell(), q, frozen="whole")
        alone = claim_at_tool(replace(found.calibration, uncertainty=None), late, Cell(), q, frozen="whole")
        true = float(np.percentile(missed(found, cell, q), 95))
        covered += true <= p95(known)
        wider.append(p95(known) / true)
        assert p95(known) < p95(alone)
    assert covered >= 7
    assert np.median(wider) < 2.6  # base and tool are where they were, as far as ten points tell


def test_a_moved_tracker_counts_unless_it_is_fitted_again() -> None:
    cell = record(4, 90, "pose")
    calibration = calibrated(cell.samples.select(np.arange(60))).calibration
    late = cell.samples.select(np.arange(60, 90))
    moved = replace(late, reading=late.reading + [5e-4, 0.0, 0.0])
    rng = np.random.default_rng(0)
    asked = Asked(0.3)

    def result(refit_base: bool) -> tuple[str, float]:
        report = evaluate(calibration, moved, rng, refit_base=refit_base).with_tolerance(asked)
        assert report.tolerance is not None
        return report.tolerance.result, p95(report.claim)

    assert result(False)[0] == "FAIL"
    assert result(False)[1] > 0.5
    assert result(True)[0] == "PASS"


def test_noise_of_a_coarse_instrument_is_no_move() -> None:
    cell = record(6, 90, "point")
    q = postures(cell.samples)
    coarse = replace(
        cell.samples, reading=cell.samples.reading + 3e-4 * np.random.default_rng(0).standard_normal((90, 3))
    )
    found = calibrated(coarse.select(np.arange(60)))
    claim = claim_at_tool(found.calibration, coarse.select(np.arange(60, 90)), Cell(), q, frozen="whole")
    true = float(np.percentile(missed(found, cell, q), 95))
    low, high = claim.mm["p95"].ci95
    assert low < true < high < 1.5 * p95(found.report.claim)


@pytest.mark.slow
def test_contacts_leave_the_scale_open_for_evaluate_and_the_corrector_too() -> None:
    every = touches(1, 60, np.eye(3)[[2, 0]])[1]
    samples, late = every.select(np.flatnonzero(every.station % 6)), every.select(np.arange(0, 120, 6))
    found = calibrated(samples)
    claim = found.report.claim
    assert claim is not None
    assert claim.is_open
    assert claim.open.what == "the scale"
    assert claim.open.remedy.startswith("One known distance shows it")
    table = {name: (value, std) for name, value, std, _ in found.calibration.parameters}
    about = arms_near(found.calibration.calibrated, found.calibration.nominal.chain, samples, Cell(), functions=False)
    own = [(p.name, x) for p, x in zip(about.parameters, about.shipped, strict=False) if p.of_arm]
    assert own
    assert all(abs(table[name][0] - x) < 1e-7 for name, x in own)  # the table is of the model that is shipped
    assert max(std for name, (_, std) in table.items() if name.endswith("/x")) > 1e-4
    frozen = evaluate(found.calibration, late, np.random.default_rng(0)).with_tolerance(Asked(0.2))
    assert frozen.tolerance is not None
    assert frozen.tolerance.result != "PASS"
    corrector = Correction(found.calibration)
    q = postures(samples, 40)
    at = ArmState.at_rest(q[0], 0.0)
    spread = [np.trace(corrector.covariance(row, at)[:3, :3]) for row in q]
    # one deviation of what is claimed: a 95 % quantile is above 1.5 of them
    assert claim.unshown_mm / 5.0 < 1e3 * np.sqrt(np.mean(spread)) < claim.unshown_mm


def test_what_is_advised_shows_what_is_open(rng: np.random.Generator) -> None:
    """Growth of the arm is shown by a distance; errors across it by positions alone; few stations by more of them."""
    p = rng.uniform(-0.8, 0.8, (3, 100))
    out = (p - p.mean(axis=1, keepdims=True)).ravel()
    sizes = rng.normal(0.0, 1e-3, (300, 1))
    grown = sizes * out
    assert open_direction(grown, p, False).what == "the scale"
    assert "distance" in open_direction(grown, p, False).remedy
    across: Array = rng.normal(0.0, 1e-3, (300, 300))
    assert open_direction(across, p, False).what != "the scale"
    assert "position" in open_direction(across, p, False).remedy
    assert "stations" in open_direction(across, p, True).remedy
