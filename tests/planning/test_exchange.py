"""Rows against the calibration's normal equations, criteria against singular values, exchange against all that there is."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pytest
from cells import samples_of, ur10
from planning.sites import ground, hall

from modcal_core.calibration.equations import normal_equations
from modcal_core.geometry.so3 import Array
from modcal_core.planning.exchange import CRITERIA, Criterion, Search, exchange, grown, information, observability


def small(rng: np.random.Generator, N: int = 12, c: int = 3, P: int = 5) -> Array:
    return np.asarray(4.0 * rng.standard_normal((N, c, P)))


def of(rows: Array, chosen: Sequence[int] | np.ndarray) -> Array:
    """JᵀJ of these stations, summed one by one."""
    return np.asarray(sum(rows[k].T @ rows[k] for k in chosen))


@pytest.mark.parametrize("reading", ["point", "pose"])
def test_information_is_that_of_the_normal_equations(reading: str) -> None:
    """With the weights that a fit has: a reading's own variance, and one spread for all."""
    there, noise = ground(reading).outlook, hall().noise
    q = ground(reading).pool.q[:25]
    model, parameters = there.about.model, there.about.parameters
    samples = samples_of(ur10(), q, model.predict(q), reading)
    distance = np.linalg.norm(samples.reading, axis=1)
    position = 1.0 / ((noise.position + noise.per_metre * distance) ** 2 + there.scatter[0] ** 2)
    weight = np.tile(position, 3)
    if reading == "pose":
        weight = np.r_[weight, np.full(75, 1.0 / (noise.rotation**2 + there.scatter[3] ** 2))]
    H, _ = normal_equations(model, parameters, np.zeros(len(parameters)), samples, weight)
    P = len(parameters)
    ours = information(there.rows(q))[:P, :P] / np.outer(there.about.std[:P], there.about.std[:P])
    assert np.allclose(ours, H, rtol=1e-9, atol=1e-9 * np.abs(H).max())


def test_what_accuracy_counts_is_what_the_claim_draws() -> None:
    """The RMS of the tool's errors that the claim draws, its noise known, is that of the information."""
    planner = ground()
    q = planner.pool.q[:60]
    expected = 1e3 * planner.outlook.beside(planner.outlook.rows(q)).error()
    claimed = planner.claim(q).mm["rms"]
    assert claimed.ci95[0] < expected < claimed.ci95[1]


def test_indices_are_those_of_the_singular_values() -> None:
    rows = small(np.random.default_rng(3))
    s = np.linalg.svd(rows[:7].reshape(21, 5), compute_uv=False)
    found = observability(of(rows, np.arange(7)), 7)
    assert found.o1 == pytest.approx(np.prod(s) ** (1 / 5) / np.sqrt(7))
    assert found.o2 == pytest.approx(s[-1] / s[0])
    assert found.o3 == pytest.approx(s[-1])
    assert found.o4 == pytest.approx(s[-1] ** 2 / s[0])
    assert found.o5 == pytest.approx(1.0 / np.sum(1.0 / s))
    assert found.rank == 5
    short = observability(of(rows, [0]), 1)
    assert (short.o1, short.rank) == (0.0, 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CRITERIA)
def test_of_few_candidates_the_best_set_of_all_is_found(name: str) -> None:
    rng = np.random.default_rng(5)
    for _ in range(4):
        rows = small(rng, N=11)
        good = Criterion(name, of(rows, range(11)) / 11.0)
        best = max(float(good.value(np.eye(5) + of(rows, np.array(s)))) for s in combinations(range(11), 5))
        found = exchange(Search.of(rows, good, np.eye(5)), 5, rng, starts=40)
        assert float(good.value(np.eye(5) + of(rows, found))) == pytest.approx(best, rel=1e-9)
        assert len(set(found.tolist())) == 5


@pytest.mark.parametrize("name", ["accuracy", "d"])
@pytest.mark.parametrize("c", [3, 6])
def test_what_candidates_are_worth_is_kept_up_as_stations_come_and_go(name: str, c: int) -> None:
    """Against the criterion itself, of every candidate, after many changes."""
    rng = np.random.default_rng(6)
    rows = small(rng, N=30, c=c, P=9)
    good = Criterion(name, of(rows, [0, 1, 2]) / 3.0)
    chosen = list(range(10))
    base = np.eye(9)
    search = Search.of(rows, good, base + of(rows, chosen))
    for _ in range(60):
        gone, come = chosen.pop(0), int(rng.integers(30))
        chosen.append(come)
        search = search.changed(gone, -1.0).changed(come, 1.0)
    H = base + of(rows, chosen)
    each = good.value(H + rows.transpose(0, 2, 1) @ rows)
    assert np.allclose(search.gains(np.ones(30, bool)), each - good.value(H), rtol=1e-9, atol=1e-12)


def test_what_is_not_likely_to_be_read_counts_by_its_chance() -> None:
    """Of two stations that tell the same the likelier one is taken, and none that cannot be read."""
    rows = small(np.random.default_rng(8), N=6)
    rows[1] = rows[0]
    base = Search.of(rows, Criterion("d", np.eye(5)), np.eye(5))
    chance = np.array([0.5, 0.9, 0.0, 1e-9, 1e-9, 1e-9])
    assert grown(base, 6, chance)[0] == 1
    assert sorted(grown(base, 6, chance)) == [0, 1, 3, 4, 5]
