"""Corners of a printed target, or of a body's markers, in an image, by OpenCV, each with a covariance from the image.

A corner q is refined as the point whose directions to its neighbours p lie across their gradients: Σ g gᵀ (q − p) = 0.
Grey noise σ puts noise of σ / √2 into a gradient by central differences, which moves q by H⁻¹ Σ g (n · (p − q)) with
H = Σ g gᵀ; so its covariance is ½ σ² H⁻¹ (Σ |p − q|² g gᵀ) H⁻¹, in the weights that the refinement uses.

Markers on the faces of a body show one by one in whatever way it is turned, and one is enough. A marker's corners are
numbered as its finder has them; whether the target file states that order is found against the arm (body_start).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from modcal_core.camera import (
    APRIL_GRID,
    CHARUCO,
    CHESSBOARD,
    MARKER_CORNERS,
    MIN_CORNERS,
    POSE,
    SHAPE,
    TAG,
    BoardView,
    CornerTable,
    Lens,
    MarkerBundle,
    PrintedTarget,
    board_poses,
    corner_rows,
    enough_corners,
    grams,
)
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3, so3
from modcal_nodes.vision.saddle import fit_board, homography

_MIN_PX, _MAX_PX = 0.02, 2.0  # standard deviation of a corner: what interpolation alone leaves, and a useless one
_PRINT_PX = 0.02  # standard deviation of what printer, paper and the lens's finer form leave beside the noise
_TO_SIGMA = 1.4826  # of a median absolute deviation
_QUANTISED = 0.3  # grey levels, of rounding to whole ones


def grey_noise(grey: np.ndarray) -> float:
    """Standard deviation of the grey values' noise, from second differences across flat parts of the image."""
    f = grey.astype(np.float32)
    d = f[1:-1, 1:-1] * 4.0 - 2.0 * (f[:-2, 1:-1] + f[2:, 1:-1] + f[1:-1, :-2] + f[1:-1, 2:])
    d += f[:-2, :-2] + f[:-2, 2:] + f[2:, :-2] + f[2:, 2:]  # Immerkær's mask, whose weights have norm 6
    return max(float(_TO_SIGMA * np.median(np.abs(d)) / 6.0), _QUANTISED)


def _around(grey: np.ndarray, x: float, y: float, half: int) -> tuple[Array, Array]:
    """(the grey values about a pixel, one more to each side; their gradients (2, K))."""
    patch = cv2.getRectSubPix(grey, (2 * half + 3, 2 * half + 3), (float(x), float(y))).astype(float)
    gx, gy = patch[1:-1, 2:] - patch[1:-1, :-2], patch[2:, 1:-1] - patch[:-2, 1:-1]
    return patch, 0.5 * np.stack([gx.ravel(), gy.ravel()])


def corner_covariance(grey: np.ndarray, pixels: Array, half: int, sigma: float) -> Array:
    """Covariance of corners at pixels (m, 2) refined in windows of this half side, (m, 2, 2) [px²]."""
    offsets = np.arange(-half, half + 1, dtype=float)
    dx, dy = np.meshgrid(offsets, offsets)
    weight = np.exp(-(dx**2 + dy**2) / half**2).ravel()  # as OpenCV's cornerSubPix weighs
    square = (dx**2 + dy**2).ravel()
    out = np.empty((len(pixels), 2, 2))
    for i, (x, y) in enumerate(pixels):
        g = _around(grey, x, y, half)[1]
        H = (weight * g) @ g.T
        M = (weight**2 * square * g) @ g.T
        values, vectors = np.linalg.eigh(H)
        inverse = (vectors / np.maximum(values, 1e-6)) @ vectors.T
        out[i] = 0.5 * sigma**2 * inverse @ M @ inverse
    values, vectors = np.linalg.eigh(out)
    values = np.clip(values, _MIN_PX**2, _MAX_PX**2)
    return np.asarray((vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2))


