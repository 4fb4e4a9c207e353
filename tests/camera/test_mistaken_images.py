"""What goes wrong with images, target, camera and tables, or is misstated: named, left out or refused; the decision."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from camera.boards import BOARD, views
from camera.fits import MEASURED, images, solved, true_error
from camera.rolling import rolling_views
from camera.scenes import CameraScene, scene

from modcal_core.camera.claim import APPLY, AS_STATED, DO_NOT_APPLY, DrawnErrors, ToolError, decide
from modcal_core.camera.corners import FIXED, TOLERANCE
from modcal_core.camera.fit import CameraImages
from modcal_core.camera.lens import Lens
from modcal_core.camera.prepared import prepare_images
from modcal_core.camera.statements import CLOCK, TARGET
from modcal_core.camera.views import postures_in_view
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array


@pytest.mark.slow
def test_a_kicked_tripod_is_named() -> None:
    s = scene(5, False, count=20, board=MEASURED)
    half = len(s.views) // 2
    kick = se3.exp([2e-3, 0.0, 0.0, 0.0, 2e-3, 0.0])  # of what stands in the world
    T = kick @ s.T[half:]
    later = views(np.random.default_rng(0), T, board=s.board)
    r = solved(replace(s, views=[*s.views[:half], *later]))
    assert r.claim.decision.word == DO_NOT_APPLY
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
def test_images_of_another_moment_are_named() -> None:
    """An arm that moves at 0.3 rad/s, taken as standing: the joints are those of 30 ms before."""
    velocity = 0.3 * np.random.default_rng(8).choice([-1.0, 1.0], (20, 7))
    r = solved(scene(6, True, count=20, board=MEASURED, velocity=velocity, delay_s=0.03))
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


def test_joints_a_row_too_high_are_named_of_many_images() -> None:
    """More images than hypotheses are sifted on: where a row belongs cannot be asked of some of them."""
    s = scene(3, True, count=30)
    with pytest.raises(BadRecording, match="each stands 1 row too high"):
        solved(replace(s, q=np.roll(s.q, 1, axis=0)))


def test_two_boards_in_turn_are_refused() -> None:
    """Every other image shows a board of the same print that lies 0.2 m away."""
    s = images(False)
    T = se3.exp([0.05, 0.0, 0.0, 0.0, 0.2, 0.0]) @ s.T
    other = views(np.random.default_rng(0), T, board=s.board)
    with pytest.raises((BadRecording, NotEnoughData)):
        solved(replace(s, views=[a if i % 2 else b for i, (a, b) in enumerate(zip(s.views, other, strict=True))]))


EXCHANGED = [0, 1, 2, 3, 4, 6, 5]


@pytest.mark.parametrize(
    ("joints", "mirror", "said"),
    [
        (lambda q: np.roll(q, 1, axis=0), 1.0, "readings look early by 1 station"),
        (lambda q: q[:, EXCHANGED], 1.0, "panda_joint6.*panda_joint7"),
        (lambda q: q, -1.0, "mirror image"),
    ],
)
def test_what_would_belong_together_is_named(joints: Callable[[Array], Array], mirror: float, said: str) -> None:
    s = scene(77, True, count=18, board=MEASURED)
    views = [replace(v, pixels=[0.0, 360.0 - 360.0 * mirror] + v.pixels * [1.0, mirror]) for v in s.views]
    with pytest.raises(BadRecording, match=said):
        prepare_images(s.chain, CameraImages(joints(s.q), views, s.board, s.lens.size))


ARM_M = 5e-4  # what is known of the arm


def known_arm(on_tip: bool) -> CameraScene:
    return scene(51, on_tip, count=15, length_std=1e-4, angle_std=2e-4)


def on_sheet(s: CameraScene, points: Array) -> CameraScene:
    T = se3.inverse(s.T) if s.on_tip else s.T
    return replace(s, views=views(np.random.default_rng(1), T, board=s.board, printed=points))


@pytest.mark.slow
def test_a_print_of_another_size() -> None:
    """1 % too large and nobody measured it: named where the arm is known; else it may be the arm's scale as well."""
    s = on_sheet(known_arm(True), 1.01 * BOARD.points)
    (found,) = solved(s, arm_m=ARM_M).evidence.findings
    assert (found.family, found.entry.direction, found.entry.same_as) == (TARGET, "size", ())
    assert found.entry.sizes["size_x"][0] == pytest.approx(0.01, abs=2e-3)
    assert found.at_tool_m > 3e-3
    alone = [f for f in solved(s).evidence.findings if f.entry.direction == "size"]
    assert all(f.entry.same_as for f in alone)


