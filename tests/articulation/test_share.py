"""Trust by a share of the path, and certainty only where no smooth bend explains what is left."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import Array, ideal, noisy
from scipy.spatial.transform import Rotation

from modcal_core.articulation.choice import choose
from modcal_core.articulation.misfit import ShareCheck, Stretches, bend_explains
from modcal_core.articulation.models.revolute import RevoluteMotion
from modcal_core.articulation.online import Tracker, TrackerSettings, TrackerState
from modcal_core.articulation.track import Track


def along(radius_of: object, degrees: float, n: int) -> Array:
    """A crank whose length is a function of its angle."""
    a = np.linspace(0.0, np.radians(degrees), n)
    return radius_of(a)[:, None] * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1)


def hinge(radius: float) -> RevoluteMotion:
    """Of a handle that begins at (radius, 0, 0) and turns about z."""
    return RevoluteMotion(
        np.array([radius, 0.0, 0.0]), np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), r=radius
    )


def asked(p: Array, motion: RevoluteMotion, noise: float = 3e-4) -> list[bool]:
    stretches = Stretches()
    check, out = ShareCheck(stretches, 4e-3), []
    for x in p:
        stretches.come(x, noise)
        check.come(motion, noise)
        out.append(check.fails)
    return out


def test_a_hinge_that_was_known_early_predicts_all_that_comes() -> None:
    p = along(lambda a: 0.5 + 0.0 * a, 90.0, 300) + np.random.default_rng(0).normal(0.0, 3e-4, (300, 3))
    assert not any(asked(p, hinge(0.5)))


def test_a_path_that_winds_in_is_found_out_by_what_came_since() -> None:
    """Every 5 cm of it are a hinge within the tolerance; two fifths of it are not."""
    p = along(lambda a: 0.5 - 0.03 * a**2, 90.0, 300) + np.random.default_rng(0).normal(0.0, 3e-4, (300, 3))
    fails = asked(p, hinge(0.5))
    assert not any(fails[:60])
    assert fails[-1]


def test_noise_is_no_miss() -> None:
    p = along(lambda a: 0.5 + 0.0 * a, 60.0, 300) + np.random.default_rng(0).normal(0.0, 8e-3, (300, 3))
    assert asked(p, hinge(0.5), 8e-3)[-1] is False


def bent(smooth: bool, seed: int = 3) -> Track:
    """A hinge of 40 cm that departs by some millimetres: in one wave, or in places a few centimetres apart."""
    rng, n = np.random.default_rng(seed), 240
    a = np.linspace(0.0, 1.2, n)
    if smooth:
        off = 4e-3 * np.sin(2.0 * np.pi * a / a[-1])
    else:
        off = 2e-3 * np.interp(a, np.linspace(0.0, a[-1], 16), rng.uniform(-1.0, 1.0, 16))
    p = (0.4 + off)[:, None] * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1)
    return Track(p + rng.normal(0.0, 4e-4, p.shape))


@pytest.mark.slow
def test_what_a_smooth_bend_explains_is_not_certain_and_play_is() -> None:
    """A cut into two leaves little of the smooth one as well; by itself, the bend is reason enough."""
    track = bent(smooth=True)
    choice = choose(track)
    assert not choice.enough
    a = choice.fit.motion.configurations(track)
    assert bend_explains(track, choice.fit.motion.residuals(track, a), a)
    assert choose(bent(smooth=False)).enough


def test_white_noise_and_few_samples_are_no_bend() -> None:
    rng = np.random.default_rng(1)
    for n in (8, 30, 200):
        seen = noisy(ideal("revolute", np.linspace(0.0, 1.0, n), rng, 0.4), rng, 1e-3)
        e = rng.normal(0.0, 1e-3, (n, 3)) * [0.0, 1.0, 1.0]
        assert bend_explains(Track(seen.positions), e, np.linspace(0.0, 1.0, n)) == ""
    assert bend_explains(Track(seen.positions), e, np.zeros(200)) == ""


def test_a_bend_is_told_with_its_sizes() -> None:
    rng, n = np.random.default_rng(2), 200
    a = np.linspace(0.0, 1.0, n)
    p = np.outer(a, [0.4, 0.0, 0.0]) + rng.normal(0.0, 3e-4, (n, 3))
    R = Rotation.random(rng=rng)
    across = np.stack([0.0 * a, 3e-3 * np.sin(2.0 * np.pi * a), 0.0 * a], axis=1)
    e = R.apply(across + rng.normal(0.0, 3e-4, (n, 3)) * [0.0, 1.0, 1.0])
    assert bend_explains(Track(p), e, a).endswith("leaves 2.1 mm")


def play(n: int, rng: np.random.Generator, size: float = 1.5e-3) -> Array:
    """A handle's play: alike within some centimetres, unlike beyond."""
    out = np.zeros(n)
    for i in range(1, n):
        out[i] = 0.75 * out[i - 1] + rng.normal(0.0, size * np.sqrt(1.0 - 0.75**2))
    return out


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


@pytest.mark.slow
def test_trust_may_be_asked_to_wait_for_a_longer_path() -> None:
    a = np.linspace(0.0, 1.5, 260)
    p = crank(0.35 + 0.0 * a, a, np.random.default_rng(1))
    soon, late = followed(p), followed(p, 0.4)
    assert min(s.path_m for s in soon if s.trusted) < 0.25
    assert min(s.path_m for s in late if s.trusted) == pytest.approx(0.4, abs=0.02)
    assert soon[-1].path_m == pytest.approx(0.35 * 1.5, abs=0.02)