def edge_width(grey: np.ndarray, pixels: Array, half: int) -> float:
    """Median width of the edges at these corners [px]: contrast over the steepest gradient."""
    widths = []
    for x, y in pixels[:: max(1, len(pixels) // 20)]:
        patch, g = _around(grey, x, y, max(half, 4))
        steepest = float(np.percentile(np.hypot(*g), 98))
        contrast = float(np.percentile(patch, 95) - np.percentile(patch, 5))
        widths.append(contrast / max(steepest, 1e-6))
    return float(np.median(widths))


BLURRED_PX = 6.0  # of an edge from black to white; beyond it a corner's place depends on the light
_MIN_SHARE = 0.3  # of the windows' half side a square may be: a corner needs its own four squares and no others
_MAX_WINDOW, _MIN_WINDOW = 11, 2  # px, half side of the windows in which corners are refined
_ROUGH_PX = 0.1  # by how much a corner is off that looks like no crossing of two edges: half covered, or too small
_SMALLEST_GREY = 12.0  # grey levels between black and white
_FITS_PX, _FITS_SHARE = 4.0, 0.02  # how far corners of one flat sheet are from a homography: lenses bend, by its size
_BOARDS = (CHARUCO, CHESSBOARD)  # of squares, whose corners are crossings of edges
_MIN_QUADS = 4  # markers that the image shows, none of them of the target, before another board is suspected
_ALTERNATES = 0.4  # of the contrast, of the image and of the board, that squares and those beyond its edge differ by
_GAP = 6.0  # square sides between corners of one board and those of another


@dataclass(frozen=True)
class Detection:
    """What an image shows. view: its corners; None where it cannot be used, and reason and remedy say why."""

    view: BoardView | None
    reason: str = ""
    remedy: str = ""


_Corners = tuple[np.ndarray, Array, int]  # ids (m,), pixels (m, 2), half side of the windows of refinement [px]


def detect(grey: np.ndarray, target: PrintedTarget | MarkerBundle, name: str) -> Detection:
    """The corners of the target in a grey image (h, w) of 8 bits. Raises BadTable where no one says which dictionary
    the markers of a body are of.
    """
    if isinstance(target, MarkerBundle) and not target.dictionary:
        remedy = "add dictionary: DICT_4X4_50, or whichever they are of, or give a CSV of corners"
        raise BadTable(target.label, "has no dictionary of markers to look for in images", remedy)
    found = _seen(grey, target)
    if found is None:
        return _why_not(grey, target)
    ids, pixels, half = found
    if (strange := implausible(target, ids, pixels, grey)) is not None:
        return strange
    width = edge_width(grey, pixels, half)
    if width > BLURRED_PX:
        return Detection(None, f"is blurred: edges are {width:.0f} px wide", "hold still, focus, or add light")
    fit = fit_board(grey, target, ids, pixels) if isinstance(target, PrintedTarget) and target.kind in _BOARDS else None
    good = np.zeros(len(ids), bool) if fit is None else fit.good
    cov = np.empty((len(ids), 2, 2))
    if fit is not None:
        pixels, cov = np.where(good[:, None], fit.pixels, pixels), fit.cov + _PRINT_PX**2 * np.eye(2)
    if not good.all():
        rough = _ROUGH_PX if fit is not None else 0.0
        cov[~good] = corner_covariance(grey, pixels[~good], half, grey_noise(grey)) + rough**2 * np.eye(2)
    return Detection(BoardView(name, ids, pixels, cov, width))


def implausible(
    target: PrintedTarget | MarkerBundle, ids: np.ndarray, pixels: Array, grey: np.ndarray | None = None
) -> Detection | None:
    """Why corners (m,) at pixels (m, 2) do not fix the pose of a sheet, or are of another; None where they may be its.

    grey: the image, where it is known.
    """
    if isinstance(target, MarkerBundle):
        return None
    if not enough_corners(target.points[ids]):
        said = f"shows {len(ids)} corners of the target, {MIN_CORNERS} not on one line are needed"
        return Detection(None, said, "bring more of the target into view")
    other = None if grey is None or target.kind != CHESSBOARD else _no_such_board(grey, target, ids, pixels)
    miss = _misfit(target, ids, pixels)
    if other is not None or miss <= max(_FITS_PX, _FITS_SHARE * float(np.ptp(pixels, axis=0).max())):
        return other
    said = f"shows corners that lie {miss:.0f} px off a flat {target.label}"
    return Detection(None, said, "check the target file, show one board only, and keep it flat")


def _seen(grey: np.ndarray, target: PrintedTarget | MarkerBundle) -> _Corners | None:
    """The corners of the target, as its finder has them; None without any."""
    if isinstance(target, MarkerBundle) or target.kind not in _BOARDS:
        found = marker_corners(target, *_markers(grey, target.dictionary))
        if found is None:
            return None
        side = float(np.median(np.linalg.norm(np.diff(found[1].reshape(-1, 4, 2), axis=1), axis=2)))
        return (*found, int(np.clip(0.1 * side, _MIN_WINDOW, _MAX_WINDOW)))
    if target.kind == CHESSBOARD:
        shape = (target.columns - 1, target.rows - 1)
        ok, corners = cv2.findChessboardCornersSB(grey, shape, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not ok:
            return None
        pixels = _turned_right(grey, np.asarray(corners, dtype=float).reshape(-1, 2), shape)
        return _refined(grey, target, np.arange(len(pixels)), pixels)
    for legacy in (False, True):
        corners, ids, _, _ = _charuco(target, legacy).detectBoard(grey)
        if ids is not None and len(ids) >= MIN_CORNERS:
            break
    if ids is None or len(ids) == 0:
        return None
    order = np.argsort(np.asarray(ids).ravel())
    pixels = np.asarray(corners, dtype=float).reshape(-1, 2)[order]
    return _refined(grey, target, np.asarray(ids).ravel()[order], pixels)


def _markers(grey: np.ndarray, name: str) -> tuple[np.ndarray, Array]:
    """(numbers (m,), corners (m, 4, 2)) of the markers of a dictionary that an image shows. Raises BadTable."""
    corners, ids, _ = _marker_detector(name).detectMarkers(grey)
    numbers = np.empty(0, int) if ids is None else np.asarray(ids).ravel()
    return numbers, np.array(corners, dtype=float).reshape(-1, MARKER_CORNERS, 2)


def marker_corners(
    target: PrintedTarget | MarkerBundle, numbers: np.ndarray, quads: Array, either_way: bool = False
) -> tuple[np.ndarray, Array] | None:
    """(ids (4 k,), pixels (4 k, 2)) of those of m markers that are the target's, by their numbers (m,) and corners
    clockwise (m, 4, 2), from whichever corner of a sheet's; None without any.

    A number that stands twice is another's once: of a body nobody knows which, of a sheet there are two. A marker's own
    first corner is a convention of its maker: a grid shows which it is. either_way: also the way round.
    """
    good = np.isfinite(quads).all(axis=(1, 2))
    if isinstance(target, MarkerBundle):
        once = np.isin(numbers, [n for n, times in Counter(numbers.tolist()).items() if times == 1])
        own = [[target.point(int(n), corner) for corner in range(MARKER_CORNERS)] for n in numbers]
        kept = np.flatnonzero(good & once & np.array([None not in points for points in own], dtype=bool))
        ids = np.array([own[k] for k in kept], dtype=int).ravel()
        return (ids, quads[kept].reshape(-1, 2)) if len(ids) else None
    number = numbers - target.first_id
    good &= (number >= 0) & (number < target.columns * target.rows)
    order = np.flatnonzero(good)[np.argsort(number[good])]
    number, quads = number[order], quads[order, ::-1] if target.kind == APRIL_GRID else quads[order]
    if len(order) == 0 or len(np.unique(number)) < len(order):
        return None
    ids = (MARKER_CORNERS * number[:, None] + np.arange(MARKER_CORNERS)).ravel()
    if target.kind == TAG or len(quads) == 1:
        return ids, quads.reshape(-1, 2)
    turns = [np.roll(q, k, axis=1) for q in ((quads, quads[:, ::-1]) if either_way else (quads,)) for k in range(4)]
    best = min(turns, key=lambda q: _misfit(target, ids, q.reshape(-1, 2)))
    return ids, best.reshape(-1, 2)


def _refined(grey: np.ndarray, target: PrintedTarget, ids: np.ndarray, pixels: Array) -> _Corners | None:
    """The saddles of a board's corners to a fraction of a pixel, those at the image's edge left out."""
    half = _MIN_WINDOW
    if enough_corners(target.points[ids]):
        H = homography(target.points[ids, :2], pixels)
        middle = np.r_[target.points[ids, :2].mean(axis=0), 1.0]
        steps = [middle + np.r_[target.square, 0.0, 0.0], middle + np.r_[0.0, target.square, 0.0]]
        at = [(H @ p)[:2] / (H @ p)[2] for p in (middle, *steps)]
        square = min(float(np.linalg.norm(a - at[0])) for a in at[1:])
        margin = 0.5 * (target.square - target.marker) / target.square if target.kind == CHARUCO else 0.5
        if np.isfinite(square):  # else the board is seen edge on
            half = int(np.clip(min(_MIN_SHARE, margin) * square, _MIN_WINDOW, _MAX_WINDOW))
    inside = ((pixels >= half + 1) & (pixels <= np.array(grey.shape)[::-1] - half - 2)).all(axis=1)
    ids, pixels = ids[inside], pixels[inside]
    if len(ids) == 0:
        return None
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)
    start = np.ascontiguousarray(pixels, dtype=np.float32).reshape(-1, 1, 2)
    fine = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), end).reshape(-1, 2).astype(float)
    near = np.linalg.norm(fine - pixels, axis=1) < half
    return (ids[near], fine[near], half) if near.any() else None


