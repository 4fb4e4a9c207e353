"""What goes wrong while images are taken, or is misstated of them: named, left out or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from camera.boards import views
from camera.fits import MEASURED, images, solved, true_error
from camera.scenes import scene

from modcal_core.camera.claim import DO_NOT_APPLY
from modcal_core.camera.corners import FIXED, TOLERANCE
from modcal_core.camera.lens import Lens
from modcal_core.camera.views import postures_in_view
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3


@pytest.mark.slow
def test_a_kicked_tripod_is_named() -> None:
    s = scene(5, False, count=20, board=MEASURED)
    half = len(s.views) // 2
    kick = se3.exp([2e-3, 0.0, 0.0, 0.0, 2e-3, 0.0])  # of what stands in the world
    T = kick @ s.T[half:]
    later = views(np.random.default_rng(0), T, board=s.board)
    r = solved(replace(s, views=[*s.views[:half], *later]))
    assert r.claim.decision.word == DO_NOT_APPLY
    assert r.evidence.moved is not None
    assert r.evidence.moved.since == half
    assert r.evidence.moved.what == "camera"
    assert any(said.startswith("The camera was moved before image") for said in r.claim.decision.because)


@pytest.mark.slow
def test_a_focus_that_was_changed_is_no_move() -> None:
    """Of images that look like those of a camera that was moved along its axis."""
    s, zoom = images(False), 1.003
    half = len(s.views) // 2
    other = replace(s.lens, values=s.lens.values * np.r_[zoom, zoom, np.ones(7)])
    later = views(np.random.default_rng(0), s.T, lens=other, board=s.board)[half:]
    r = solved(replace(s, views=[*s.views[:half], *later]), look_for_effects=False)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert r.evidence.moved is not None
    assert r.evidence.moved.since == half
    assert 100.0 * r.evidence.moved.focal == pytest.approx(100.0 * (zoom - 1.0), rel=0.3)
    assert any("another focal length from image" in said for said in r.claim.decision.because)


@pytest.mark.slow
@pytest.mark.parametrize("much", [5e-3, 0.02])
def test_a_focus_that_hunts_is_an_error_of_each_image(much: float) -> None:
    """Every second image is larger: a little, and the interval has it; by more than any arm, and it is said."""
    s = scene(65, False, count=20, length_std=1e-3, angle_std=1e-3, board=MEASURED)
    T, seen = s.T, []
    for i, zoom in enumerate(1.0 + much * (np.arange(len(T)) % 2)):
        other = replace(s.lens, values=s.lens.values * np.r_[zoom, zoom, np.ones(7)])
        seen += views(np.random.default_rng([8, i]), T[i : i + 1], lens=other, board=MEASURED)
    r = solved(replace(s, views=seen), look_for_effects=False)
    assert r.evidence.moved is None
    assert true_error(s, r.fit, postures_in_view(r.fit, np.random.default_rng(1))) < r.claim.in_view.interval[2]
    assert any("autofocus" in said for said in r.claim.decision.problems) == (much > 0.01)


@pytest.mark.slow
def test_an_image_of_another_posture_is_left_out() -> None:
    s = images(True)
    q = s.q.copy()
    q[7] += 0.05
    r = solved(replace(s, q=q))
    assert list(r.camera.left_out) == [s.views[7].name]


@pytest.mark.slow
def test_a_lens_of_another_camera_is_named() -> None:
    """Focal length 2 % and centre of another resolution, both stated as exact: neither can be the arm's fault."""
    s = images(True)
    longer = Lens(s.lens.values * np.r_[1.02, 1.02, np.ones(7)], s.lens.size)
    r = solved(s, lens=longer, stated=FIXED)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert any("a lens whose focal length is 9" in said for said in r.claim.decision.because)
    assert not any("contradict" in said for said in solved(s, lens=s.lens, stated=TOLERANCE).claim.decision.because)


@pytest.mark.slow
def test_an_arm_worse_than_stated_is_named() -> None:
    r = solved(images(True), arm_m=3e-4)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert any("as far off as --arm-mm states" in said for said in r.claim.decision.because)


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.03, 1.0])
def test_images_of_another_moment_are_refused_or_named(delay_s: float) -> None:
    """An arm that moves at 0.3 rad/s, taken as standing: the joints are those of 30 ms or 1 s before."""
    velocity = 0.3 * np.random.default_rng(8).choice([-1.0, 1.0], (20, 7))
    s = scene(6, True, count=20, board=MEASURED, velocity=velocity, delay_s=delay_s)
    if delay_s == 1.0:
        with pytest.raises(BadRecording, match="belong"):
            solved(s)
        return
    r = solved(s)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert any("of the same moment" in said for said in r.claim.decision.because)


def test_pictures_turned_upside_down_are_left_out() -> None:
    """Every third of them, as a viewer saves them that turns them upright: no fit runs away."""
    s = images(True)
    far = np.array(s.lens.size) - 1.0
    turned = [replace(v, pixels=far - v.pixels) if i % 3 == 0 else v for i, v in enumerate(s.views)]
    r = solved(replace(s, views=turned), look_for_effects=False)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert set(r.camera.left_out) == {v.name for v in turned[::3]}


def test_a_camera_that_hung_is_noticed() -> None:
    """The same picture, noise and all, under four names, and with four postures of the arm."""
    s = images(True)
    hung = [replace(s.views[4], name=v.name) if 4 <= i < 8 else v for i, v in enumerate(s.views)]
    r = solved(replace(s, views=hung), look_for_effects=False)
    assert set(r.camera.left_out) == {"5.png", "6.png", "7.png"}
    assert all("the same picture as 4.png" in why for why in r.camera.left_out.values())
    assert r.claim.decision.word == DO_NOT_APPLY


def test_copies_of_images_say_nothing_more() -> None:
    s = images(True)
    copies = [replace(v, name=f"copy of {v.name}") for v in s.views]
    both = replace(s, q=np.concatenate([s.q, s.q]), views=[*s.views, *copies])
    once, twice = (solved(one, look_for_effects=False) for one in (s, both))
    assert twice.claim.in_view.interval == pytest.approx(once.claim.in_view.interval, rel=1e-6)
    assert set(twice.camera.left_out) == {v.name for v in copies}


def test_two_boards_in_turn_are_refused() -> None:
    """Every other image shows a board of the same print that lies 0.2 m away."""
    s = images(False)
    T = se3.exp([0.05, 0.0, 0.0, 0.0, 0.2, 0.0]) @ s.T
    other = views(np.random.default_rng(0), T, board=s.board)
    with pytest.raises((BadRecording, NotEnoughData)):
        solved(replace(s, views=[a if i % 2 else b for i, (a, b) in enumerate(zip(s.views, other, strict=True))]))
