"""Bodies with markers: files, poses, places, in images and bags; one fit of arm, cameras and places; misread points."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera.boards import seen
from camera.bodies import (
    BODY_ON_TIP,
    SIZE,
    BodyScene,
    Faults,
    body_scene,
    bundle_to_data,
    icosahedron,
    measured,
)
from camera.scenes import PANDA, scene
from camera.test_image_bags import GRID, bag_of_tags
from finite_differences import assert_jacobian

from modcal_core.camera.bundle import APRILTAG_ORDER, ARUCO_ORDER, BoardView, MarkerBundle
from modcal_core.camera.corners import COMMON, SHAPE, CornerTable, corner_rows, images_with_pose
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import IN_WORLD, board_poses, require_order
from modcal_core.camera.prepared import far_markers, fitted, prepare_images, together
from modcal_core.camera.solve import CameraProblem, CameraSolution, left_out_points, solve_camera
from modcal_core.camera.target_file import target_from_data
from modcal_core.camera.views import plan_images
from modcal_core.errors import BadTable, ModcalError, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robot import Robot
from modcal_msgs_py.mcap_read import read_recording
from modcal_nodes.vision.bag import read_bag_images
from modcal_nodes.vision.detection import detect

LENS = Lens(np.array([2700.0, 2720.0, 1210.0, 790.0, -0.1, 0.05, 3e-4, -2e-4, 0.0]), SIZE)
BARE = {"modcal_target": 1, "type": "bundle"}


def views_of(
    body: MarkerBundle, T: Array, per_image: int, rng: np.random.Generator, noise: float = 0.0
) -> list[BoardView]:
    """Middles of markers that face the camera, by OpenCV. T: T_camera_body, (N, 4, 4)."""
    out = []
    middles = np.flatnonzero(~body.on_markers()[1].any(axis=1))
    for i, pose in enumerate(T):
        at = se3.apply(pose, body.points[middles])
        out_of_face = body.normals[middles] @ pose[:3, :3].T
        facing = np.flatnonzero(-(at * out_of_face).sum(axis=1) > 0.3 * np.linalg.norm(at, axis=1))
        ids = middles[rng.permutation(facing)[:per_image]]
        exact = seen(pose, body.points[ids], LENS)
        pixels = exact + noise * rng.standard_normal(exact.shape)
        out.append(BoardView(f"{i}", ids, pixels, np.tile(0.01 * np.eye(2), (len(ids), 1, 1))))
    return out


def somewhere(rng: np.random.Generator, count: int) -> Array:
    """Poses T_camera_body, turned anyhow."""
    at = np.c_[rng.uniform(-0.3, 0.3, (count, 2)), rng.uniform(1.0, 2.0, count)]
    return se3.transform(so3.exp(rng.uniform(-2.0, 2.0, (count, 3))), at)


@cache
def cell(corners: bool = False) -> BodyScene:
    """Two cameras, 70 postures, an arm 1 mm and 2 mrad a body off."""
    return body_scene(3, 70, 2, Faults(misread=0.015), corners, drawing=measured(icosahedron()))


def solve(s: BodyScene) -> CameraSolution:
    return solve_camera(CameraProblem(s.chain, s.images, look_for_effects=False), np.random.default_rng(3))


def arm_error(s: BodyScene, fit: CameraFit) -> float:
    """RMS of the last link's place, the frame put where that is least [m]: of the arm, by MuJoCo."""
    q = np.random.default_rng(9).uniform(s.images[0].q.min(0), s.images[0].q.max(0), (200, 7))
    tool = se3.inverse(fit.poses.model_at(fit.state.values).T_tip_tool)[:3, 3]
    a = se3.apply(fit.poses.at_postures(q).tool_at(fit.state.values), tool)
    b = se3.apply(s.tip(q) @ BODY_ON_TIP @ s.true_body(), tool)
    U, _, Vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    gap = (a - a.mean(0)) @ U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt - (b - b.mean(0))
    return float(np.sqrt((gap**2).sum(1).mean()))


# ---------------------------------------------------------------- files


