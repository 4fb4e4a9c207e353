"""A moved camera, board or arm, told apart from the images that come in while the robot works."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from camera.boards import views
from camera.fits import MEASURED, solved
from camera.scenes import CameraScene, scene
from camera.test_several_cameras import OTHER_LENS, looking, on_tripod
from camera.test_several_cameras import solved as solved_by

from modcal_core.camera.bundle import BoardView
from modcal_core.camera.changes import CameraWatch, Moved
from modcal_core.camera.fit import CameraImages
from modcal_core.camera.solve import CameraSolution
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
@pytest.mark.parametrize(
    ("on_tip", "what", "size"),
    [(True, "world", "shift"), (False, "tip", "turn")],
)
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
def test_a_joint_that_slipped_is_the_arm() -> None:
    """0.2° in joint 3, which neither half can look like for long."""
    before, after = later(True, 3), later(True, 4, zero=(2, np.radians(0.2)))
    found = [one for one in watched(True, before, after)[len(before) :] if one is not None]
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


@cache
def of_two() -> tuple[CameraScene, CameraImages, CameraSolution]:
    """Two tripods that look at the board on the arm."""
    s = scene(61, False, count=20, board=MEASURED)
    second = on_tripod(s)
    return s, second, solved_by(s, second)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["", "/second/image", "target"])
def test_of_two_cameras_the_one_that_was_kicked_is_named(what: str) -> None:
    """5 mm of either tripod, or of the board, which both see; the other camera stands as it did."""
    s, second, r = of_two()
    watch = CameraWatch(r.fit, MEASURED)
    rng = np.random.default_rng(9)
    kick = np.array([0.0, 5e-3, 0.0, 0.0, 0.0, 0.0])
    said: list[Moved | None] = []
    q = s.q[rng.permutation(len(s.q))[:12]] + 0.02 * rng.standard_normal((12, s.chain.n))
    T = s.truth(q + 5e-5 * rng.standard_normal(q.shape))  # the board from the first camera
    for k in range(12):
        moved = kick * (k >= 6)
        board = T[k] @ se3.exp(moved * (what == "target"))
        for name, lens, at in (
            ("", s.lens, se3.exp(moved * (what == "")) @ board),
            (second.name, OTHER_LENS, se3.exp(moved * (what == second.name)) @ se3.inverse(looking()) @ board),
        ):
            (view,) = views(rng, at[None], lens=lens, board=MEASURED)
            said.append(watch.image(replace(view, stamp=float(k)), q[k], name))
    assert said[:12] == [None] * 12
    found = [one for one in said[12:22] if one is not None]
    assert found
    expected = {"": "first camera", second.name: f"camera {second.name}", "target": "target"}[what]
    assert found[-1].what == expected
    assert found[-1].shift_m == pytest.approx(5e-3, rel=0.3)
