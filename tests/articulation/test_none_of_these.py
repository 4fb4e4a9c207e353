"""Two motions, hands that hold nothing, and tracks that tell alike in either direction."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy, real
from scipy.spatial.transform import Rotation

from modcal_core.articulation.choice import Choice, choose
from modcal_core.articulation.evidence import hidden
from modcal_core.articulation.models.prismatic import PrismaticMotion
from modcal_core.articulation.track import Track, backwards, lone

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
def test_two_motions_are_told_apart_and_cut(rng: np.random.Generator) -> None:
    choice = choose(slid_then_turned(rng, True))
    assert (choice.kind, choice.enough) == ("none", False)
    assert choice.why.startswith("none of these")
    first, second = choice.phases
    assert (first.choice.kind, second.choice.kind) == ("prismatic", "revolute")
    assert first.end == pytest.approx(0.12, abs=0.02)
    assert second.choice.fit.model.radius == pytest.approx(0.3, abs=0.02)
    assert "two motions: 0–1" in choice.why


@pytest.mark.slow
def test_a_hand_that_holds_nothing_is_none_of_these(rng: np.random.Generator) -> None:
    t = np.linspace(0.0, 1.0, 150)[:, None]
    p = sum(0.15 * np.sin(2.0 * np.pi * k * t + rng.uniform(0.0, 6.0, 3)) / k for k in (1, 2, 3))
    choice = choose(Track(p))
    assert (choice.kind, choice.enough, choice.phases) == ("none", False, ())
    assert choice.misfit.position > 0.02
    assert choice.misfit.between is not None


@pytest.mark.slow
def test_a_rest_before_and_after_does_not_outvote_the_motion() -> None:
    rng = np.random.default_rng(3)
    a = np.concatenate([np.zeros(300), np.linspace(0.0, 1.0, 60), np.full(200, 1.0)])
    choice = choose(track_of(noisy(ideal("revolute", a, rng, 0.5), rng, 1e-3, 0.3 * DEGREE), False))
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


@pytest.mark.slow
def test_what_two_motions_explain_down_to_the_noise_is_not_certainly_one() -> None:
    """A door on two pins: within 3 mm of one hinge all the way, which is no more than handles and cameras leave."""
    rng, n = np.random.default_rng(4), 160
    a, b = np.linspace(0.0, np.radians(38.0), n // 2), np.linspace(0.0, np.radians(38.0), n // 2)
    z = [0.0, 0.0, 1.0]
    first = 0.7 * np.stack([np.cos(a) - 1.0, np.sin(a), 0.0 * a], axis=1)
    turned = Rotation.from_rotvec(a[-1] * np.array(z))
    second = first[-1] + turned.apply(0.4 * np.stack([np.cos(b) - 1.0, np.sin(b), 0.0 * b], axis=1))
    p = np.concatenate([first, second]) + rng.normal(0.0, 5e-4, (n, 3))
    R = Rotation.from_rotvec(np.outer(np.r_[a, a[-1] + b], z)).as_matrix()
    choice = choose(Track(p, R))
    assert choice.misfit.position < 4e-3
    assert choice.best == "revolute"
    assert not choice.enough
    assert "two motions, cut at" in choice.why
    one = noisy(ideal("revolute", np.linspace(0.0, 1.2, n), rng, 0.55), rng, 5e-4, 5e-3)
    assert choose(track_of(one, True)).enough


@pytest.mark.slow
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


@pytest.mark.slow
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


def flawed(kind: str, seed: int, oriented: bool = False) -> Track:
    seen = real(kind, np.random.default_rng(seed))
    return Track(seen.positions, seen.rotations if oriented else None)


def reverse(track: Track) -> Track:
    return track.part(np.arange(len(track))[::-1])


def same(one: Choice, other: Choice) -> None:
    assert (one.kind, one.best, one.enough) == (other.kind, other.best, other.enough)
    assert one.probabilities == pytest.approx(other.probabilities, abs=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_the_reverse_has_the_opposite_direction_and_a_moved_or_mirrored_track_the_same(seed: int) -> None:
    p = flawed("revolute", seed).positions
    turn = Rotation.random(random_state=seed).as_matrix()
    assert backwards(p) != backwards(p[::-1])
    assert backwards(p) == backwards(p @ turn.T + [1.0, -2.0, 0.5]) == backwards(p * [-1.0, 1.0, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "oriented"), [("prismatic", False), ("revolute", True)])
def test_a_track_and_its_reverse_are_told_alike(kind: str, oriented: bool) -> None:
    track = flawed(kind, 0, oriented)
    one, other = choose(track), choose(reverse(track))
    same(one, other)
    opposed = float(one.fit.model.axis @ other.fit.model.axis) < 0.0
    assert one.fit.configurations == pytest.approx(
        one.fit.configurations[-1] + (-1.0 if opposed else 1.0) * other.fit.configurations[::-1], abs=1e-4
    )
    assert other.fit.configurations[0] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("turned", [430.0, -430.0])
def test_a_wheel_is_said_to_turn_by_what_it_turned(turned: float) -> None:
    a = np.radians(np.linspace(0.0, turned, 160))
    rng = np.random.default_rng(4)
    p = 0.3 * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1) + rng.normal(0.0, 1e-3, (160, 3))
    p[50] += 0.3  # an outlier on the other side
    choice = choose(Track(p))
    assert choice.best == "revolute"
    assert np.ptp(np.delete(choice.fit.configurations, 50)) == pytest.approx(np.radians(abs(turned)), abs=0.03)
    assert f"it turned {abs(turned):.0f}°" in choice.why