def test_a_marker_lies_as_its_pose_says() -> None:
    """On the face x = 0.1 of a block, its right the block's y, its up the block's z: seen from outside, along −x."""
    marker = {"id": 4, "size_m": 0.04, "xyz": [0.1, 0.0, 0.02], "rpy": [np.pi / 2, 0.0, np.pi / 2]}
    body = target_from_data({**BARE, "markers": [marker], "points": [{"id": 9, "xyz": [0.0, 0.0, 0.3]}]})
    upper_left = body.point(4, 0)
    assert upper_left is not None
    assert np.allclose(body.points[upper_left], [0.1, -0.02, 0.04])
    assert np.allclose(body.normals[upper_left], [1.0, 0.0, 0.0])
    assert np.allclose(body.points[body.point(4, None)], [0.1, 0.0, 0.02])  # type: ignore[index]
    assert np.allclose(body.points[body.point(9, None)], [0.0, 0.0, 0.3])  # type: ignore[index]
    assert body.point(9, 1) is body.point(5, None) is None
    assert np.allclose(replace(body, corners=APRILTAG_ORDER).points[upper_left], [0.1, -0.02, 0.0])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"markers": []}, "has 0 markers"),
        ({"points": [{"id": 1, "xyz": [0, 0, 0]}, {"id": 1, "xyz": [0, 0, 1]}]}, "has marker 1 twice"),
        ({"points": [{"id": 1, "xyz": [0, 0, 300]}]}, "reaches beyond 10 m"),
        ({"corner_order": ["ul", "ul", "lr", "ll"]}, "name each of ul, ur, lr, ll once"),
        ({"tolerance_m": 0.0}, "tolerance that is none"),
        ({"markers": [{"id": 1, "size_m": 0.04, "xyz": [0, 0, 0], "quaternion": [1, 1, 0, 0]}]}, "quaternion of length"),
        ({"markers": [{"id": 1, "size_m": -1, "xyz": [0, 0, 0]}]}, "side is no length"),
        ({"markers": [{"id": 1, "xyz": [0, 0, 0]}]}, "cannot be read"),
    ],
)  # fmt: skip
def test_bodies_that_are_none(change: dict[str, object], said: str) -> None:
    sound = {**BARE, "points": [{"id": 1, "xyz": [0, 0, 0]}]}
    target_from_data(sound, "x")
    with pytest.raises(BadTable, match=said):
        target_from_data({**(BARE if "markers" in change else sound), **change}, "x")


# ---------------------------------------------------------------- places


@pytest.mark.parametrize("turning", [False, True])
def test_places_say_nothing_of_the_body_as_a_whole(turning: bool) -> None:
    """Any rigid motion of all markers costs what is held, no more and no less, whatever the tolerances; all else costs
    its square in units of these.
    """
    rng = np.random.default_rng(0)
    body = replace(measured(icosahedron()), turning=turning)
    prior = body.place_prior()
    v = body.values_of_place
    a, b = rng.normal(size=(2, 3))
    rigid = np.zeros((20, v))
    rigid[:, :3] = a + np.cross(b, body.middles - body.middles.mean(axis=0))
    if turning:
        rigid[:, 3:] = b
    x = rigid.ravel()
    assert abs(x @ prior.apart @ x) < 1e-9 * (x @ x) * np.abs(prior.apart).max()
    values = np.linalg.eigvalsh(prior.information(1.0))
    assert values[0] > 0.0  # full rank
    white = np.linalg.eigvalsh(prior.apart)
    assert (white > 1e-6 * white[-1]).sum() == 20 * v - 6
    y = 1e-3 * rng.normal(size=20 * v)
    assert np.isclose(y @ (prior.information(0.5) - prior.held) @ y, 4.0 * y @ prior.apart @ y)
    # one marker off along its normal, far from the others, costs about its square over the tolerance's
    one = np.zeros((20, v))
    one[0, :3] = 1e-3 * body.normals[0]
    assert 0.7 * 25.0 < one.ravel() @ prior.apart @ one.ravel() < 25.0


