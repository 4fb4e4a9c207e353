"""What is no one joint is said to be none; what is certain predicts; rests and outliers do not outvote the motion."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy
from scipy.spatial.transform import Rotation

from modcal_core.articulation.choice import choose
from modcal_core.articulation.evidence import hidden
from modcal_core.articulation.models.prismatic import PrismaticMotion
from modcal_core.articulation.track import Track, lone, telling
from modcal_core.articulation.two_motions import best_cut, two_explain

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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("oriented", [True, False])
def test_what_two_motions_explain_down_to_the_noise_is_not_certainly_one(oriented: bool) -> None:
    """A door on two pins: within 3 mm of one hinge all the way, which is no more than handles and cameras leave."""
    rng, n = np.random.default_rng(4), 160
    a, b = np.linspace(0.0, np.radians(38.0), n // 2), np.linspace(0.0, np.radians(38.0), n // 2)
    z = [0.0, 0.0, 1.0]
    first = 0.7 * np.stack([np.cos(a) - 1.0, np.sin(a), 0.0 * a], axis=1)
    turned = Rotation.from_rotvec(a[-1] * np.array(z))
    second = first[-1] + turned.apply(0.4 * np.stack([np.cos(b) - 1.0, np.sin(b), 0.0 * b], axis=1))
    p = np.concatenate([first, second]) + rng.normal(0.0, 5e-4, (n, 3))
    R = Rotation.from_rotvec(np.outer(np.r_[a, a[-1] + b], z)).as_matrix()
    choice = choose(Track(p, R if oriented else None))
    assert choice.misfit.position < 4e-3
    assert choice.best == "revolute"
    assert not choice.enough
    assert "two motions, cut at" in choice.why
    one = noisy(ideal("revolute", np.linspace(0.0, 1.2, n), rng, 0.55), rng, 5e-4, 5e-3)
    assert choose(track_of(one, oriented)).enough


def test_a_bow_on_top_of_a_joint_is_not_two_motions(rng: np.random.Generator) -> None:
    """What departs by 1.5 mm here and there is left by two arcs as well."""
    a = np.linspace(0.0, 0.4, 200)
    seen = ideal("prismatic", a, rng)
    off = 1.5e-3 * np.stack([np.sin(2 * np.pi * a / 0.12), np.sin(2 * np.pi * a / 0.09 + 1.0), 0.0 * a], axis=1)
    track = Track(seen.positions + off + rng.normal(0.0, 5e-4, (200, 3)), None)
    assert two_explain(track) == ""


@pytest.mark.parametrize(("degrees", "radius", "certain"), [(14.0, 2.2, False), (60.0, 2.2, True), (40.0, 0.8, True)])
def test_an_arc_farther_away_than_hinges_of_furniture_has_to_be_long(
    degrees: float, radius: float, certain: bool
) -> None:
    """A garage's gate that goes all the way is a hinge; half a metre of its arc is any curve."""
    rng = np.random.default_rng(6)
    a = np.linspace(0.0, degrees * DEGREE, 160)
    for oriented in (True, False):
        choice = choose(track_of(noisy(ideal("revolute", a, rng, radius), rng, 5e-4, 2e-3), oriented))
        assert choice.kind == "revolute", choice.why
        assert choice.enough == certain, choice.why
        assert certain or "hinges are seldom farther away than 1.6 m" in choice.why


def test_a_line_that_leaves_as_much_as_a_hinge_would_is_not_certain() -> None:
    """The same 19 cm: with play of half a millimetre they are a drawer's, with play of 7 mm a cupboard's as well."""
    rng = np.random.default_rng(9)
    a = np.linspace(0.0, 0.19, 80)
    motion = PrismaticMotion(np.zeros(3), np.eye(3))
    assert hidden(motion, a, 5e-4) == ""
    assert "the arc of a hinge at 40 cm is 3 mm from a line" in hidden(motion, a, 6e-3)
    play = np.interp(a, np.linspace(0.0, 0.19, 8), rng.choice([-1.0, 1.0], 8))
    for size, certain in ((5e-4, True), (7e-3, False)):
        p = np.stack([a, size * play, 0.0 * a], axis=1) + rng.normal(0.0, 2e-4, (80, 3))
        assert choose(Track(p)).enough == certain
