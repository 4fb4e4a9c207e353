"""Lens, camera and body to begin with, from all images of a body and the flange poses at which they were taken.

A body is small beside its distance, and its markers are not where they are drawn, so single images hardly tell the
focal length; the arm's motion does. The sightings of single points from all postures show camera, lens and body
together; where they are too few, the focal length is taken at which the body's poses by single images meet the
flange's best. Of what is found either way, the one counts that corners are nearer to.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.body_pnp import body_poses, images_with_pose
from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.corners import CornerTable, residuals
from modcal_core.camera.few_points import Resection, resection
from modcal_core.camera.lens import FISHEYE, Lens
from modcal_core.camera.mounting import MIN_VIEWS, Mounting, find_mounting, mounting_misfit, relative_turns
from modcal_core.camera.target import MARKER_CORNERS
from modcal_core.errors import BadTable, ModcalError, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

_ENOUGH = 8  # images with a pose: twice as many as a mounting needs, so that a misread one is outvoted
_LOOKED_AT = 30  # of these, for time, while the focal length is looked for
_FOCALS = np.geomspace(0.4, 6.0, 17)  # times the image's width: lenses of 100° to 10°
_HALF_ANGLES = np.radians(np.linspace(35.0, 95.0, 13))  # of fisheyes, from the middle to the farther edge
_FINER = np.linspace(0.85, 1.18, 9)  # between one of these and the next
_CLEAR = 2.0  # ratio of the misfits of both mountings, as with poses, and of two orders of corners


@dataclass(frozen=True)
class BodyStart:
    """lens, mounting: to begin with. T_camera_target: of the mounting is by the arm, in every image."""

    lens: Lens
    mounting: Mounting

    def miss_px(self, table: CornerTable) -> float:
        """Median distance of corners from where they should be [px]."""
        off = residuals(table, self.lens, table.unshaped, self.mounting.T_camera_target)
        return float(np.median(np.linalg.norm(off, axis=1)))


def start_of_body(
    table: CornerTable, A: Array, lens: Lens | None, size: tuple[int, int], model: str, on_tip: bool | None
) -> BodyStart:
    """The start of images (N) of a body.

    A: flange poses, (N, 4, 4) [m]. lens: as stated, None where it is to be found. size: of the images [px]. model: of
    the lens. on_tip: the mounting where it is stated. Raises ModcalError for images that do not show it.
    """
    whole = images_with_pose(table)
    starts = _by_points(table, A, lens, size, on_tip)
    if whole.sum() >= _ENOUGH:
        posed, at = table.select(whole), A[whole]
        if lens is None:
            lens = starts[0].lens if starts else _lens_by_arm(posed, at, size, model, on_tip)
        try:
            starts.append(BodyStart(lens, _by_arm(find_mounting(at, body_poses(posed, lens), on_tip), A)))
        except ModcalError:
            if not starts:
                raise
    if not starts:
        said = f"few show four points that tell a pose, and no point is seen often enough among {table.views} images"
        raise NotEnoughData("images", said, "take 25 images or more of the same points, or such as show more points")
    return min(starts, key=lambda start: start.miss_px(table))


def default_lens(size: tuple[int, int], model: str) -> Lens:
    """A lens of a usual angle of view, for what hardly depends on it. size: of the images [px]."""
    return Lens(np.r_[[float(max(size))] * 2, 0.5 * (np.array(size) - 1.0), np.zeros(5)], size, model)


def require_order(table: CornerTable, lens: Lens, target: MarkerBundle) -> None:
    """Raises BadTable where the corners of markers are numbered in another order than the target's file says."""
    whole = images_with_pose(table)
    if not target.turning or whole.sum() < _ENOUGH:
        return
    rows = np.flatnonzero(whole)[: _LOOKED_AT // 2]
    some = table.select(np.isin(np.arange(table.views), rows))
    miss = {}
    for k in range(MARKER_CORNERS):
        for names in (np.roll(target.corners, k), np.roll(target.corners[::-1], k)):
            order = tuple(str(name) for name in names)
            own = target.with_order(order)
            there = replace(some, points=own.points[some.ids])
            miss[order] = float(np.median(body_poses(there, lens).rms))
    best = min(miss, key=lambda order: miss[order])
    if miss[best] * _CLEAR < miss[target.corners]:
        said = f"numbers the corners of markers as {', '.join(target.corners)}; the images show {', '.join(best)}"
        raise BadTable(target.label, said, f"state corner_order: [{', '.join(best)}]")


def _by_arm(mounting: Mounting, A: Array) -> Mounting:
    """The mounting with the poses that it puts the target at in all images, those without a pose among them."""
    T = mounting.T_frame_base @ A @ mounting.T_tip_tool
    return mounting.with_poses(se3.inverse(T) if mounting.camera_on_tip else T)


def _lens_by_arm(table: CornerTable, A: Array, size: tuple[int, int], model: str, on_tip: bool | None) -> Lens:
    """The lens without distortion whose poses of the body meet the flange's best."""
    rows = np.zeros(table.views, bool)
    rows[np.unique(np.linspace(0, table.views - 1, _LOOKED_AT).astype(int))] = True
    table, A = table.select(rows), A[rows]
    middle = 0.5 * (np.array(size) - 1.0)

    def of(focal: float) -> Lens:
        return Lens(np.r_[focal, focal, middle, np.zeros(5)], size, model)

    def miss(focal: float) -> float:
        return mounting_misfit(A, body_poses(table, of(focal)), on_tip)

    tried = 0.5 * max(size) / _HALF_ANGLES if model == FISHEYE else _FOCALS * max(size)
    best = _least(miss, tried)
    return of(_least(miss, best * _FINER))


def _least(miss: Callable[[float], float], tried: Array) -> float:
    return float(min(tried, key=lambda focal: miss(float(focal))))


def _by_points(
    table: CornerTable, A: Array, lens: Lens | None, size: tuple[int, int], on_tip: bool | None
) -> list[BodyStart]:
    """The start from sightings of single points, nothing where they are too few or tell no mounting."""
    if table.views < MIN_VIEWS:
        return []
    ids, point = np.unique(table.ids, return_inverse=True)
    body = np.array([table.points[table.ids == i][0] for i in ids])
    middle = 0.5 * (np.array(size) - 1.0)
    rays = (table.pixels - middle) / max(size) if lens is None else lens.rays(table.pixels)
    found: dict[bool, Resection] = {}
    for carried in (True, False) if on_tip is None else (on_tip,):
        flange = se3.inverse(A) if carried else A
        one = resection(flange[table.view], point, rays, body, lens is not None)
        if one is not None:
            found[carried] = one
    if not found:
        return []
    carried = min(found, key=lambda c: found[c].miss)
    rival = found[not carried].miss / max(found[carried].miss, 1e-12) if len(found) == 2 else np.inf
    if rival < _CLEAR:
        return []
    best = found[carried]
    if lens is None:
        f = best.focal * max(size)
        lens = Lens(np.r_[f, f, middle, np.zeros(5)], size)
    base, tool = best.T_camera_base, best.T_tip_body
    if carried:  # it is the camera that is on the tip: T_camera_tip and T_base_body
        base, tool = se3.inverse(tool), se3.inverse(base)
    away = float(np.median(np.linalg.norm((best.T_camera_base @ (se3.inverse(A) if carried else A))[:, :3, 3], axis=1)))
    misfit = best.miss * away, best.miss
    mounting = Mounting(carried, base, tool, A, *misfit, float(rival), relative_turns(A), np.empty(0))
    return [BodyStart(lens, _by_arm(mounting, A))]
