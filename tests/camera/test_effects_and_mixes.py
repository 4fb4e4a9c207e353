"""Corners beside other instruments, and effects beyond geometry that corners alone show; truth from MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from camera.boards import BOARD, views
from camera.fits import MEASURED, alone, solved, start, true_error
from camera.scenes import CameraScene, scene
from finite_differences import assert_jacobian

from modcal_core.camera.arm_poses import ImageMoments
from modcal_core.camera.claim import APPLY, CANNOT_TELL
from modcal_core.camera.corners import common_prior
from modcal_core.camera.equations import ReadingsBeside, beside
from modcal_core.camera.solve import CameraSolution
from modcal_core.camera.views import postures_in_view
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

TRACKER = se3.exp([1.5, -0.4, 0.3, 0.2, 0.1, 2.0])  # where the camera's or the target's frame is in the tracker's
BALL = np.array([0.03, -0.05, 0.12])  # in the tool


def ball(s: CameraScene, q: Array, noise: float, rng: np.random.Generator) -> Array:
    """Where a tracker sees a ball on the tool, (N, 3) [m]."""
    T = TRACKER @ s.truth(q)
    return np.asarray(se3.apply(T, BALL) + noise * rng.standard_normal((len(q), 3)))


def tracked(s: CameraScene, count: int = 15, noise: float = 5e-5) -> ReadingsBeside:
    rng = np.random.default_rng(7)
    low, high = s.q.min(0), s.q.max(0)
    q = rng.uniform(low, high, (count, s.chain.n))
    return beside(s.chain, Samples.from_arrays(q, points=ball(s, q, noise, rng), names=s.chain.names))


def errors(s: CameraScene, r: CameraSolution) -> tuple[float, float]:
    """(true error at the tool, upper end of what is said of it) where the target is in view [m]."""
    q = postures_in_view(r.fit, np.random.default_rng(1))
    return true_error(s, r.fit, q), r.claim.in_view.interval[2]


@pytest.mark.slow
def test_a_few_tracker_points_give_the_length_that_images_lack() -> None:
    """A sheet that nobody measured, 0.8 % too large: cannot tell; with fifteen points of a ball the arm is better by
    several times, said so, and the sheet's size is found.
    """
    s = scene(12, False, count=15, length_std=3e-3, angle_std=4e-3, printed=1.008 * BOARD.points)
    alone, mixed = solved(s), solved(s, beside=tracked(s))
    assert alone.claim.decision.word == CANNOT_TELL
    assert mixed.claim.decision.word == APPLY
    assert mixed.claim.metric == ("readings of point in tracker",)
    off, said = errors(s, mixed)
    assert off < said < errors(s, alone)[1]
    assert off < min(1e-3, 0.5 * errors(s, alone)[0])
    assert mixed.fit.state.shape[:2] == pytest.approx(0.008, abs=5e-4)
    assert mixed.fit.sizes.other == pytest.approx(5e-5, rel=1.0)


@pytest.mark.slow
def test_wrong_readings_beside_images_are_left_out() -> None:
    s = scene(12, True, count=15, board=MEASURED)
    good = tracked(s)
    reading = good.samples.reading.copy()
    reading[4] += [0.0, 0.02, 0.0]
    r = solved(s, beside=replace(good, samples=replace(good.samples, reading=reading)))
    assert r.fit.cameras.beside is not None
    assert len(r.fit.cameras.beside.samples) == 14
    assert errors(s, r)[0] < 1e-3


def test_too_few_readings_beside_images_are_refused() -> None:
    s = scene(12, True, count=15)
    with pytest.raises(NotEnoughData, match="at least 3"):
        tracked(s, count=2)


@pytest.mark.slow
def test_derivatives_of_rows_beside_images() -> None:
    s = scene(12, True, count=8)
    table, arm = start(s)
    cameras = replace(alone(table, arm, common_prior(s.lens, s.board.scale), s.lens), beside=tracked(s, count=4))
    x = cameras.expected.start
    at = x + 1e-3 * np.random.default_rng(0).normal(size=len(x))
    rows = cameras.equations(at).beside
    assert rows is not None
    own = np.arange(len(cameras.first.free), len(x))
    of_arm = np.r_[np.arange(cameras.first.poses.count), own]
    assert (np.delete(rows.J, of_arm, axis=1) == 0.0).all()

    def predicted(v: Array) -> Array:
        there = cameras.equations(v).beside
        assert there is not None
        return -there.residual

    # residuals are taken as seen from the root, which a frame's own turn moves: its shifts are enough here
    assert cameras.beside is not None
    shifts = [not p.name.startswith("frame ") for p in cameras.beside.own]
    free = np.r_[np.arange(cameras.first.poses.count), own[shifts]]

    def partly(v: Array) -> Array:
        whole = at.copy()
        whole[free] = v
        return predicted(whole)

    assert_jacobian(partly, rows.J[:, free], at[free], tolerance=1e-6)


def with_motion(s: CameraScene, true_q: Array) -> CameraScene:
    """The same images of an arm whose joints stand at true_q where they report q."""
    T = s.world.tool_in_tracker(true_q + 3e-5 * np.random.default_rng(3).standard_normal(true_q.shape))
    seen = views(np.random.default_rng(4), se3.inverse(T) if s.on_tip else T, board=s.board)
    keep = [i for i, v in enumerate(seen) if len(v) >= 8]
    return replace(s, q=s.q[keep], T=T[keep], views=[seen[i] for i in keep])


@pytest.mark.slow
def test_a_gear_is_found_from_corners_alone() -> None:
    """Seven waves a turn of 2 mrad in joint 3: named with its period and size, and the arm is better for it."""
    s = scene(41, False, count=30, length_std=2e-3, angle_std=3e-3, board=MEASURED)
    q = s.q.copy()
    q[:, 2] += 2e-3 * np.sin(7.0 * q[:, 2] + 0.3)
    r = solved(with_motion(s, q))
    (cause,) = r.evidence.causes
    assert (cause.effect.family, cause.effect.place) == ("gear_harmonic", s.chain.names[2])
    assert cause.effect.shape.settings["cycles"] == pytest.approx(7.0, abs=0.05)
    assert np.hypot(*cause.effect.amplitudes) == pytest.approx(2e-3, rel=0.1)
    assert cause.p_value < 1e-4
    assert r.fit.sizes.joint < 0.2 * r.geometric.sizes.joint
    assert r.claim.decision.word == APPLY


@pytest.mark.slow
def test_a_ratio_and_backlash_are_found_from_corners() -> None:
    """0.2 % in joint 4; and 1 mrad of play in joint 1, whose side the way it came tells."""
    s = scene(41, True, count=30, length_std=2e-3, angle_std=3e-3, board=MEASURED)
    came = np.random.default_rng(5).choice([-1.0, 1.0], s.q.shape)
    q = s.q.copy()
    q[:, 3] *= 1.002
    q[:, 0] += 1e-3 * came[:, 0]
    moved = with_motion(s, q)
    r = solved(moved, moments=ImageMoments(approach=came[: len(moved.q)]))
    found = {(c.effect.family, c.effect.place): c.effect for c in r.evidence.causes}
    ratio, play = found["gear_ratio", s.chain.names[3]], found["backlash", s.chain.names[0]]
    assert ratio.values == pytest.approx(0.002, abs=2e-4)
    assert np.abs(play.values) == pytest.approx(1e-3, rel=0.2)


@pytest.mark.slow
def test_a_clean_arm_has_no_effects() -> None:
    s = scene(61, True, count=25, length_std=3e-3, angle_std=4e-3, board=MEASURED)
    r = solved(s)
    assert not r.evidence.causes
    assert r.evidence.left is None
