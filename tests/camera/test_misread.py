"""What is said of points of a body that were left out: misread ones, and markers that are not as their file says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from camera.bodies import Faults, body_scene, icosahedron, measured

from modcal_core.camera.bundle import BoardView
from modcal_core.camera.corners import COMMON, CornerTable
from modcal_core.camera.prepared import far_markers, fitted, prepare_images, together
from modcal_core.camera.solve import left_out_points
from modcal_core.geometry import so3
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
@pytest.mark.parametrize("corners", [False, True])
def test_a_marker_far_from_where_the_others_have_it(corners: bool) -> None:
    """The body's frame is that of all markers together: one an inch away moves all others off by millimetres."""
    s = body_scene(11, 40, 1, Faults(misread=0.0, late=0), corners, drawing=measured(icosahedron()))
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