def _turned_right(grey: np.ndarray, pixels: Array, shape: tuple[int, int]) -> Array:
    """Corners of a chessboard in the order of its numbers: the square before the first corner is black."""
    grid = pixels.reshape(shape[1], shape[0], 2)

    def first_square(g: Array) -> float:
        at = np.clip(np.rint(g[0, 0] - 0.5 * (g[1, 1] - g[0, 0])), 0, np.array(grey.shape)[::-1] - 1).astype(int)
        beside = np.clip(np.rint(0.5 * (g[0, 0] + g[1, 1]) + (g[0, 0] - g[1, 0])), 0, np.array(grey.shape)[::-1] - 1)
        x, y = beside.astype(int)
        return float(grey[at[1], at[0]]) - float(grey[y, x])

    turned = grid[::-1, ::-1]
    return np.ascontiguousarray(min((grid, turned), key=first_square)).reshape(-1, 2)


def _no_such_board(grey: np.ndarray, target: PrintedTarget, ids: np.ndarray, pixels: Array) -> Detection | None:
    """Why a grid of corners is no chessboard of so many squares: its own do not alternate, or those beyond it do."""
    H = homography(target.points[ids, :2], pixels)
    c, r = target.columns, target.rows
    own = [(i, j) for i in range(c) for j in range(r)]
    inside, black = _greys(grey, H, target, own), np.array([(i + j) % 2 == 0 for i, j in own])
    seen = [values[np.isfinite(values)] for values in (inside[black], inside[~black])]
    contrast = float(np.median(seen[1]) - np.median(seen[0])) if min(map(len, seen)) else 0.0
    if abs(contrast) < _ALTERNATES * float(np.percentile(grey, 99) - np.percentile(grey, 1)):
        return _why_not(grey, target)
    for squares in (*([(i, j) for j in range(r)] for i in (-1, c)), *([(i, j) for i in range(c)] for j in (-1, r))):
        beyond, dark = _greys(grey, H, target, squares), np.array([(i + j) % 2 == 0 for i, j in squares])
        if not (np.isfinite(beyond[dark]).any() and np.isfinite(beyond[~dark]).any()):
            continue
        if float(np.nanmin(beyond[~dark]) - np.nanmax(beyond[dark])) > _ALTERNATES * abs(contrast):
            return Detection(None, f"shows more squares than a {target.label}", "count the squares of the board")
    return None


