"""Which of camera and target the arm carries, and where both are: from images and flange poses, without a guess.

Camera on the tip and target in the world: ``T_target_camera = Y T_base_tip X``. Camera in the world and target on the
tip: ``T_camera_target = Y T_base_tip X``. Both are the robot-world / hand-eye problem AX = ZB, with the images' poses
or their inverses. Whichever meets the images better is the mounting. Where both are on the tip, or both in the world,
images do not change while the arm moves, which is said. Of the two poses that an image may show, the one is taken that
agrees with the rest.

A body is small beside its distance, and its markers are not where they are drawn, so single images hardly tell the
focal length; the arm's motion does. Where single images have too few points for a pose, the points are seen from many
postures. One that stands at y on the tip is seen, up to a factor, at P A ỹ, with A the flange pose and P the camera's
matrix in the base. That is linear in the 39 products of P's and y's elements, which the sightings of one point show to
a factor; their 9 × 4 part has rank one, which parts y from P. Then P by all points, and each point by P, in turn, and
the body is laid into its points (Kabsch). With the flange's inverse it is the same for a camera on the tip. Of what is
found either way, the one counts that corners are nearer to.

Tables go wrong in a few ways: rows of joints one image early or late, two joints exchanged, one of the other sign,
pixels mirrored since u and v were exchanged or v was counted from the bottom. Each is tried with the poses that the
images show; where one meets the arm as nothing else does, it is named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import hand_eye, procrustes
from modcal_core.camera.bundle import MARKER_CORNERS, MarkerBundle
from modcal_core.camera.corners import SHAPE, CornerTable, corner_rows
from modcal_core.camera.intrinsics import BoardPose, board_poses
from modcal_core.camera.lens import FISHEYE, PINHOLE, Lens
from modcal_core.errors import BadRecording, BadTable, ModcalError, NotEnoughData
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots import Chain, chain_forward

ON_TIP, IN_WORLD = "camera on the tip, target in the world", "camera in the world, target on the tip"
MIN_VIEWS = 4  # three poses solve AX = ZB; a fourth tells whether they agree
_STILL_RAD, _STILL_M = 0.02, 0.005  # motion of the target in the images that is none, the arm having moved far more
_MOVED_RAD, _MOVED_M = 0.1, 0.05  # of the arm
_TURNED = 0.15  # rad; relative turns about a second axis that show all of a hand-eye pose
_CLEAR = 2.0  # ratio of the misfits of both mountings, or of two orders of corners, that tells which it is
_ROUNDS = 5  # of choosing between the two poses of each image


@dataclass(frozen=True)
class Mounting:
    """camera_on_tip: else the target is. T_frame_base, T_tip_tool: of hand_eye, (4, 4) [m]. T_camera_target: the pose
    chosen in each image, (N, 4, 4). misfit_m: median distance of images from the solution. rival: misfit
    of the other mounting over this one's. turns: RMS of the arm's relative turns along their three main axes [rad].
    off_m: distance of each image from the solution, turns at the arm's range counted, (N,); empty where the solution is
    by single points, of which no image has a pose.
    """

    camera_on_tip: bool
    T_frame_base: Array
    T_tip_tool: Array
    T_camera_target: Array
    misfit_m: float
    rival: float
    turns: Array
    off_m: Array

    @property
    def label(self) -> str:
        """The mounting as text."""
        return ON_TIP if self.camera_on_tip else IN_WORLD

    @property
    def one_axis(self) -> bool:
        """Whether the arm turned about one axis only, which leaves a part of the hand-eye pose open."""
        return bool(self.turns[1] < _TURNED)

    def by_arm(self, T_base_tip: Array) -> Mounting:
        """The same with the target where flange poses (N, 4, 4) put it in all images."""
        T = self.T_frame_base @ T_base_tip @ self.T_tip_tool
        return replace(self, T_camera_target=se3.inverse(T) if self.camera_on_tip else T)


def find_mounting(T_base_tip: Array, poses: BoardPose, stated: bool | None = None) -> Mounting:
    """The mounting that flange poses (N, 4, 4) and the target's poses in N images show.

    stated: whether the camera is on the tip, where somebody says so. Raises NotEnoughData for too few images or too
    little motion, BadRecording where images do not change or both mountings meet them alike.
    """
    N = len(T_base_tip)
    if N < MIN_VIEWS:
        raise NotEnoughData("images", f"{N} show the target, at least {MIN_VIEWS} are needed", "take more images")
    turns, seen = relative_turns(T_base_tip), poses.T[:, 0]
    turn, shift = float(turns[0]), float(np.ptp(T_base_tip[:, :3, 3], axis=0).max())
    if turn < _MOVED_RAD and shift < _MOVED_M:
        said = f"the arm moves by {1e3 * shift:.0f} mm and {np.degrees(turn):.1f}° between them"
        raise NotEnoughData("images", said, "take images in postures far apart, the wrist turned about two axes")
    if float(relative_turns(seen)[0]) < _STILL_RAD and float(np.ptp(seen[:, :3, 3], axis=0).max()) < _STILL_M:
        said = "the target does not move in the images while the arm does: camera and target move, or stand, together"
        raise BadRecording("images", said, "mount one of the two on the arm and the other in the world")
    if turn < _MOVED_RAD:
        said = f"the arm turns its tip by {np.degrees(turn):.1f}° only"
        raise NotEnoughData("images", said, "turn the wrist by 30° or more about two axes")
    found = [_mounted(T_base_tip, poses, on_tip) for on_tip in (True, False)]
    miss = [float(np.median(one.off_m)) for one in found]
    best = int(miss[1] < miss[0]) if stated is None else int(not stated)
    rival = miss[1 - best] / max(miss[best], 1e-12)
    if stated is None and rival < _CLEAR:
        said = f"they fit {ON_TIP} and {IN_WORLD} alike ({1e3 * miss[0]:.0f} mm and {1e3 * miss[1]:.0f} mm off)"
        remedy = "check that images and joints belong together, turn the wrist more, or state --mounting"
        raise BadRecording("images", said, remedy)
    return replace(found[best], rival=rival, turns=turns)


def _misfit(T_base_tip: Array, poses: BoardPose, stated: bool | None) -> float:
    """By how much images miss flange poses (N, 4, 4) as one length [m], in the mounting that suits them better."""
    both = (True, False) if stated is None else (stated,)
    return min(float(np.median(_mounted(T_base_tip, poses, on_tip).off_m)) for on_tip in both)


def _mounted(A: Array, poses: BoardPose, on_tip: bool) -> Mounting:
    """The solution of one mounting, rival and turns left open. A: flange poses (N, 4, 4)."""
    N = len(A)
    both = se3.inverse(poses.T) if on_tip else poses.T
    ratio = np.sqrt(poses.cost[:, 1] / np.maximum(poses.cost[:, 0], 1e-300))
    # images whose two poses differ clearly in cost decide first
    rows = np.argsort(-ratio)[: max(MIN_VIEWS, N // 2)]
    every, pick, parts = np.arange(N), np.zeros(N, int), np.zeros((N, 2))
    Y = X = np.eye(4)
    for _ in range(_ROUNDS):
        Y, X = hand_eye(A[rows], both[every, pick][rows])
        gaps = np.stack([se3.error(Y @ A @ X, both[:, k]) for k in (0, 1)])
        each = np.linalg.norm(gaps.reshape(2, N, 2, 3), axis=3)  # shifts and turns
        size = each.sum(axis=2)  # a turn is dear against a shift, for it is the turn that the twins differ in
        new = np.argmin(size, axis=0)
        parts, good = each[new, every], size[new, every]
        keep = np.flatnonzero(good <= 5.0 * np.median(good))
        if (new == pick).all() and len(keep) == len(rows) and (keep == rows).all():
            break
        pick, rows = new, keep if len(keep) >= MIN_VIEWS else rows
    span = max(float(np.ptp(A[:, :3, 3], axis=0).max()), 0.1)
    miss = float(np.median(parts[:, 0]))
    return Mounting(on_tip, Y, X, poses.T[every, pick], miss, np.inf, np.zeros(3), parts @ [1.0, span])


def relative_turns(T: Array) -> Array:
    """RMS of the turns between all pairs of poses (N, 4, 4) along their three main axes [rad], largest first."""
    R = T[:, :3, :3]
    w = so3.log(so3.mean(R).T @ R)
    return np.linalg.svd(w - w.mean(axis=0), compute_uv=False)[:3] / np.sqrt(len(w))


_NEAR = 0.03  # misfit as a share of the reach: no arm is built worse than that
_MISMATCHED_CLEAR = 3.0  # times that of any other way
_P1 = 6  # of a lens's values


def explained(
    error: BadRecording, chain: Chain, q: Array, table: CornerTable, lens: Lens, on_tip: bool | None
) -> BadRecording:
    """The error with what would make images and joints meet, or as it was where nothing does.

    q: (N, n) of the images of the table. on_tip: the mounting where it is stated.
    """
    try:
        seen = board_poses(table, lens)
        ways = [(seen, *way) for way in _joints(chain, q)]
        said = "with the pixels mirrored", "exchange u and v, or count v from the top: they may be the other way round"
        ways.append((board_poses(*_mirrored(table, lens)), *said, q, np.arange(len(q))))
        found = []
        for poses, said_, remedy, at, rows in ways:
            some = replace(poses, T=poses.T[rows], cost=poses.cost[rows])
            found.append((_misfit(chain_forward(chain, at), some, on_tip), said_, remedy))
    except ModcalError:
        return error
    (best, what, remedy), (second, *_) = sorted(found, key=lambda one: one[0])[:2]
    if best > _NEAR * max(chain.reach(), 0.3) or second < _MISMATCHED_CLEAR * best:
        return error
    return BadRecording(error.offender, f"{error.limit}; {what} they are {1e3 * best:.0f} mm off", remedy)


def _joints(chain: Chain, q: Array) -> Iterator[tuple[str, str, Array, np.ndarray]]:
    """(what, what to do about it, joints, images that they are of) of every way in which a table of joints is wrong."""
    N, names = len(q), chain.names
    for way, last, first in (("before", q[:-1], np.arange(1, N)), ("after", q[1:], np.arange(N - 1))):
        yield f"with the joints of the image {way}", "give each image its own row of joints", last, first
    every = np.arange(N)
    for i in range(chain.n):
        turned = q * np.where(np.arange(chain.n) == i, -1.0, 1.0)
        yield f"with {names[i]} of the other sign", "state joints as the URDF turns them", turned, every
        for j in range(i + 1, chain.n):
            other = q.copy()
            other[:, [i, j]] = q[:, [j, i]]
            yield f"with {names[i]} and {names[j]} exchanged", "name the columns of joints as they are", other, every


def _mirrored(table: CornerTable, lens: Lens) -> tuple[CornerTable, Lens]:
    """The corners of mirrored images, and the lens by which those are seen as the others are by this."""
    pixels, values = table.pixels.copy(), lens.values.copy()
    pixels[:, 1] = lens.size[1] - 1.0 - pixels[:, 1]
    values[3] = lens.size[1] - 1.0 - values[3]
    if lens.model == PINHOLE:
        values[_P1] = -values[_P1]
    return replace(table, pixels=pixels), replace(lens, values=values)


_SIGHTINGS = 25  # of one point, for the 38 ratios in their products: two of each, and some to spare
_MIN = 12  # of all points, for a camera's 11 numbers twice over
_MAX = 2000  # sightings, for time; the others come into the fit
_TRIED = 4  # points that are begun with, those seen most often
_TURNS = 100  # of camera and points
_OUTLIER = 5.0  # times the median, beyond which a sighting does not count


@dataclass(frozen=True)
class Resection:
    """focal: of rays as given, 1 where these are known. T_camera_base, T_tip_body: (4, 4) [m]. miss: median distance of
    rays from where they should be, relative to ``focal``.
    """

    focal: float
    T_camera_base: Array
    T_tip_body: Array
    miss: float


def resection(A: Array, point: np.ndarray, rays: Array, body: Array, calibrated: bool) -> Resection | None:
    """Camera and body from sightings of points, None where these are too few.

    A: flange pose at each sighting, (M, 4, 4) [m]. point: which is seen, (M,). rays: where, x and y at depth 1, or,
    unless calibrated, in any unit from the image's middle, (M, 2). body: the nominal points, (C, 3) [m].
    """
    if len(A) > _MAX:
        some = np.linspace(0, len(A) - 1, _MAX).astype(int)
        A, point, rays = A[some], point[some], rays[some]
    counts = np.bincount(point, minlength=len(body))
    begin = [_matrix(A[:, :, 3], rays)]  # a body about the flange
    for first in np.argsort(-counts)[:_TRIED]:
        if counts[first] >= _SIGHTINGS:
            begin.append(_lifted(A[point == first], rays[point == first]))
    found = [one for P in begin if (one := _in_turn(P, A, point, rays, len(body))) is not None]
    if not found:
        return None
    miss, P, y = min(found, key=lambda one: one[0])
    seen = np.flatnonzero(np.isfinite(y).all(axis=1))
    if len(seen) < 3:
        return None
    # a camera with square pixels about the image's middle: what is along its axis is the centre's
    P = P * np.sign(np.linalg.det(P[:, :3])) / np.linalg.norm(P[2, :3])
    across = P[:2, :3] - np.outer(P[:2, :3] @ P[2, :3], P[2, :3])
    focal = 1.0 if calibrated else float(np.linalg.norm(across, axis=1).mean())
    P = P / np.array([[focal], [focal], [1.0]])
    T = se3.transform(so3.nearest_rotation(P[:, :3]), P[:, 3])
    return Resection(focal, T, procrustes(body[seen], y[seen]), miss / focal)


def _projection(at: Array, rays: Array) -> Array:
    """The matrix (3, k), to a factor, that takes places (m, k), homogeneous, to rays (m, 2) (direct linear transform).

    Columns are scaled to one size.
    """
    scale = 1.0 / np.maximum(np.linalg.norm(at, axis=0), 1e-300)
    unit, zero = at * scale, np.zeros_like(at)
    rows = np.r_[np.c_[unit, zero, -rays[:, :1] * unit], np.c_[zero, unit, -rays[:, 1:] * unit]]
    return np.asarray(scale * np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, -1))


def _lifted(A: Array, rays: Array) -> Array:
    """The camera's matrix (3, 4) by sightings of one point."""
    w = _projection(np.c_[A[:, :3, :3].reshape(-1, 9), A[:, :3, 3], np.ones(len(A))], rays)
    products = np.c_[w[:, :9].reshape(9, 3), w[:, 9:12].reshape(9, 1)]
    U, s, Vt = np.linalg.svd(products, full_matrices=False)
    return np.c_[(U[:, 0] * s[0] * Vt[0, 3]).reshape(3, 3), w[:, 12]]