@pytest.mark.parametrize("turning", [False, True])
def test_derivatives_by_places_and_size(turning: bool) -> None:
    rng = np.random.default_rng(1)
    body = replace(icosahedron(), turning=turning)
    T = somewhere(rng, 3)
    ids = np.sort(rng.permutation(len(body.points))[:12])
    views = [BoardView(f"{i}", ids, np.zeros((12, 2)), np.tile(np.eye(2), (12, 1, 1))) for i in range(3)]
    table = CornerTable.of(views, body)
    shape = 1e-3 * rng.normal(size=SHAPE + table.places * table.markers)
    rows = corner_rows(table, LENS, shape, T)
    columns = np.r_[9 : 9 + SHAPE, COMMON : rows.by_common.shape[2]]

    def pixels(x: Array) -> Array:
        return (table.pixels - corner_rows(table, LENS, x, T).pixels).ravel()

    # a turn about a marker's middle is of first order
    assert_jacobian(pixels, rows.by_common[:, :, columns].reshape(72, -1), shape, tolerance=1e-6)


# ---------------------------------------------------------------- poses


@pytest.mark.parametrize("per_image", [4, 8])
def test_poses_of_a_body_are_those_of_opencv(per_image: int) -> None:
    rng = np.random.default_rng(2)
    T = somewhere(rng, 40)
    table = CornerTable.of(views_of(icosahedron(), T, per_image, rng), icosahedron())
    whole = images_with_pose(table)
    assert whole.mean() > 0.9
    found = board_poses(table.select(whole), LENS)
    gap = np.linalg.norm(se3.error(found.T[:, 0], T[whole]), axis=1)
    assert np.mean(gap < 1e-6) >= (0.9 if per_image == 4 else 1.0)  # four points have a second pose at times
    assert found.rms[gap < 1e-6].max() < 1e-6


def test_corners_in_another_order_are_named() -> None:
    s = cell(corners=True)
    (first, *_) = together(s.images)
    table = CornerTable.of(first.views, first.target)
    require_order(table, s.lenses[0], first.target)
    other = replace(first.target, corners=APRILTAG_ORDER)
    wrong = CornerTable.of(first.views, other)
    with pytest.raises(BadTable, match=r"state corner_order: \[ul, ur, lr, ll\]"):
        require_order(wrong, s.lenses[0], other)
    assert first.target.corners == ARUCO_ORDER


# ---------------------------------------------------------------- the fit


@pytest.mark.slow
def test_an_arm_by_two_cameras_and_a_body_glued_by_hand() -> None:
    """Nothing is known of lenses, cameras or body but the drawing; markers are 0.7 mm off it, some misread."""
    s = cell(corners=True)
    r = solve(s)
    assert (r.camera.mounting.label, r.claim.decision.word) == (IN_WORLD, "apply")
    assert arm_error(s, r.fit) < 3e-4 < 1.2e-3 < arm_error(s, r.nominal)
    late = {f"{i}" for i in np.flatnonzero((s.q != s.as_moved).any(axis=1))}
    assert set(r.camera.left_out) == late & {v.name for v in s.images[0].views}
    assert set(r.fit.cameras.every[1].left_out) == late & {v.name for v in s.images[1].views}
    # where its markers are, to a sixth of how far they are off
    places = r.fit.state.shape[SHAPE:].reshape(20, -1)
    B = s.true_body()
    true = se3.apply(se3.inverse(B), s.glued[:, :3, 3]) - s.drawing.middles
    size = r.fit.state.shape[0] * (s.drawing.middles - s.drawing.middles.mean(axis=0))
    gap = places[:, :3] + size - true
    assert np.sqrt((gap**2).sum(1).mean()) < np.sqrt((true**2).sum(1).mean()) / 3.0
    std = r.fit.std[0][-places.size :].reshape(20, -1)[:, :3]
    z = (places[:, :3] - true)[:, 0] / std[:, 0]
    assert np.median(np.abs(z)) < 2.0
    # both cameras, from nothing
    second = r.fit.states[1]
    for lens, true_lens in ((r.fit.state.lens, s.lenses[0]), (second.lens, s.lenses[1])):
        assert np.abs(lens.values - true_lens.values)[:4].max() < 12.0
    assert (second.shape == r.fit.state.shape).all()
    assert r.fit.rms_px[0] < 0.3


