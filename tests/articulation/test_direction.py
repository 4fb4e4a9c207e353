"""A door that closes is the door that opened: what a whole track tells does not depend on its direction in time."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import ideal, noisy, real
from articulation.test_none_of_these import slid_then_turned
from scipy.spatial.transform import Rotation

from modcal_core.articulation import choice as choice_module
from modcal_core.articulation.choice import Choice, choose
from modcal_core.articulation.track import Track, backwards, telling, travelled
from modcal_core.articulation.two_motions import best_cut


def flawed(kind: str, seed: int, oriented: bool = False) -> Track:
    seen = real(kind, np.random.default_rng(seed))
    return Track(seen.positions, seen.rotations if oriented else None)


def reverse(track: Track) -> Track:
    return track.part(np.arange(len(track))[::-1])


def same(one: Choice, other: Choice) -> None:
    assert (one.kind, one.best, one.enough) == (other.kind, other.best, other.enough)
    assert one.probabilities == pytest.approx(other.probabilities, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_reverse_has_the_opposite_direction_and_a_moved_or_mirrored_track_the_same(seed: int) -> None:
    p = flawed("revolute", seed).positions
    turn = Rotation.random(random_state=seed).as_matrix()
    assert backwards(p) != backwards(p[::-1])
    assert backwards(p) == backwards(p @ turn.T + [1.0, -2.0, 0.5]) == backwards(p * [-1.0, 1.0, 1.0])


@pytest.mark.parametrize("seed", range(4))
def test_of_the_reverse_the_same_samples_tell_and_the_same_path_was_travelled(seed: int) -> None:
    track = flawed("prismatic", seed)
    other = reverse(track)
    assert np.array_equal(telling(track), np.sort(len(track) - 1 - telling(other)))
    way, back = travelled(track), travelled(other)
    assert way == pytest.approx(way[-1] - back[::-1], abs=1e-12)
    assert (np.diff(way) >= 0.0).all()


def test_two_motions_are_cut_at_the_same_sample(rng: np.random.Generator) -> None:
    track = slid_then_turned(rng, False)
    cut, other = best_cut(track), best_cut(reverse(track))
    assert cut is not None
    assert other is not None
    assert cut == len(track) - other


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "oriented"), [("prismatic", False), ("revolute", False), ("revolute", True)])
def test_a_track_and_its_reverse_are_told_alike(kind: str, oriented: bool) -> None:
    for seed in range(3):
        track = flawed(kind, seed, oriented)
        one, other = choose(track), choose(reverse(track))
        same(one, other)
        assert one.fit.configurations == pytest.approx(
            one.fit.configurations[-1] + (-1.0 if _opposed(one, other) else 1.0) * other.fit.configurations[::-1],
            abs=1e-4,
        )
        assert other.fit.configurations[0] == 0.0


def _opposed(one: Choice, other: Choice) -> bool:
    return float(one.fit.model.axis @ other.fit.model.axis) < 0.0


@pytest.mark.slow
def test_pooled_from_either_end_the_kinds_are_as_probable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not because one end was agreed upon: what is pooled is short enough that it does not matter where it begins."""
    for seed in range(3):
        track = flawed("prismatic", seed)
        one = choose(track)
        with monkeypatch.context() as patch:
            patch.setattr(choice_module, "one_way", lambda t: reverse(t) if not backwards(t.positions) else t)
            other = choose(track)
        assert one.probabilities == pytest.approx(other.probabilities, abs=0.02)


@pytest.mark.slow
def test_a_phase_is_told_alike_from_either_end(rng: np.random.Generator) -> None:
    track = slid_then_turned(rng, False)
    one, other = choose(track), choose(reverse(track))
    assert [phase.choice.kind for phase in one.phases] == [phase.choice.kind for phase in other.phases][::-1]
    assert one.phases[0].end == pytest.approx(one.phases[1].end - other.phases[0].end, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [2.5, 4.5])
def test_rotations_that_disagree_by_a_few_degrees_are_weighed_alike_from_either_end(tilt: float) -> None:
    """An axis that rotations show tilted: a fit takes the positions' side or theirs, and must not do so by chance."""
    a = np.linspace(0.0, 1.6, 120)
    rng = np.random.default_rng(5)
    seen = noisy(ideal("revolute", a, rng, 0.35), rng, 2e-4)
    middle = seen.positions[60] - seen.point
    forward = np.cross(seen.axis, middle / np.linalg.norm(middle))  # so that the handle sags, and climbs nowhere
    leaning = Rotation.from_rotvec(np.radians(tilt) * forward).apply(seen.axis)
    R = (Rotation.from_rotvec(np.outer(a, leaning)) * Rotation.from_rotvec(rng.normal(0.0, 5e-4, (120, 3)))).as_matrix()
    track = Track(seen.positions, R)
    one, other = choose(track), choose(reverse(track))
    assert one.kind == "revolute", one.why
    same(one, other)
    for choice in (one, other):
        assert choice.misfit.position < 8e-3


@pytest.mark.parametrize("turned", [200.0, 430.0, -430.0])
def test_a_wheel_is_said_to_turn_by_what_it_turned(turned: float) -> None:
    a = np.radians(np.linspace(0.0, turned, 160))
    rng = np.random.default_rng(4)
    p = 0.3 * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1) + rng.normal(0.0, 1e-3, (160, 3))
    p[50] += 0.3  # an outlier on the other side
    choice = choose(Track(p))
    assert choice.best == "revolute"
    assert np.ptp(np.delete(choice.fit.configurations, 50)) == pytest.approx(np.radians(abs(turned)), abs=0.03)
    assert f"it turned {abs(turned):.0f}°" in choice.why