def _greys(grey: np.ndarray, H: Array, target: PrintedTarget, squares: Sequence[tuple[int, int]]) -> Array:
    """Grey values in the middle of squares (column, row), NaN outside the image."""
    first = target.points[0, :2] - target.square
    at = np.c_[first + (np.array(squares) + 0.5) * target.square, np.ones(len(squares))] @ H.T
    xy = np.rint(at[:, :2] / at[:, 2:]).astype(int)
    ok = ((xy >= 0) & (xy < np.array(grey.shape)[::-1])).all(axis=1)
    out = np.full(len(squares), np.nan)
    out[ok] = grey[xy[ok, 1], xy[ok, 0]]
    return out


def _misfit(target: PrintedTarget, ids: np.ndarray, pixels: Array) -> float:
    """Largest distance of corners from the homography of all of them [px]."""
    if len(ids) < 5:
        return 0.0
    points = target.points[ids, :2]
    H = homography(points, pixels)
    q = np.c_[points, np.ones(len(points))] @ H.T
    return float(np.linalg.norm(q[:, :2] / q[:, 2:] - pixels, axis=1).max())


def _why_not(grey: np.ndarray, target: PrintedTarget | MarkerBundle) -> Detection:
    """Why no corner of the target was found."""
    if isinstance(target, MarkerBundle):
        return Detection(None, "shows no marker of the body", "check the target's numbers, and bring it into view")
    if float(np.percentile(grey, 99) - np.percentile(grey, 1)) < _SMALLEST_GREY:
        return Detection(None, "is of one grey, or nearly", "light the target, and check the exposure")
    if target.kind == CHESSBOARD:
        said = f"shows no whole {target.label}"
        return Detection(None, said, "count the squares, show the whole board, or use a ChArUco board")
    if _seen(np.ascontiguousarray(grey[:, ::-1]), target) is not None:
        return Detection(None, "is mirrored", "turn off mirroring in the camera's driver")
    seen, _ = _markers(grey, target.dictionary)
    if len(seen):
        if len(np.unique(seen)) < len(seen):
            return Detection(None, "shows two boards with the same markers", "show one board only")
        said = f"shows {len(seen)} markers of {target.dictionary}, numbers {seen.min()} to {seen.max()}"
        remedy = f"check the number of squares and the dictionary: a {target.label} has {_marker_count(target)} markers"
        return Detection(None, said, remedy)
    # one dictionary of each size of marker, the largest, whose words include those of the smaller, and AprilTags
    for other in (*(f"DICT_{n}X{n}_1000" for n in (4, 5, 6, 7)), "DICT_APRILTAG_36h11"):
        found = len(_markers(grey, other)[0])
        if found >= _MIN_QUADS and other != target.dictionary:
            said = f"shows {found} markers of {other}, the target has {target.dictionary}"
            return Detection(None, said, "give the target file of this board")
    return Detection(None, "shows no target", "bring the target into view, sharp and lit")