@pytest.mark.slow
def test_a_size_that_nobody_states_is_no_length() -> None:
    s = cell()
    drawing = icosahedron()
    r = solve(replace(s, images=(replace(s.images[0], target=drawing),)))
    assert r.claim.decision.word == "cannot tell"
    assert "size_tolerance" in r.claim.decision.because[0]
    assert r.claim.metric == ()


def test_too_little_of_a_body_is_refused() -> None:
    s = cell()
    two = np.array([s.drawing.point(number, None) for number in (1, 2)])
    views = [v.select(np.isin(v.ids, two)) for v in s.images[0].views]
    with pytest.raises(ModcalError, match="at least 3"):
        solve(replace(s, images=(replace(s.images[0], views=views),)))
    few = [v.select(np.arange(len(v)) < 2) for v in s.images[0].views[:8]]
    with pytest.raises(NotEnoughData, match="show four points"):
        solve(replace(s, images=(replace(s.images[0], views=few, q=s.images[0].q[:8]),)))


def test_the_next_images_of_a_body_show_some_markers_and_tell_the_arm() -> None:
    """Planned for the arm by itself; each shows markers whose faces look at the camera, as the scene has it."""
    s = body_scene(3, 30, 1, corners=True, drawing=measured(icosahedron()))
    solution = solve(s)
    plan = plan_images(solution.fit, solution.camera.given.target, 4, np.random.default_rng(2))
    assert (np.diff(plan.expected_m) < 0.0).all()
    assert plan.expected_m[0] == pytest.approx(solution.claim.alone.interval[0], rel=0.5)
    # as the scene has them: faces look at the camera
    T = se3.inverse(s.cameras[0]) @ s.tip(plan.q) @ BODY_ON_TIP
    faces = T[:, None] @ s.glued
    away = faces[:, :, :3, 3] / np.linalg.norm(faces[:, :, :3, 3], axis=2, keepdims=True)
    looks = (-np.einsum("mki,mki->mk", faces[:, :, :3, 2], away) > np.cos(np.radians(50.0))).sum(axis=1)
    assert (looks >= 1).all()


BODY = replace(icosahedron(), turning=True)
IMAGES = 60


def table(rng: np.random.Generator) -> CornerTable:
    """Four markers' corners in each of sixty images."""
    views = []
    for i in range(IMAGES):
        markers = rng.choice(len(BODY.markers), 4, replace=False)
        ids = np.concatenate([5 * k + np.arange(4) for k in markers])
        views.append(BoardView(f"{i}", ids, np.zeros((16, 2)), np.tile(np.eye(2), (16, 1, 1))))
    return CornerTable.of(views, BODY)


def without(corners: CornerTable, out: Array) -> CornerTable:
    return replace(corners, weight=np.where(out, 0.0, 1.0))


def test_misread_points_are_said_beyond_what_a_verdict_passes_over(rng: np.random.Generator) -> None:
    corners = table(rng)
    chance = rng.permutation(len(corners)) / len(corners)
    few = left_out_points([("", without(corners, chance < 0.04))], BODY)
    assert few == ((), ())
    some = left_out_points([("", without(corners, chance < 0.08)), (" of right", corners)], BODY)
    assert some == ((), ("8 % of the points fit no body of the stated form, and are left out.",))
    many = left_out_points([("", corners), (" of right", without(corners, chance < 0.3))], BODY)
    assert many[0][0].startswith("30 % of the points of right fit no body of the stated form")


def test_a_marker_most_of_whose_points_are_out_is_named(rng: np.random.Generator) -> None:
    corners = table(rng)
    against, open_ = left_out_points([("", without(corners, corners.marker == 6))], BODY)
    assert against == ()
    assert "most of those of marker 7: check number" in open_[0]
    against, open_ = left_out_points([("", without(corners, corners.marker < 5))], BODY)
    assert "marker 1, marker 2, marker 3 and others" in against[0]
    assert open_ == ()


