"""Trust is withheld where what the joint leaves of the path so far is one smooth bend, and not where it is play."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import Array

from modcal_core.articulation.misfit import BendCheck, Stretches, bend_left
from modcal_core.articulation.models.prismatic import PrismaticMotion
from modcal_core.articulation.online import Tracker, TrackerSettings, TrackerState


def left_over(across: Array, rng: np.random.Generator, noise: float) -> tuple[Array, Array]:
    """Residuals of a joint's path along x that departs to the side by so much, in places 8 mm apart."""
    n = len(across)
    e = np.stack([0.0 * across, across, 0.0 * across], axis=1) + rng.normal(0.0, noise, (n, 3)) * [0.0, 1.0, 1.0]
    return e, np.linspace(0.0, 8e-3 * n, n)


def play(n: int, rng: np.random.Generator, size: float = 1.5e-3) -> Array:
    """A handle's play: alike within some centimetres, unlike beyond."""
    out = np.zeros(n)
    for i in range(1, n):
        out[i] = 0.75 * out[i - 1] + rng.normal(0.0, size * np.sqrt(1.0 - 0.75**2))
    return out


@pytest.mark.parametrize("noise", [1e-5, 3e-4])
def test_a_wave_is_a_bend_and_play_and_noise_are_none(noise: float) -> None:
    n = 48
    s = np.linspace(-1.0, 1.0, n)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert bend_left(*left_over(4e-3 * (s**3 - 0.6 * s), rng, noise))
        assert not bend_left(*left_over(play(n, rng), rng, noise))
        assert not bend_left(*left_over(0.0 * s, rng, noise))


def test_what_the_joint_itself_can_change_is_no_bend() -> None:
    """A line or a parabola is the fit's to take, and not yet taken when poses have just come."""
    s = np.linspace(-1.0, 1.0, 48)
    rng = np.random.default_rng(0)
    assert not bend_left(*left_over(3e-3 * s - 2e-3 * s**2, rng, 2e-4))


def test_few_stretches_outliers_and_a_handle_at_rest_say_nothing() -> None:
    s = np.linspace(-1.0, 1.0, 48)
    rng = np.random.default_rng(0)
    e, a = left_over(4e-3 * (s**3 - 0.6 * s), rng, 2e-4)
    assert not bend_left(e[:12], a[:12])
    assert not bend_left(e, 0.0 * a)
    far = e.copy()
    far[[7, 30]] += 0.2
    assert bend_left(far, a)


def test_the_question_is_asked_as_the_path_grows() -> None:
    """A slide whose slot bends off late: no bend in the first half, one in the end."""
    stretches, rng = Stretches(), np.random.default_rng(3)
    check = BendCheck(stretches)
    slide = PrismaticMotion(np.zeros(3), np.eye(3))
    found = []
    for s in np.linspace(0.0, 0.5, 500):
        stretches.come(np.array([s, 0.3 * max(s - 0.25, 0.0) ** 2, 0.0]) + rng.normal(0.0, 2e-4, 3), 2e-4)
        check.come(slide)
        found.append(check.found)
    assert not any(found[:250])
    assert found[-1]
    check.come(None)
    assert check.found


def crank(radius: Array, a: Array, rng: np.random.Generator) -> Array:
    p = radius[:, None] * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1)
    return p + rng.normal(0.0, 3e-4, p.shape)


def followed(p: Array, trust_after_m: float = 0.0) -> list[TrackerState]:
    tracker = Tracker(TrackerSettings(trust_after_m=trust_after_m))
    return [tracker.update(x, None, 0.02 * i) for i, x in enumerate(p)]


@pytest.mark.slow
def test_a_cam_loses_trust_once_its_lobe_shows_and_a_door_keeps_it() -> None:
    """The lobe is within the tolerance of a hinge for decimetres; what a hinge leaves of it is a wave."""
    a = np.linspace(0.0, 1.6, 320)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        door = followed(crank(0.35 + 0.0 * a, a, rng))
        cam = followed(crank(0.35 + 0.02 * np.cos(2.0 * a + 1.0), a, rng))
        late = slice(160, None)
        assert np.mean([s.trusted for s in door[late]]) > 0.95
        assert np.mean([s.trusted for s in cam[late]]) < 0.2


def test_trust_may_be_asked_to_wait_for_a_longer_path() -> None:
    a = np.linspace(0.0, 1.5, 260)
    p = crank(0.35 + 0.0 * a, a, np.random.default_rng(1))
    soon, late = followed(p), followed(p, 0.4)
    assert min(s.path_m for s in soon if s.trusted) < 0.25
    assert min(s.path_m for s in late if s.trusted) == pytest.approx(0.4, abs=0.02)
    assert soon[-1].path_m == pytest.approx(0.35 * 1.5, abs=0.02)
