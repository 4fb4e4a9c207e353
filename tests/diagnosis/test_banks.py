"""Sums over samples come out as written down, whichever way a bank takes; and a scan as regressions, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from calibration.test_identify import fit_all
from cells import record, ur10

from modcal_core.calibration.fit import Fit
from modcal_core.diagnosis.banks import GatheredBank, StepBank, WaveBank
from modcal_core.diagnosis.evidence import Scanner, inverses
from modcal_core.diagnosis.spectra import KnownSums, Spectrum
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import columns, plain_columns
from modcal_core.effects.registry import candidates


@pytest.fixture(scope="module")
def fitted() -> tuple[Fit, Drivers]:
    """An arm with nothing to be found, and its samples."""
    samples = record(3, 60, "pose").samples
    fit = fit_all(ur10(), samples)
    return fit, fit.model.drivers(samples)


@pytest.mark.parametrize("count", [150, 700], ids=["by a table", "by an FFT"])
@pytest.mark.parametrize("turns", [0.1, 1.0, 40.0])
def test_a_spectrum_is_the_sum_over_the_samples(rng: np.random.Generator, turns: float, count: int) -> None:
    """Over a tenth of a turn and over forty."""
    angle, columns = 2.0 * np.pi * turns * rng.uniform(-0.5, 0.5, count), rng.normal(size=(count, 70))
    step, most = 4.0 / 27.0, 900
    phase = step * np.arange(most + 1)[:, None] * angle
    sums = Spectrum(angle, step, most).sums(columns)
    size = 1e-8 * np.abs(columns).sum(axis=0)
    assert (np.abs(sums[:, 0] - np.sin(phase) @ columns) < size).all()
    assert (np.abs(sums[:, 1] - np.cos(phase) @ columns) < size).all()


def test_sums_in_single_precision(rng: np.random.Generator) -> None:
    """On a grid that is coarser to a millionth, sums and their squares."""
    angle = rng.uniform(-4.0, 4.0, 900)
    columns = rng.normal(size=(900, 70))
    spectrum = Spectrum(angle, 0.3, 700)
    sums, lean = spectrum.sums(columns), spectrum.sums(columns.astype(np.float32))
    assert (np.abs(lean - sums) < 1e-6 * np.abs(columns).sum(axis=0)).all()
    whole, part = spectrum.squares(columns), spectrum.squares(columns.astype(np.float32))
    np.testing.assert_allclose(part.sine[1:], whole.sine[1:], rtol=5e-6)
    np.testing.assert_allclose(part.cosine, whole.cosine, rtol=5e-6)
    np.testing.assert_allclose(part.doubled, whole.doubled, atol=1e-5 * float(whole.cosine.max()))


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


def test_columns_without_terms_are_those_with(fitted: tuple[Fit, Drivers]) -> None:
    """Place, direction and sizes of each amplitude of every candidate that has no more of it."""
    _, drivers = fitted
    asked = {(e.family, e.direction, e.driver, e.shape.kind): e for e in candidates(drivers)}.values()
    found = [(e, plain) for e in asked if (plain := plain_columns(e, drivers)) is not None]
    assert {e.direction for e, _ in found} >= {"axis", "across", "all"}
    for effect, (keys, sizes) in found:
        terms = columns(effect, drivers)
        assert keys == [(t.place, t.direction) for (t,) in terms]
        np.testing.assert_array_equal(sizes, [t.size for (t,) in terms])


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


@pytest.mark.parametrize("count", [150, 700], ids=["by a table", "by an FFT"])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_squares_of_sums_are_those_of_the_sums(rng: np.random.Generator, kind: type, count: int) -> None:
    """Of a wave with itself, and of one with that of twice as many cycles, without a sum being kept."""
    angle, columns = rng.uniform(-3.0, 3.0, count), rng.normal(size=(count, 130)).astype(kind)
    spectrum = Spectrum(angle, 0.25, 301)
    parts = spectrum.sums(columns.astype(float)).transpose(1, 0, 2)  # sine, cosine
    squares = spectrum.squares(columns)
    size = (1e-9 if kind is np.float64 else 1e-5) * np.sum(parts**2, axis=(0, 2)).max()
    for found, (one, other) in (
        (squares.sine, (0, 0)),
        (squares.cosine, (1, 1)),
        (squares.both, (0, 1)),
    ):
        np.testing.assert_allclose(found, np.sum(parts[one] * parts[other], axis=1), atol=size)
    for i in range(2):
        for k in range(2):
            expected = np.sum(parts[i][:151] * parts[k][::2], axis=1)
            np.testing.assert_allclose(squares.doubled[i, k], expected, atol=size)


@pytest.mark.parametrize("count", [150, 700], ids=["by a table", "by an FFT"])
def test_products_of_waves_are_summed_with_a_weight(rng: np.random.Generator, count: int) -> None:
    """Of sine and cosine of one wave and of another, neither of them twice the other."""
    angle, weight = rng.uniform(-3.0, 3.0, count), rng.uniform(0.5, 2.0, count)
    which = np.array([[7, 14], [300, 12], [5, 5], [0, 301]])
    gram = Spectrum(angle, 0.25, 301).gram(which, weight)
    for found, waves in zip(gram, which, strict=True):
        rows = np.concatenate([[np.sin(0.25 * k * angle), np.cos(0.25 * k * angle)] for k in waves])
        np.testing.assert_allclose(found, (rows * weight) @ rows.T, atol=1e-7 * weight.sum())
