"""Sums over samples come out as written down, whichever way a bank takes; and a scan as regressions, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from calibration.test_identify import fit_all
from cells import record, ur10

from modcal_core.calibration.fit import Fit
from modcal_core.diagnosis.banks import GatheredBank, StepBank, WaveBank
from modcal_core.diagnosis.evidence import Scanner, inverses
from modcal_core.diagnosis.spectra import KnownSums
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.registry import candidates


@pytest.fixture(scope="module")
def fitted() -> tuple[Fit, Drivers]:
    """An arm with nothing to be found, and its samples."""
    samples = record(3, 60, "pose").samples
    fit = fit_all(ur10(), samples)
    return fit, fit.model.drivers(samples)


@pytest.mark.parametrize("m", [1, 2, 3, 4, 6, 9])
def test_inverses_are_those_of_new_directions(rng: np.random.Generator, m: int) -> None:
    """Of candidates of any width the inverse of what is new, by singular values; also where some or all is not."""
    columns = rng.normal(size=(40, m, 30))
    columns[::3, -1] = columns[::3, 0] + 1e-9 * columns[::3, -1]  # of one column alone: all of it, scaled down below
    own = np.einsum("cik,cik->ci", columns, columns)
    if m == 1:
        columns[::3] *= 1e-3
    found, sizes = inverses(columns @ columns.transpose(0, 2, 1), own)
    for one, size, square, inverse in zip(columns, sizes, own, found, strict=True):
        scale = np.sqrt(square)
        vector, value, _ = np.linalg.svd(one / scale[:, None])
        new = value[:m] ** 2 > 0.0025
        expected = (vector[:, new] / value[:m][new] ** 2) @ vector[:, new].T / np.outer(scale, scale)
        assert size == new.sum()
        np.testing.assert_allclose(inverse, expected, rtol=1e-7, atol=1e-9 * float(np.abs(expected).max()))


def test_each_bank_sums_as_its_numbers_do(fitted: tuple[Fit, Drivers], rng: np.random.Generator) -> None:
    """Every kind of bank of a real scan, beside the numbers of its candidates one by one."""
    _, drivers = fitted
    scanner = Scanner(list(candidates(drivers)), drivers)
    assert {type(bank) for bank in scanner.banks} == {GatheredBank, WaveBank, StepBank}
    assert len(scanner.effects) == len(list(candidates(drivers)))
    for bank in scanner.banks:
        unit = {key: rng.normal(size=(6, len(drivers))) for key in bank.keys}
        asked = {key: rng.normal(size=(len(drivers), 3)) for key in scanner._keys}  # numbers of all keys are one pool
        sums = bank.sums(asked, KnownSums())
        squares = bank.gram_of_sums(asked, KnownSums())
        gram = bank.gram(unit)
        assert sums.shape[:2] == (len(bank.effects), bank.width)
        some = rng.choice(len(bank.effects), min(len(bank.effects), 12), replace=False)
        for i in {0, len(bank.effects) - 1, *some.tolist()}:
            keys, numbers = scanner._factor(bank.effects[i])
            assert set(keys) <= set(bank.keys)
            columns = np.stack([numbers[a] * unit[key] for a, key in enumerate(keys)])
            expected = np.stack([numbers[a] @ asked[key] for a, key in enumerate(keys)])
            size = np.abs(numbers).sum()
            np.testing.assert_allclose(sums[i], expected, atol=1e-7 * size)
            np.testing.assert_allclose(squares[i], expected @ expected.T, atol=1e-6 * size**2)
            np.testing.assert_allclose(gram[i], np.einsum("acN,bcN->ab", columns, columns), atol=1e-6 * size)


def test_a_scan_explains_what_regressions_do(fitted: tuple[Fit, Drivers]) -> None:
    """The share of the residual's squares, the fitted projected out of both, by least squares of one candidate."""
    fit, drivers = fitted
    scanner = Scanner(list(candidates(drivers)), drivers)
    evidence = scanner.evidence(fit)
    space = scanner.space_of(fit)
    Q, r = space.Q.reshape(-1, space.Q.shape[2]), space.residual.ravel()
    total = r @ r - np.sum((Q.T @ r) ** 2)
    for i in range(0, len(evidence.effects), len(evidence.effects) // 60):
        keys, numbers = scanner._factor(evidence.effects[i])
        U = np.stack([(numbers[a] * scanner._column(key, space)).ravel() for a, key in enumerate(keys)], axis=1)
        gram, seen = U.T @ U - (U.T @ Q) @ (U.T @ Q).T, U.T @ r - (U.T @ Q) @ (Q.T @ r)
        scale = np.sqrt(np.einsum("ij,ij->j", U, U))
        value, vector = np.linalg.eigh(gram / np.outer(scale, scale))
        new = value > 0.0025
        explained = np.sum((vector[:, new].T @ (seen / scale)) ** 2 / value[new])
        assert evidence.explained[i] == pytest.approx(explained / total, abs=1e-7)
