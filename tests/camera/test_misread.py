"""What is said of points of a body that were left out: misread ones, and markers that are not as their file says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from camera.bodies import Faults, body_scene, icosahedron, measured

from modcal_core.camera.corners import CornerTable
from modcal_core.camera.images_of_cameras import begin_fit, only_seen, prepare_images
from modcal_core.camera.misread import left_out_points
from modcal_core.camera.views import BoardView
from modcal_core.geometry.so3 import Array

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
    return corners.with_weight(np.where(out, 0.0, 1.0))


def test_misread_points_are_said_beyond_what_a_verdict_passes_over(rng: np.random.Generator) -> None:
    corners = table(rng)
    chance = rng.permutation(len(corners)) / len(corners)
    few = left_out_points([("", without(corners, chance < 0.04))], BODY)
    assert (few.problems, few.open) == ((), ())
    some = left_out_points([("", without(corners, chance < 0.08)), (" of right", corners)], BODY)
    assert some.problems == ()
    assert some.open == ("8 % of the points are misread, spread over markers and images, and left out.",)
    many = left_out_points([("", corners), (" of right", without(corners, chance < 0.3))], BODY)
    assert many.problems == ("30 % of all points of right fit no body of the stated form.",)


def test_a_marker_most_of_whose_points_are_out_is_named(rng: np.random.Generator) -> None:
    corners = table(rng)
    one = left_out_points([("", without(corners, corners.marker == 6))], BODY)
    assert one.problems == ()
    assert len(one.open) == 1
    assert one.open[0].startswith("Most points of marker 7 are nowhere near their place")
    several = left_out_points([("", without(corners, corners.marker < 5))], BODY)
    assert "marker 1, marker 2, marker 3 and 2 more" in several.open[0]
    assert len(several.problems) == 1
    # seen in too few images to say anything of it
    rare = corners.select(
        np.array([6 in corners.marker[corners.of_view(i)] for i in range(IMAGES)]) | (np.arange(60) < 9)
    )
    seldom = replace(rare, marker=np.where((rare.marker == 6) & (rare.view > 5), 7, rare.marker))
    assert left_out_points([("", without(seldom, seldom.marker == 6))], BODY).open == ()


@pytest.mark.slow
def test_one_sighting_under_another_number_opens_no_places() -> None:
    """Of a marker that is seen once, and that is another's: its place could be anywhere, and all others as uncertain."""
    s = body_scene(
        11, 60, 1, Faults(misread=0.0, late=0, arm_m=3e-4, arm_rad=6e-4), False, drawing=measured(icosahedron())
    )
    one = s.images[0]
    points, counts = np.unique(np.concatenate([v.ids for v in one.views]), return_counts=True)
    rare = int(points[counts.argmin()])
    views = [v.select(v.ids != rare) for v in one.views]
    at = next(i for i, v in enumerate(views) if len(v) > 3 and rare not in one.views[i].ids)
    views[at] = replace(views[at], ids=np.r_[rare, views[at].ids[1:]])
    (images,) = only_seen((replace(one, views=views),))
    fit, ready = begin_fit(prepare_images(s.chain, images), None)
    (row,) = np.flatnonzero(ready.table.ids == images.target.point(s.drawing.markers[rare // 5].id, None))
    assert ready.table.weight[row] == 0.0
    assert ready.table.weight.mean() > 0.98
    assert fit.sizes.places < 2.0