def _in_turn(P: Array, A: Array, point: np.ndarray, rays: Array, count: int) -> tuple[float, Array, Array] | None:
    """(median miss, P, points (count, 3), NaN of those not seen twice)."""
    use = np.ones(len(A), bool)
    miss, y = np.inf, np.full((count, 3), np.nan)
    for _ in range(_TURNS):
        PA = P @ A
        rows = PA[:, :2] - rays[:, :, None] * PA[:, 2:]  # times (y, 1) it is zero
        y = np.full((count, 3), np.nan)
        for k in range(count):
            own = rows[use & (point == k)].reshape(-1, 4)
            if len(own) >= 4:
                y[k] = np.linalg.lstsq(own[:, :3], -own[:, 3], rcond=None)[0]
        known = use & np.isfinite(y[point]).all(axis=1)
        if known.sum() < _MIN:
            return None
        at = (A @ np.c_[y[point], np.ones(len(A))][:, :, None])[:, :, 0]
        P = _matrix(at[known], rays[known])
        seen = at @ P.T
        with np.errstate(divide="ignore", invalid="ignore"):
            gap = np.linalg.norm(seen[:, :2] / seen[:, 2:] - rays, axis=1)
        new = float(np.nanmedian(gap))
        use = gap <= _OUTLIER * new
        if abs(miss - new) < 1e-4 * new:
            break
        miss = new
    return new, P, y


