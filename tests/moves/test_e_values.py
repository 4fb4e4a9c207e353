"""The chance of naming something while nothing has changed, and what a change of unknown size pays for its sizes."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.measurements.samples import Samples
from modcal_core.moves.likelihood import ChangeCandidate, ChangeJudge, NullModel, RowKinds, e_value, witnesses
from modcal_core.moves.rows import BASE, NOISE, CellChange


def null(residual: np.ndarray, factors: tuple[float, ...] = (1.0,)) -> NullModel:
    """White noise of one standard deviation, times each of the factors."""
    n = len(residual)
    rows = RowKinds(np.arange(n) // 3, np.arange(n) % 3, np.ones(n), np.zeros(n))
    return NullModel(
        residual,
        tuple(f**2 * np.eye(n) for f in factors),
        np.log(np.full(len(factors), 1.0 / len(factors))),
        0,
        rows,
    )


def candidate(residual: np.ndarray, columns: np.ndarray) -> ChangeCandidate:
    return ChangeCandidate(CellChange(BASE, "base"), residual, columns)


def test_of_noise_alone_the_e_value_exceeds_a_hundred_less_often_than_once_in_a_hundred() -> None:
    rng = np.random.default_rng(1)
    directions = [rng.standard_normal((30, k)) for k in (1, 1, 1, 1, 6, 6)]
    above = 0
    for _ in range(400):
        r = rng.standard_normal(30)
        judge = ChangeJudge(null(r))
        judged = [judge.judged(candidate(r, A)) for A in directions] + [judge.noisier(CellChange(NOISE, "tracker"))]
        above += e_value(judged, np.log(np.full(7, 1.0 / 7.0))) > np.log(100.0)
    assert above <= 4  # a hundredth of 400 is the bound; it is not reached


def test_a_change_of_more_sizes_pays_for_them() -> None:
    rng = np.random.default_rng(2)
    A = rng.standard_normal((30, 6))
    r = 1.5 * A[:, 0] + rng.standard_normal(30)
    judge = ChangeJudge(null(r))
    one, six = judge.judged(candidate(r, A[:, :1])), judge.judged(candidate(r, A))
    assert one.log_factor > six.log_factor + 3.0  # and not the other way, though six explain more
    assert six.likelihood > one.likelihood


def test_units_and_scales_of_columns_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    A = rng.standard_normal((30, 6))
    r = A @ rng.standard_normal(6)
    judge = ChangeJudge(null(r, (0.8, 1.0, 1.3)))
    mixed = A @ rng.standard_normal((6, 6)) @ np.diag([1e-6, 1e3, 1.0, 1.0, 5.0, 1e-2])
    assert abs(judge.judged(candidate(r, A)).log_factor - judge.judged(candidate(r, mixed)).log_factor) < 1e-6


def test_stations_at_one_posture_are_one_witness() -> None:
    rng = np.random.default_rng(5)
    far = 10.0 * np.arange(8.0)[:, None] * np.ones(6)

    def at(q: np.ndarray) -> Samples:
        return Samples.from_arrays(q, points=np.zeros((len(q), 3)))

    assert witnesses(at(far)) == pytest.approx(8.0)
    assert witnesses(at(far[[2] * 8] + 1e-3 * rng.standard_normal((8, 6)))) == pytest.approx(1.0, abs=1e-3)
    assert witnesses(at(far[[1, 1, 1, 1, 5, 5, 5, 5]])) == pytest.approx(2.0)