def _marker_count(target: PrintedTarget) -> int:
    return target.columns * target.rows // 2 if target.kind == CHARUCO else target.columns * target.rows


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """The markers' dictionary of this name. Raises BadTable."""
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if number is None:
        raise BadTable(f"dictionary {name[:40]}", "is not known to OpenCV", "use one such as DICT_5X5_100")
    return cv2.aruco.getPredefinedDictionary(number)


@lru_cache(maxsize=16)
def _marker_detector(name: str) -> cv2.aruco.ArucoDetector:
    """What finds the markers of a dictionary of this name. Raises BadTable."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(dictionary(name), parameters)


@lru_cache(maxsize=16)
def _charuco(target: PrintedTarget, legacy: bool) -> cv2.aruco.CharucoDetector:
    return cv2.aruco.CharucoDetector(charuco_board(target, legacy))


def charuco_board(target: PrintedTarget, legacy: bool = False) -> cv2.aruco.CharucoBoard:
    """OpenCV's board of this target. legacy: in the pattern of OpenCV before 4.6. Raises BadTable."""
    words = dictionary(target.dictionary)
    count, available = _marker_count(target), len(words.bytesList)
    if target.first_id + count > available:
        said = f"holds {available} markers, {target.first_id + count} are needed"
        raise BadTable(f"dictionary {target.dictionary}", said, "use a larger one")
    ids = target.first_id + np.arange(count)
    board = cv2.aruco.CharucoBoard((target.columns, target.rows), target.square, target.marker, words, ids)
    board.setLegacyPattern(legacy)
    return board


_TWIN = 9.0  # of the sum of squares: within three standard deviations the pose tilted the other way fits as well


def board_pose(view: BoardView, target: PrintedTarget, lens: Lens) -> tuple[Array, Array]:
    """(T_camera_target (4, 4) [m], covariance (6, 6) of position and turn about the camera's axes [m², rad²]).

    Where the pose that is tilted the other way fits as well, the covariance holds both.
    """
    table = CornerTable.of([view], target)
    found = board_poses(table, lens, np.zeros(SHAPE))
    T = found.T[0, 0]
    G = grams(table, corner_rows(table, lens, np.zeros(SHAPE), T[None]))[0][:POSE, :POSE]
    at_camera = np.linalg.pinv(G, hermitian=True)
    # a twist about the camera, as a shift of the target's origin and a turn
    J = np.eye(POSE)
    J[:3, 3:] = -so3.hat(T[:3, 3])
    cov = J @ at_camera @ J.T
    if found.cost[0, 1] - found.cost[0, 0] < _TWIN:
        off = se3.error(T, found.T[0, 1])
        cov = cov + np.outer(off, off)
    return T, 0.5 * (cov + cov.T)


_GOOD, _BAD, _PAPER = (60, 180, 60), (60, 60, 220), (255, 255, 255)


def annotated(grey: np.ndarray, view: BoardView | None, said: str) -> np.ndarray:
    """A colour image (h, w, 3), blue first: corners with their numbers, and a line of text below."""
    out = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    h, w = grey.shape
    scale = max(w / 1280.0, 0.4)
    if view is not None:
        for number, (x, y) in zip(view.ids.tolist(), view.pixels, strict=True):
            at = (round(float(x)), round(float(y)))
            cv2.circle(out, at, max(2, round(5 * scale)), _GOOD, max(1, round(2 * scale)))
            cv2.putText(out, str(number), (at[0] + 5, at[1] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4 * scale, _GOOD, 1)
    bar = round(40 * scale)
    cv2.rectangle(out, (0, h - bar), (w, h), _GOOD if view is not None else _BAD, -1)
    plain = said.encode("ascii", "replace").decode()  # what OpenCV's letters can write
    cv2.putText(out, plain, (8, h - bar // 3), cv2.FONT_HERSHEY_SIMPLEX, 0.75 * scale, _PAPER, max(1, round(2 * scale)))
    return np.asarray(out)