@pytest.mark.slow
def test_a_marker_far_from_where_the_others_have_it() -> None:
    """The body's frame is that of all markers together: one an inch away moves all others off by millimetres."""
    s = body_scene(11, 40, 1, Faults(misread=0.0, late=0), True, drawing=measured(icosahedron()))
    (images,) = together((s.images[0],))
    ready = prepare_images(s.chain, images)
    fit = fitted(ready, fixed_sizes=True)
    assert not far_markers(fit).any()
    K, values = fit.table.markers, fit.table.places
    used = np.flatnonzero(np.bincount(fit.table.marker, minlength=K) > 5)
    places = np.zeros((K, values))
    places[:, :3] = 3e-4 * np.random.default_rng(6).standard_normal((K, 3))
    for off_m, far in ((3e-3, []), (0.026, [int(used[2])])):
        there = places.copy()
        there[used[2], 0] = off_m
        middles = images.target.middles
        motion = np.zeros((K, values, 6))
        motion[:, :3, :3] = np.eye(3)
        motion[:, :3, 3:] = -so3.hat(middles)
        motion[:, 3:, 3:] = np.eye(3)[: values - 3]
        by = np.linalg.lstsq(motion.reshape(-1, 6), there.ravel(), rcond=None)[0]
        x = fit.x.copy()
        x[fit.common[COMMON:]] = there.ravel() - motion.reshape(-1, 6) @ by
        assert list(np.flatnonzero(far_markers(replace(fit, x=x)))) == far


WORDS = "DICT_4X4_50"
DRAWN = replace(icosahedron(), dictionary=WORDS)


def picture(numbers: list[int], side: int = 120) -> np.ndarray:
    """Markers beside each other, turned by some degrees, on white."""
    image = np.full((3 * side, 2 * side * len(numbers)), 255, np.uint8)
    for i, number in enumerate(numbers):
        marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), number, side)
        image[side : 2 * side, 2 * side * i + side // 2 : 2 * side * i + side // 2 + side] = marker
    middle = (image.shape[1] / 2.0, image.shape[0] / 2.0)
    turned = cv2.warpAffine(image, cv2.getRotationMatrix2D(middle, 4.0, 1.0), image.shape[::-1], borderValue=255)
    return cv2.GaussianBlur(turned, (0, 0), 0.8)


def test_markers_of_a_body_are_found_one_by_one() -> None:
    """In the order of ArUco: upper left first, clockwise; another's number, and one that stands twice, do not count."""
    view = detect(picture([3, 40, 7, 7]), DRAWN, "a").view
    assert view.ids.tolist() == [DRAWN.point(3, corner) for corner in range(4)]
    x, y = view.pixels.T
    assert x[0] < x[1]
    assert y[1] < y[2]
    assert x[3] < x[2]
    assert np.linalg.norm(np.diff(view.pixels, axis=0), axis=1) == pytest.approx(120.0, abs=2.0)
    assert (np.sqrt(view.cov[:, 0, 0]) < 0.3).all()


def test_what_shows_no_marker_of_the_body_says_so() -> None:
    found = detect(picture([40, 41]), DRAWN, "a")
    assert found.view is None
    assert "no marker of the body" in found.reason
    with pytest.raises(BadTable, match="no dictionary"):
        detect(picture([3]), replace(DRAWN, dictionary=""), "a")


def test_detections_of_tags_in_a_bag_are_of_a_body(tmp_path: Path) -> None:
    """Each by its number; a body of other numbers is not there."""
    s = scene(12, True, count=6, board=GRID)
    bag = bag_of_tags(tmp_path / "tags.mcap", s)
    names = Robot.from_urdf(PANDA, tip="panda_link8").names
    data = bundle_to_data(DRAWN)
    data["markers"] = [{**one, "id": one["id"] + 4} for one in data["markers"][:12]]  # as the grid's: from 5
    body = target_from_data(data)
    found = read_bag_images(bag, read_recording(bag), names, body)
    assert len(found.views) == len(s.views)
    for view, expected in zip(found.views, s.views, strict=True):
        whole = [n for n in np.unique(expected.ids // 4) if (expected.ids // 4 == n).sum() == 4]
        points = [body.point(int(n) + GRID.first_id, corner) for n in whole for corner in range(4)]
        assert view.ids.tolist() == points
        assert view.pixels == pytest.approx(expected.pixels[np.isin(expected.ids // 4, whole)])
    with pytest.raises(NotEnoughData, match="no tag of the target"):
        read_bag_images(
            bag,
            read_recording(bag),
            names,
            replace(body, markers=tuple(replace(m, id=m.id + 100) for m in body.markers)),
        )
