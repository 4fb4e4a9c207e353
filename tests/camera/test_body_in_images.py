"""A body's markers in images and among detections of tags in a bag: numbers, pixels, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera.bodies import bundle_to_data, icosahedron
from camera.scenes import PANDA, scene
from camera.test_tags_in_bags import GRID, bag_of_tags

from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.target_file import target_from_data
from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.robot import Robot
from modcal_msgs_py.mcap_read import read_recording
from modcal_nodes.vision.bag import read_bag_images
from modcal_nodes.vision.detection import detect

WORDS = "DICT_4X4_50"
BODY = replace(icosahedron(), dictionary=WORDS)


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
    view = detect(picture([3, 40, 7, 7]), BODY, "a").view
    assert view is not None
    assert view.ids.tolist() == [BODY.point(3, corner) for corner in range(4)]
    x, y = view.pixels.T
    assert x[0] < x[1]
    assert y[1] < y[2]
    assert x[3] < x[2]
    assert np.linalg.norm(np.diff(view.pixels, axis=0), axis=1) == pytest.approx(120.0, abs=2.0)
    assert (np.sqrt(view.cov[:, 0, 0]) < 0.3).all()


def test_what_shows_no_marker_of_the_body_says_so() -> None:
    found = detect(picture([40, 41]), BODY, "a")
    assert found.view is None
    assert "no marker of the body" in found.reason
    with pytest.raises(BadTable, match="no dictionary"):
        detect(picture([3]), replace(BODY, dictionary=""), "a")


def test_detections_of_tags_in_a_bag_are_of_a_body(tmp_path: Path) -> None:
    """Each by its number; a body of other numbers is not there."""
    s = scene(12, True, count=6, board=GRID)
    bag = bag_of_tags(tmp_path / "tags.mcap", s)
    names = Robot.from_urdf(PANDA, tip="panda_link8").names
    data = bundle_to_data(BODY)
    data["markers"] = [{**one, "id": one["id"] + 4} for one in data["markers"][:12]]  # as the grid's: from 5
    body = target_from_data(data)
    assert isinstance(body, MarkerBundle)
    found = read_bag_images(bag, read_recording(bag), names, body)
    assert len(found.views) == len(s.views)
    for view, expected in zip(found.views, s.views, strict=True):
        whole = [n for n in np.unique(expected.ids // 4) if (expected.ids // 4 == n).sum() == 4]
        points = [body.point(int(n) + GRID.first_id, corner) for n in whole for corner in range(4)]
        assert view.ids.tolist() == points
        assert view.pixels == pytest.approx(expected.pixels[np.isin(expected.ids // 4, whole)])
    with pytest.raises(NotEnoughData, match="no marker of the body"):
        read_bag_images(
            bag,
            read_recording(bag),
            names,
            replace(body, markers=tuple(replace(m, id=m.id + 100) for m in body.markers)),
        )