def _matrix(at: Array, rays: Array) -> Array:
    """The camera's matrix by places (M, 4), homogeneous, and rays (M, 2)."""
    to_middle = np.eye(4)
    to_middle[:3, 3] = -at[:, :3].mean(axis=0)
    return np.asarray(_projection(at @ to_middle.T, rays) @ to_middle)


_MIN_POINTS = 4  # of an image, of which a pose is taken: three leave four poses
_LINE = 0.05  # width of points over their length, below which they are a line
_ENOUGH = 8  # images with a pose: twice as many as a mounting needs, so that a misread one is outvoted
_LOOKED_AT = 30  # of these, for time, while the focal length is looked for
_FOCALS = np.geomspace(0.4, 6.0, 17)  # times the image's width: lenses of 100° to 10°
_HALF_ANGLES = np.radians(np.linspace(35.0, 95.0, 13))  # of fisheyes, from the middle to the farther edge
_FINER = np.linspace(0.85, 1.18, 9)  # between one of these and the next


def images_with_pose(table: CornerTable) -> np.ndarray:
    """Images (N,) whose points show a pose by themselves."""
    out = np.zeros(table.views, bool)
    for i in range(table.views):
        points = table.points[(table.view == i) & (table.weight > 0.0)]
        if len(points) >= _MIN_POINTS:
            spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
            out[i] = spread[1] >= _LINE * spread[0]
    return out


