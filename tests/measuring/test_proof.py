"""The proof: never more often wrong than it says, however often one looks."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.measuring.proof import MIN_STATIONS, Goal, Proof, axes_of, share

GOAL = 1e-4  # m
RUNS, LOOKS = 600, 60


def drawn(rng: np.random.Generator, axes: tuple[float, ...], rms: float) -> np.ndarray:
    """Lengths (RUNS, LOOKS) of normal errors with these relative sizes along three axes, and this RMS."""
    scale = np.array(axes) / np.sqrt(np.sum(np.square(axes)))
    return rms * np.linalg.norm(scale * rng.standard_normal((RUNS, LOOKS, len(axes))), axis=2)


@pytest.mark.parametrize("axes", [(1.0,), (1.0, 1.0), (1.0, 1.0, 1.0), (1.0, 0.3, 0.1)])
def test_an_error_as_large_as_the_goal_is_proven_no_more_often_than_alpha(
    axes: tuple[float, ...], rng: np.random.Generator
) -> None:
    """Looked at after every station, up to sixty; the directions as the law has them."""
    nu = min(len(axes), 2) if axes != (1.0, 0.3, 0.1) else 1.0
    wrong = 0
    for e in drawn(rng, axes, GOAL):
        wrong += any(Proof(e[:n], 0.5 * GOAL, 0.05, nu).holds(GOAL) for n in range(MIN_STATIONS, LOOKS, 3))
    # 5 % and three standard deviations of counting
    assert wrong <= 0.05 * RUNS + 3.0 * np.sqrt(0.05 * 0.95 * RUNS)


def test_a_small_error_is_proven_with_about_as_many_stations_as_foretold(rng: np.random.Generator) -> None:
    took = []
    for e in drawn(rng, (1.0,), 0.5 * GOAL)[:300]:
        took.append(next(n for n in range(1, LOOKS) if Proof(e[:n], 0.5 * GOAL, 0.05).holds(GOAL)))
    foretold = Proof(np.zeros(0), 0.5 * GOAL, 0.05).more(GOAL, 0.5 * GOAL)
    assert np.mean(took) == pytest.approx(foretold, rel=0.35)


def test_the_bound_is_where_the_evidence_is_just_enough(rng: np.random.Generator) -> None:
    proof = Proof(np.abs(rng.normal(0.0, 4e-5, 12)), 5e-5, 0.05)
    assert proof.bound is not None
    assert proof.evidence(proof.bound) == pytest.approx(-np.log(0.05), rel=1e-6)
    assert proof.holds(1.001 * proof.bound)
    assert not proof.holds(0.999 * proof.bound)


def test_few_stations_prove_nothing_however_good() -> None:
    assert not Proof(np.full(MIN_STATIONS - 1, 1e-9), 1e-6, 0.05).holds(GOAL)
    assert Proof(np.full(MIN_STATIONS, 1e-9), 1e-6, 0.05).holds(GOAL)


def test_the_shares_of_all_models_add_up_to_alpha() -> None:
    some = sum(share(0.05, k) for k in range(200))
    assert some < 0.05
    assert some + 0.05 / 3.0 / 200 == pytest.approx(0.05)  # 1/k(k + 1) from 200 on add up to 1/200


def test_a_goal_no_better_than_what_is_expected_takes_for_ever() -> None:
    assert Proof(np.zeros(0), GOAL, 0.05).more(GOAL, GOAL) == np.inf


def test_directions_are_told_from_squares(rng: np.random.Generator) -> None:
    assert axes_of(rng.standard_normal(4000) ** 2) == pytest.approx(1.0, abs=0.15)
    assert axes_of(np.ones(10)) == 2.0  # no more is ever believed


def test_the_instruments_own_error_is_no_error_of_the_tool() -> None:
    goal = Goal(1e-4, instrument=5e-5)
    assert goal.rms == pytest.approx(np.hypot(1e-4, 5e-5))
    assert goal.of_tool(goal.rms or 0.0) == pytest.approx(1e-4)
    assert Goal(1.96e-4, "p95").rms == pytest.approx(1e-4)
