"""What is said of each image, poses, corners as messages; and a moved camera, board or arm, told apart while it works."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from camera.boards import BOARD, LENS, SIZE, facing, views
from camera.fits import MEASURED, solved
from camera.scenes import CameraScene, scene
from camera.test_several_cameras import OTHER_LENS, looking, on_tripod
from camera.test_several_cameras import solved as solved_by

from modcal_core.camera.bundle import BoardView
from modcal_core.camera.changes import CameraWatch, Moved
from modcal_core.camera.fit import CameraImages
from modcal_core.camera.solve import CameraSolution
from modcal_core.errors import BadRecording
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_msgs_py.images import fill_corners, read_corners
from modcal_msgs_py.layout import message_class
from modcal_nodes.vision.coaching import ENOUGH, Coach
from modcal_nodes.vision.detection import annotated, board_pose

pytestmark = pytest.mark.slow

CENTRE = np.r_[0.5 * np.array(BOARD.size), 0.0]


def at(tilt: tuple[float, float] = (0.0, 0.0), x: float = 0.0, y: float = 0.0, z: float = 0.5) -> Array:
    """A pose of the board, tilted about the image's x and y [deg], its middle at (x, y, z) m."""
    R = so3.exp(np.radians([*tilt, 0.0]))
    return se3.transform(R, np.array([x, y, z]) - R @ CENTRE)


def view(T: Array, seed: int = 0, noise: float = 0.05) -> BoardView:
    return replace(views(np.random.default_rng(seed), T[None], noise)[0], sharpness=2.0)


def shown(coach: Coach, T: Array) -> str:
    """The same view twice: held still."""
    coach.image(view(T, 1))
    return coach.image(view(T, 2))


def test_coaching_asks_for_what_is_missing() -> None:
    coach = Coach(BOARD, SIZE, LENS)
    assert coach.image(None, "shows no target: bring it into view").startswith("no corners: the image shows no target")
    assert "hold still" in coach.image(view(at()))
    assert "1 of 25 views; next: tilt the target left" in coach.image(view(at(), 1))
    assert "hold still" in coach.image(view(at(x=0.02)))
    assert "focus" in coach.image(replace(view(at()), sharpness=5.0))
    # a view like one before does not count
    assert "1 of 25 views" in shown(coach, at())
    for asked, tilt in (("left", (0, -30)), ("right", (0, 30)), ("up", (30, 0)), ("down", (-30, 0))):
        assert coach.missing[0] == f"tilt the target {asked}"
        shown(coach, at(tilt))
    assert coach.missing[0].startswith("nearer or farther")
    shown(coach, at(z=0.9))
    assert "part of the image" in coach.missing[0]
    for x in (-0.25, 0.0, 0.25):
        for y in (-0.12, 0.0, 0.12):
            shown(coach, at((10, 10), x, y, 0.45))
    assert coach.missing == ()
    said = ""
    for angle in np.linspace(-40, 40, ENOUGH):
        said = shown(coach, at((angle, 0.3 * angle), 0.0, 0.0, 0.6))
    assert "enough, calibrate" in said


def test_pose_and_its_covariance(rng: np.random.Generator) -> None:
    """Standard scores of eighty poses are those of six normal numbers."""
    T = facing(rng, 80)
    scores = []
    for one, seen in zip(T, views(rng, T), strict=True):
        found, cov = board_pose(seen, BOARD, LENS)
        off = np.r_[one[:3, 3] - found[:3, 3], so3.log(one[:3, :3] @ found[:3, :3].T)]
        scores.append(off @ np.linalg.solve(cov, off))
    assert np.mean(scores) == pytest.approx(6.0, rel=0.25)


def test_a_pose_that_may_be_its_twin_says_so() -> None:
    """A small board far away, nearly square on: both tilts fit."""
    T = at((4.0, 3.0), z=2.5)
    found, cov = board_pose(view(T, noise=0.3), BOARD, LENS)
    off = so3.log(T[:3, :3] @ found[:3, :3].T)
    assert off @ np.linalg.solve(cov[3:, 3:], off) < 16.0


def test_corners_as_messages() -> None:
    cloud, field = message_class("sensor_msgs/msg/PointCloud2"), message_class("sensor_msgs/msg/PointField")
    time, header = message_class("builtin_interfaces/msg/Time"), message_class("std_msgs/msg/Header")
    empty = cloud(header(time(0, 0), ""), 0, 0, [], False, 0, 0, np.empty(0, np.uint8), True)
    seen = replace(view(at()), stamp=12.25)
    message = fill_corners(empty, field, seen, SIZE, "camera")
    back, size = read_corners(message)
    assert size == SIZE
    assert back.stamp == 12.25
    assert (back.ids == seen.ids).all()
    assert np.abs(back.pixels - seen.pixels).max() < 1e-4
    assert back.cov[0] == pytest.approx(seen.cov[0], rel=1e-5)
    twice = fill_corners(empty, field, replace(seen, ids=np.zeros(len(seen), int)), SIZE, "camera")
    with pytest.raises(BadRecording, match="twice"):
        read_corners(twice)
    astray = fill_corners(empty, field, seen, SIZE, "camera")
    astray.fields[0].offset = 1000
    with pytest.raises(BadRecording, match="bytes"):
        read_corners(astray)
    message.data = message.data[:10]
    with pytest.raises(BadRecording, match="bytes"):
        read_corners(message)
    message.fields = message.fields[:2]
    with pytest.raises(BadRecording, match="board_detector"):
        read_corners(message)


def test_annotated_image_shows_corners_and_words() -> None:
    grey = np.full((SIZE[1], SIZE[0]), 120, np.uint8)
    seen = view(at())
    out = annotated(grey, seen, "24 corners: hold still")
    x, y = np.rint(seen.pixels[0]).astype(int)
    around = out[y - 8 : y + 9, x - 8 : x + 9].astype(int)
    assert (np.ptp(around, axis=2) > 50).any()
    assert (out[-20:] != 120).all(axis=2).any()
    assert (annotated(grey, None, "no corners")[-5, 0] != out[-5, 0]).any()


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


def test_a_joint_that_slipped_is_the_arm() -> None:
    """0.2° in joint 3, which neither half can look like for long."""
    before, after = later(True, 3), later(True, 4, zero=(2, np.radians(0.2)))
    found = [one for one in watched(True, before, after)[len(before) :] if one is not None]
    assert found
    assert "joint panda_joint3" in found[-1].what
    assert found[-1].turn_rad == pytest.approx(np.radians(0.2), rel=0.3)


@pytest.mark.parametrize("on_tip", [True, False])
def test_nothing_is_said_of_a_cell_that_stands(on_tip: bool) -> None:
    parts = [later(on_tip, seed) for seed in range(10, 20)]
    assert watched(on_tip, *parts) == [None] * sum(map(len, parts))


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