@dataclass(frozen=True)
class BodyStart:
    """lens, mounting: to begin with. T_camera_target: of the mounting is by the arm, in every image."""

    lens: Lens
    mounting: Mounting

    def off(self, table: CornerTable) -> Array:
        """How far corners are from where they should be, (M, 2) [px]."""
        return corner_rows(table, self.lens, np.zeros(SHAPE), self.mounting.T_camera_target).pixels


def start_of_body(table: CornerTable, A: Array, lens: Lens | None, usual: Lens, on_tip: bool | None) -> BodyStart:
    """The start of images (N) of a body.

    A: flange poses, (N, 4, 4) [m]. lens: as stated, None where it is to be found. usual: of its model and image size.
    on_tip: the mounting where it is stated. Raises ModcalError for images that do not show it.
    """
    whole = images_with_pose(table)
    one = _by_points(table, A, lens, usual.size, on_tip) if table.views >= MIN_VIEWS else None
    starts = [] if one is None else [one]
    if whole.sum() >= _ENOUGH:
        posed, at = table.select(whole), A[whole]
        if lens is None:
            lens = starts[0].lens if starts else _lens_by_arm(posed, at, usual, on_tip)
        try:
            starts.append(BodyStart(lens, find_mounting(at, board_poses(posed, lens), on_tip).by_arm(A)))
        except ModcalError:
            if not starts:
                raise
    if not starts:
        said = f"few show four points that tell a pose, and no point is seen often enough among {table.views} images"
        raise NotEnoughData("images", said, "take 25 images or more of the same points, or such as show more points")
    return min(starts, key=lambda start: float(np.median(np.linalg.norm(start.off(table), axis=1))))