@pytest.mark.slow
def test_a_bent_sheet() -> None:
    points = BOARD.points.copy()
    x = points[:, 0] - points[:, 0].mean()
    points[:, 2] = 5e-4 * (x / x.max()) ** 2
    (found,) = solved(on_sheet(known_arm(True), points), arm_m=ARM_M).evidence.findings
    assert (found.family, found.entry.direction) == (TARGET, "normal")
    assert "bent by 0.5" in found.sentence


@pytest.mark.slow
@pytest.mark.parametrize(("delay_s", "readout_s"), [(0.0, 0.0), (-0.02, 0.02)])
def test_late_images_and_a_rolling_shutter(delay_s: float, readout_s: float) -> None:
    """Of a moving arm: delay and line time are told apart, and neither is named of a camera that has none."""
    s = known_arm(False)
    rng = np.random.default_rng(2)
    velocity = 0.3 * rng.choice([-1.0, 1.0], s.q.shape)
    r = solved(rolling_views(s, velocity, delay_s, readout_s, rng), velocity=velocity, arm_m=ARM_M)
    found = {f.entry.driver: f for f in r.evidence.findings}
    assert set(found) == {d for d, x in (("velocity", delay_s), ("line", readout_s)) if x}
    assert all(f.family == CLOCK for f in found.values())
    if delay_s:
        assert found["velocity"].entry.sizes["delay_s"][0] == pytest.approx(delay_s, abs=5e-4)
    if readout_s:
        assert found["line"].entry.sizes["line_s"][0] == pytest.approx(readout_s / 720, rel=0.03)
    assert not r.evidence.causes


COUNT = 2000


def error(calibrated: Array, nominal: Array) -> ToolError:
    return ToolError({AS_STATED: DrawnErrors(calibrated, calibrated, nominal)})


def test_what_is_open_of_both_arms_hides_no_gain(rng: np.random.Generator) -> None:
    """The lens puts both off by up to 3 mm, and the nominal arm by 2 mm besides, whichever way the lens does."""
    lens = 3e-3 * np.abs(rng.standard_normal(COUNT))
    both = error(np.hypot(lens, 3e-4), np.hypot(lens, 2e-3))
    assert both.interval[2] > both.nominal_interval[0]
    found = decide(both)
    assert found.word == APPLY
    assert "moves both alike" in found.because[0]
    # the same two intervals where nothing is shared
    apart = error(both.by[AS_STATED].calibrated, rng.permutation(both.by[AS_STATED].nominal))
    assert apart.interval == both.interval
    assert apart.nominal_interval == both.nominal_interval
    assert decide(apart).word == DO_NOT_APPLY


def test_three_draws_in_two_hundred_that_are_worse_are_too_many(rng: np.random.Generator) -> None:
    calibrated = np.full(COUNT, 1e-3)
    nominal = np.where(np.arange(COUNT) < 0.015 * COUNT, 0.9e-3, 2e-3)
    assert decide(error(calibrated, nominal)).word == DO_NOT_APPLY
    nominal = np.where(np.arange(COUNT) < 0.002 * COUNT, 0.9e-3, 2e-3)
    assert decide(error(calibrated, nominal)).word == APPLY


def test_what_the_user_states_of_the_arm_is_to_be_beaten_by_all_of_the_interval() -> None:
    ends = error(np.linspace(1e-4, 1e-3, COUNT), np.full(COUNT, 5e-3))
    assert decide(ends, 2e-3).word == APPLY
    found = decide(ends, 9e-4)
    assert found.word == DO_NOT_APPLY
    assert "0.90 mm is stated" in found.because[0]
