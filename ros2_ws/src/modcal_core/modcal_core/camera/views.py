"""Postures at which a target is in view, and what the images of a calibration leave open of lens and arm."""

from __future__ import annotations

import numpy as np

from modcal_core.camera.corners import CornerTable
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import Mounting
from modcal_core.geometry import Array, se3
from modcal_core.robots import Chain

_POSTURES = 150  # which give the RMS over a range of joints to a few per cent
_TRIES = 20  # postures drawn for each that shows the target
_MIN_SEEN = 20  # postures that show the target, below which those of the images are taken
# Of a body, between two lines of sight: markers are read up to some 60° off square, so turned by half of that most of
# those that one image shows are still read.
_SAME_SIDE = float(np.radians(30.0))
_INSIDE = 0.6  # of the corners, inside the image, count as a target that is in view
_TILT = np.radians(20.0)  # below, the focal length is told by perspective of second order only
_DISTANCES = 1.3  # farthest over nearest
_COVERED = 0.4  # of the image, in a grid of eight by eight
_GRID = 8  # cells a side
_JOINT, _SLIDE = np.radians(20.0), 0.05  # range of a joint that shows what its axis does, rad and m


def postures_in_view(fit: CameraFit, rng: np.random.Generator) -> tuple[Array, bool]:
    """(postures (M, n) within the images' joint ranges that show the target, whether there are enough of them).

    Where too few do, those of the images themselves, and what lies between neighbours among them.
    """
    q = fit.poses.q
    low, high = q.min(axis=0), q.max(axis=0)
    tried = rng.uniform(low, high, (_TRIES * _POSTURES, q.shape[1]))
    good = tried[in_view(fit, tried)][:_POSTURES]
    if len(good) >= _MIN_SEEN:
        return good, True
    a, b = rng.integers(len(q), size=(2, _POSTURES))
    mixed = q[a] + rng.uniform(0.0, 1.0, (_POSTURES, 1)) * (q[b] - q[a])
    mixed = np.concatenate([q, mixed[in_view(fit, mixed)]])
    return mixed[:_POSTURES], False


def postures_anywhere(chain: Chain, rng: np.random.Generator) -> Array:
    """Postures (M, n) anywhere within the joint limits; a full turn, or ±0.5 m, where there are none."""
    span = np.where(chain.revolute, np.pi, 0.5)
    low = np.where(np.isfinite(chain.lower), chain.lower, -span)
    high = np.where(np.isfinite(chain.upper), chain.upper, span)
    return rng.uniform(low, high, (_POSTURES, chain.n))


def in_view(fit: CameraFit, q: Array) -> np.ndarray:
    """Whether the camera sees the front of the target at these postures (M, n), (M,) bool."""
    at = fit.poses.at_postures(q)
    T = at.seen(at.tool_at(fit.state.values))
    points = fit.table.points[np.unique(fit.table.ids, return_index=True)[1]]  # that any image shows
    X, inside = inside_image(fit.state.lens, T, points)
    if fit.table.places:
        return np.asarray((inside.mean(axis=1) >= _INSIDE) & _seen_from_there(fit, T, points.mean(axis=0)))
    # the side that the images show
    side = np.einsum("mi,mi->m", T[:, :3, 2], X.mean(axis=1))
    seen = fit.poses.seen(fit.poses.tool_at(fit.state.values))
    front = np.sign(np.median(np.einsum("mi,mi->m", seen[:, :3, 2], seen[:, :3, 3])))
    return np.asarray((inside.mean(axis=1) >= _INSIDE) & (side * front > 0.0))


def inside_image(lens: Lens, T: Array, points: Array, edge_px: float = 0.0) -> tuple[Array, np.ndarray]:
    """(points (C, 3) of the target at T_camera_target (M, 4, 4) as the camera has them, (M, C, 3); whether they are so
    far from the image's edge inside it, (M, C)).
    """
    X = np.einsum("mij,cj->mci", T[:, :3, :3], points) + T[:, None, :3, 3]
    ahead = X[:, :, 2] > 1e-3
    pixels = lens.project(np.where(ahead[:, :, None], X, [0.0, 0.0, 1.0]))
    return X, ahead & ((pixels >= edge_px) & (pixels < np.array(lens.size) - edge_px)).all(axis=2)


def _seen_from_there(fit: CameraFit, T: Array, middle: Array) -> np.ndarray:
    """Whether images show a body from about where the camera is at T_camera_target (M, 4, 4), (M,) bool."""

    def sides(poses: Array) -> Array:
        back = se3.inverse(poses)[:, :3, 3] - middle
        return np.asarray(back / np.linalg.norm(back, axis=1, keepdims=True))

    seen = sides(fit.poses.seen(fit.poses.tool_at(fit.state.values)))
    return np.asarray((sides(T) @ seen.T).max(axis=1) > np.cos(_SAME_SIDE))


def weak_directions(fit: CameraFit, mounting: Mounting) -> tuple[str, ...]:
    """What these images leave open, each with what to do, in sentences."""
    out = []
    T, _ = fit.poses.tool_motions(fit.state.values, fit.state.offset_s)
    seen = fit.poses.seen(T)
    centre = fit.table.points.mean(axis=0)
    tilts, away = tilt_and_distance(seen, centre)
    tilt = float(tilts.max())
    if tilt < _TILT and not fit.table.places:
        out.append(
            f"The target was never tilted by more than {np.degrees(tilt):.0f}°: focal length and distance cannot be "
            "told apart. Take images with 20° to 45° of tilt."
        )
    if away.max() < _DISTANCES * away.min():
        out.append(
            f"All images are from {away.min():.2f} to {away.max():.2f} m: the distance and the lens go together. "
            "Take some from half as far, or twice as far."
        )
    if (share := covered(fit.table, fit.state.lens.size)) < _COVERED:
        out.append(
            f"Corners cover {100.0 * share:.0f} % of the image: the lens is not known at its edges. "
            "Bring the target into every corner of the image."
        )
    if mounting.one_axis:
        turns = np.degrees(mounting.turns)
        out.append(
            f"The arm turned its tip about one axis only (RMS {turns[0]:.0f}°, across it {turns[1]:.1f}°): where "
            "camera and target are along this axis is open. Turn the wrist about a second axis."
        )
    chain = fit.poses.model.serial
    for name, low, high, turning in zip(
        chain.names, fit.poses.q.min(0), fit.poses.q.max(0), chain.revolute, strict=True
    ):
        if high - low < (_JOINT if turning else _SLIDE):
            moved = f"{np.degrees(high - low):.0f}°" if turning else f"{1e3 * (high - low):.0f} mm"
            out.append(f"Joint {name} moved by {moved} only: its axis is known from the drawing.")
    return tuple(out)


def tilt_and_distance(seen: Array, centre: Array) -> tuple[Array, Array]:
    """(tilt of the sheet against the line of sight [rad], its distance [m]) of T_camera_target (N, 4, 4), (N,) each."""
    at = se3.apply(seen, centre)
    away = np.linalg.norm(at, axis=1)
    cosine = np.abs(np.einsum("ni,ni->n", seen[:, :3, 2], at)) / np.maximum(away, 1e-9)
    return np.arccos(np.clip(cosine, 0.0, 1.0)), away


def covered(table: CornerTable, size: tuple[int, int]) -> float:
    """Share of the image's cells, eight by eight, that hold a corner of some image."""
    cell = np.clip((table.pixels * _GRID / np.array(size)).astype(int), 0, _GRID - 1)
    return len(np.unique(cell[:, 0] * _GRID + cell[:, 1])) / _GRID**2