def require_order(table: CornerTable, lens: Lens, target: MarkerBundle) -> None:
    """Raises BadTable where the corners of markers are numbered in another order than the target's file says."""
    whole = images_with_pose(table)
    if not target.turning or whole.sum() < _ENOUGH:
        return
    some = table.select(np.isin(np.arange(table.views), np.flatnonzero(whole)[: _LOOKED_AT // 2]))
    miss = {}
    for k in range(MARKER_CORNERS):
        for names in (np.roll(target.corners, k), np.roll(target.corners[::-1], k)):
            order = tuple(str(name) for name in names)
            there = replace(some, target=replace(target, corners=order))
            miss[order] = float(np.median(board_poses(there, lens).rms))
    best = min(miss, key=lambda order: miss[order])
    if miss[best] * _CLEAR < miss[target.corners]:
        said = f"numbers the corners of markers as {', '.join(target.corners)}; the images show {', '.join(best)}"
        raise BadTable(target.label, said, f"state corner_order: [{', '.join(best)}]")


def _lens_by_arm(table: CornerTable, A: Array, usual: Lens, on_tip: bool | None) -> Lens:
    """The lens without distortion whose poses of the body meet the flange's best."""
    rows = np.zeros(table.views, bool)
    rows[np.unique(np.linspace(0, table.views - 1, _LOOKED_AT).astype(int))] = True
    table, A, size, model = table.select(rows), A[rows], usual.size, usual.model

    def miss(focal: float) -> float:
        return _misfit(A, board_poses(table, Lens.plain(focal, size, model)), on_tip)

    tried = 0.5 * max(size) / _HALF_ANGLES if model == FISHEYE else _FOCALS * max(size)
    best = min(tried.tolist(), key=miss)
    return Lens.plain(min((best * _FINER).tolist(), key=miss), size, model)


def _by_points(
    table: CornerTable, A: Array, lens: Lens | None, size: tuple[int, int], on_tip: bool | None
) -> BodyStart | None:
    """The start from sightings of single points, None where they are too few or tell no mounting."""
    _, first, point = np.unique(table.ids, return_index=True, return_inverse=True)
    rays = (table.pixels - 0.5 * (np.array(size) - 1.0)) / max(size) if lens is None else lens.rays(table.pixels)
    found: dict[bool, Resection] = {}
    for carried in (True, False) if on_tip is None else (on_tip,):
        flange = se3.inverse(A) if carried else A
        one = resection(flange[table.view], point, rays, table.points[first], lens is not None)
        if one is not None:
            found[carried] = one
    if not found:
        return None
    carried = min(found, key=lambda c: found[c].miss)
    rival = found[not carried].miss / max(found[carried].miss, 1e-12) if len(found) == 2 else np.inf
    if rival < _CLEAR:
        return None
    best = found[carried]
    base, tool = best.T_camera_base, best.T_tip_body
    away = float(np.median(np.linalg.norm((base @ (se3.inverse(A) if carried else A))[:, :3, 3], axis=1)))
    if carried:  # it is the camera that is on the tip: T_camera_tip and T_base_body
        base, tool = se3.inverse(tool), se3.inverse(base)
    mounting = Mounting(carried, base, tool, A, best.miss * away, float(rival), relative_turns(A), np.empty(0))
    return BodyStart(lens or Lens.plain(best.focal * max(size), size), mounting.by_arm(A))
