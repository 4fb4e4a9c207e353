"""What is no one joint is said to be none; what is certain predicts; rests and outliers do not outvote the motion."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy
from scipy.spatial.transform import Rotation

from modcal_core.articulation.choice import choose
from modcal_core.articulation.phases import best_cut
from modcal_core.articulation.telling import lone, telling
from modcal_core.articulation.track import Track

DEGREE = np.pi / 180.0


def track_of(seen: Seen, oriented: bool) -> Track:
    return Track(seen.positions, seen.rotations if oriented else None)


def slid_then_turned(rng: np.random.Generator, oriented: bool) -> Track:
    """A front that slides 12 cm and then turns by 60° about an axis 30 cm away."""
    b = np.linspace(0.0, 60.0 * DEGREE, 80)
    arc = 0.3 * np.stack([1.0 - np.cos(b), np.sin(b), 0.0 * b], axis=1)
    p = np.concatenate([np.outer(np.linspace(-0.12, 0.0, 40), [1.0, 0.0, 0.0]), arc])
    turns = Rotation.from_rotvec(np.outer(np.concatenate([np.zeros(40), -b]), [0.0, 0.0, 1.0]))
    jitter = Rotation.from_rotvec(rng.normal(0.0, 0.2 * DEGREE, (120, 3)))
    world = Rotation.random(rng=rng)
    p = world.apply(p) + rng.normal(0.0, 5e-4, (120, 3))
    return Track(p, (world * turns * jitter).as_matrix() if oriented else None)


@pytest.mark.slow
@pytest.mark.parametrize("oriented", [True, False])
def test_two_motions_are_told_apart_and_cut(oriented: bool, rng: np.random.Generator) -> None:
    choice = choose(slid_then_turned(rng, oriented))
    assert (choice.kind, choice.enough) == ("none", False)
    assert choice.why.startswith("none of these")
    first, second = choice.phases
    assert (first.choice.kind, second.choice.kind) == ("prismatic", "revolute")
    assert first.end == pytest.approx(0.12, abs=0.02)
    assert second.choice.fit.model.radius == pytest.approx(0.3, abs=0.02)
    assert "two motions: 0–1" in choice.why


def test_a_hand_that_holds_nothing_is_none_of_these(rng: np.random.Generator) -> None:
    t = np.linspace(0.0, 1.0, 150)[:, None]
    p = sum(0.15 * np.sin(2.0 * np.pi * k * t + rng.uniform(0.0, 6.0, 3)) / k for k in (1, 2, 3))
    choice = choose(Track(p))
    assert (choice.kind, choice.enough, choice.phases) == ("none", False, ())
    assert choice.misfit.position > 0.02
    assert choice.misfit.between is not None


@pytest.mark.parametrize("oriented", [True, False])
def test_a_rest_before_and_after_does_not_outvote_the_motion(oriented: bool) -> None:
    rng = np.random.default_rng(3)
    a = np.concatenate([np.zeros(300), np.linspace(0.0, 1.0, 60), np.full(200, 1.0)])
    choice = choose(track_of(noisy(ideal("revolute", a, rng, 0.5), rng, 1e-3, 0.3 * DEGREE), oriented))
    assert (choice.kind, choice.enough) == ("revolute", True)
    assert choice.fit.model.radius == pytest.approx(0.5, abs=0.02)
    assert len(choice.fit.configurations) == len(a)


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
def test_one_sample_in_ten_far_off_costs_no_certainty(kind: str) -> None:
    rng = np.random.default_rng(4)
    seen = noisy(ideal(kind, np.linspace(0.0, 0.4 if kind == "prismatic" else 1.0, 120), rng, 0.4), rng, 1e-3)
    far = rng.random(120) < 0.1
    p = seen.positions + far[:, None] * rng.normal(0.0, 0.15, (120, 3))
    choice = choose(Track(p))
    assert (choice.kind, choice.enough) == (kind, True)
    # what lies within some centimetres may be left to the fit's weights
    assert lone(Track(p))[np.linalg.norm(p - seen.positions, axis=1) > 0.06].mean() > 0.8
    assert lone(Track(p))[~far].mean() < 0.02  # the last sample, where both before it are outliers


def test_a_bow_that_handles_have_proves_no_hinge() -> None:
    """Five millimetres over ten centimetres: a lever of 25 cm, or a drawer's handle that settles in the hand."""
    rng = np.random.default_rng(1)
    seen = noisy(ideal("revolute", np.linspace(0.0, 0.4, 60), rng, 0.25), rng, 4e-4)
    choice = choose(Track(seen.positions))
    assert not choice.enough
    assert not choice.misfit.fails


def test_moved_and_mirrored_the_same_samples_tell(rng: np.random.Generator) -> None:
    seen = noisy(ideal("revolute", np.concatenate([np.zeros(60), np.linspace(0.0, 1.0, 60)]), rng, 0.4), rng, 1e-3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for p in (seen.positions @ turn.T + 1.0, seen.positions * [-1.0, 1.0, 1.0]):
        assert np.array_equal(telling(Track(p)), telling(Track(seen.positions)))


def test_a_track_too_short_for_two_motions_is_not_cut(rng: np.random.Generator) -> None:
    seen = noisy(ideal("prismatic", np.linspace(0.0, 0.04, 40), rng), rng, 1e-4)
    assert best_cut(Track(seen.positions)) is None
