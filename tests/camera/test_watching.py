"""A moved camera, board or arm, told apart from the images that come in while the robot works."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from camera.boards import views
from camera.scenes import CameraScene, scene
from camera.test_camera_fit import MEASURED, solved

from modcal_core.camera.solve import CameraSolution
from modcal_core.camera.views import BoardView
from modcal_core.camera.watching import CameraWatch, Moved
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

NOTHING = np.zeros(6)


@cache
def calibrated(on_tip: bool) -> tuple[CameraScene, CameraSolution]:
    s = scene(8, on_tip, count=25, board=MEASURED)
    return s, solved(s)


def later(on_tip: bool, seed: int, world: Array = NOTHING, tip: Array = NOTHING, zero: tuple[int, float] = (0, 0.0)):  # type: ignore[no-untyped-def]
    """(postures, views) of ten more images, after a half was moved or a joint slipped."""
    s, _ = calibrated(on_tip)
    rng = np.random.default_rng(seed)
    q = s.q[rng.permutation(len(s.q))[:10]] + 0.03 * rng.standard_normal((10, s.chain.n))
    true = q + 5e-5 * rng.standard_normal(q.shape)
    true[:, zero[0]] += zero[1]
    T = se3.exp(world) @ s.truth(true) @ se3.exp(tip)
    seen = views(rng, se3.inverse(T) if on_tip else T, board=s.board)
    return [(p, replace(v, stamp=float(i))) for i, (p, v) in enumerate(zip(q, seen, strict=True)) if len(v) >= 8]


def watched(on_tip: bool, *parts: list[tuple[Array, BoardView]]) -> list[Moved | None]:
    s, r = calibrated(on_tip)
    watch = CameraWatch(r.fit, s.board)
    return [watch.image(v, q) for part in parts for q, v in part]


# a shift of 2 mm or a turn of 0.2° of either half; the world's about where the tool is
SMALL = {
    "shift": np.array([0.0, 2e-3, 0.0, 0.0, 0.0, 0.0]),
    "turn": np.array([0.0, 0.0, 0.0, 0.0, np.radians(0.2), 0.0]),
}


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
@pytest.mark.parametrize("what", ["world", "tip"])
@pytest.mark.parametrize("size", ["shift", "turn"])
def test_a_small_move_is_named_within_five_images(on_tip: bool, what: str, size: str) -> None:
    before, after = later(on_tip, 1), later(on_tip, 2, **{what: SMALL[size]})
    said = watched(on_tip, before, after)
    assert said[: len(before)] == [None] * len(before)
    five = said[len(before) : len(before) + 5]
    found = [one for one in five if one is not None]
    assert found
    expected = "target" if on_tip == (what == "world") else "camera"
    assert found[-1].what == expected
    if size == "shift":
        assert found[-1].shift_m == pytest.approx(2e-3, rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_a_joint_that_slipped_is_the_arm(on_tip: bool) -> None:
    """0.2° in joint 3, which neither half can look like for long."""
    before, after = later(on_tip, 3), later(on_tip, 4, zero=(2, np.radians(0.2)))
    found = [one for one in watched(on_tip, before, after)[len(before) :] if one is not None]
    assert found
    assert "joint panda_joint3" in found[-1].what
    assert found[-1].turn_rad == pytest.approx(np.radians(0.2), rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_nothing_is_said_of_a_cell_that_stands(on_tip: bool) -> None:
    parts = [later(on_tip, seed) for seed in range(10, 20)]
    assert watched(on_tip, *parts) == [None] * sum(map(len, parts))


@pytest.mark.slow
def test_one_misread_image_is_no_move() -> None:
    before, wrong, after = later(True, 5), later(True, 6, world=10.0 * SMALL["shift"])[:1], later(True, 7)
    said = watched(True, before, wrong, after)
    assert said == [None] * len(said)
