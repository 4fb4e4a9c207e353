"""Which of camera and target the arm carries, and where both are: from images and flange poses, without a guess.

Camera on the tip and target in the world: ``T_target_camera = Y T_base_tip X``. Camera in the world and target on the
tip: ``T_camera_target = Y T_base_tip X``. Both are AX = ZB, with the images' poses or their inverses; whichever meets
the images better is the mounting. Points that are nearly flat look much the same tilted the other way about the line of
sight: of the two poses of an image the one is taken that agrees with the rest.

The focal length begins as homographies of all images have it (Zhang 2000). Least squares over all corners follow, the
poses eliminated image by image (Schur complement). No prior: the minimum is that of any other program on the same
corners. A body is small beside its distance, so single images hardly tell the focal length; the lens is taken whose
poses meet the arm best.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import hand_eye
from modcal_core.camera.bundle import MARKER_CORNERS, MarkerBundle
from modcal_core.camera.corners import POSE, SHAPE, CornerTable, corner_rows, grams, images_with_pose
from modcal_core.camera.lens import COUNT, FISHEYE, PINHOLE, Lens
from modcal_core.errors import BadRecording, BadTable, NotEnoughData
from modcal_core.geometry import Array, descend, se3, so3
from modcal_core.hypotheses import BEYOND_DOUBT, HandEye, explain, of_recording, orders
from modcal_core.robots import Chain

_FLAT = np.zeros(SHAPE)
_STEPS, _MET = 12, 1e-9  # of poses: they meet in four to six; m, rad: a step below changes nothing


@dataclass(frozen=True)
class BoardPose:
    """Two poses of the target in each of N images. T: T_camera_target, the better one first, (N, 2, 4, 4) [m].

    cost: sum of whitened squares, (N, 2). rms: of the better one [px], (N,).
    """

    T: Array
    cost: Array
    rms: Array


def board_poses(table: CornerTable, lens: Lens, shape: Array = _FLAT) -> BoardPose:
    """Both poses of the target in every image, which must show four corners at least. shape: (5,)."""
    import cv2

    start = np.empty((2, table.views, 4, 4))
    for i in range(table.views):
        rows = table.of_view(i)
        points, rays = table.points[rows], lens.rays(table.pixels[rows])[:, None]
        first = se3.exp(np.r_[0.0, 0.0, 1.0, np.zeros(3)])
        with suppress(cv2.error):  # of points on one line
            _, turn, place, _ = cv2.solvePnPGeneric(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
            first = se3.transform(so3.exp(turn[0].ravel()), place[0].ravel()) if len(turn) else first
        start[0, i], start[1, i] = first, _twin(first, points)
    T, cost = (np.stack(part, axis=1) for part in zip(*(_refined(table, lens, shape, s) for s in start), strict=True))
    order = np.argsort(cost, axis=1)
    T, cost = np.take_along_axis(T, order[:, :, None, None], axis=1), np.take_along_axis(cost, order, axis=1)
    square = table.weight * (corner_rows(table, lens, shape, T[:, 0]).pixels ** 2).sum(axis=1)
    square, weight = (np.bincount(table.view, part, table.views) for part in (square, table.weight))
    return BoardPose(T, cost, np.sqrt(square / np.maximum(weight, 1.0)))


def _twin(T: Array, points: Array) -> Array:
    """The pose in which the plane nearest to points (m, 3) is tilted the other way about the line of sight."""
    middle = points.mean(axis=0)
    normal, seen = T[:3, :3] @ np.linalg.svd(points - middle)[2][2], se3.apply(T, middle)
    sight = seen / np.linalg.norm(seen)
    normal *= np.sign(normal @ sight)
    axis = np.cross(normal, sight)
    sine = float(np.linalg.norm(axis))
    R = so3.exp(2.0 * np.arctan2(sine, float(normal @ sight)) * axis / max(sine, 1e-12)) @ T[:3, :3]
    return se3.transform(R, seen - R @ middle)


def _refined(table: CornerTable, lens: Lens, shape: Array, T: Array) -> tuple[Array, Array]:
    """(poses (N, 4, 4), cost (N,)) by damped Gauss-Newton steps of all images at once."""
    damping = np.full(table.views, 1e-6)
    G = grams(table, corner_rows(table, lens, shape, T))
    for _ in range(_STEPS):
        H = G[:, :POSE, :POSE]
        more = damping[:, None] * np.einsum("nii->ni", H) + 1e-12
        step = np.linalg.solve(H + more[:, :, None] * np.eye(POSE), G[:, :POSE, -1:])[:, :, 0]
        moved = se3.exp(np.clip(step, -0.5, 0.5)) @ T
        new = grams(table, corner_rows(table, lens, shape, moved))
        better = new[:, -1, -1] <= G[:, -1, -1]
        T, G = (np.where(better[:, None, None], a, b) for a, b in ((moved, T), (new, G)))
        damping = np.where(better, np.maximum(0.1 * damping, 1e-9), np.minimum(10.0 * damping + 1e-3, 1e6))
        if np.abs(step[better]).max(initial=0.0) < _MET:
            break
    return T, G[:, -1, -1]


_INTRINSICS_STEPS = 100  # of Gauss and Newton, at most
_INTRINSICS_MET = 1e-12  # relative gain of the cost
_LONGEST = 10.0  # times the image's size, of a focal length; images square on show longer ones
_FOCALS = np.geomspace(0.4, 6.0, 17)  # times the image's width: lenses of 100° to 10°
_HALF_ANGLES = np.radians(np.linspace(35.0, 95.0, 13))  # of fisheyes, from the middle to the farther edge


@dataclass(frozen=True)
class LensFit:
    """A lens and the target's pose in each image, T_camera_target (N, 4, 4) [m]. grams: products of the columns of each
    image, (N, 22, 22). cost: sum of whitened squares.
    """

    lens: Lens
    T_camera_target: Array
    grams: Array
    cost: float


def plain_lenses(size: tuple[int, int], model: str) -> list[Lens]:
    """Lenses without distortion of all usual angles of view."""
    focal = 0.5 / _HALF_ANGLES if model == FISHEYE else _FOCALS
    return [Lens.plain(max(size) * f, size, model) for f in focal.tolist()]


def first_lens(table: CornerTable, size: tuple[int, int], model: str = PINHOLE) -> Lens:
    """A lens without distortion to begin with: of a pinhole from the homographies of all images, of a fisheye the one
    of some angles of view that meets the images best. Raises NotEnoughData.
    """
    import cv2

    if model == FISHEYE:
        return min(plain_lenses(size, FISHEYE), key=lambda lens: float(np.median(board_poses(table, lens).rms)))
    rows = [table.of_view(int(i)) for i in np.flatnonzero(images_with_pose(table))]
    points, pixels = ([part[own].astype(np.float32) for own in rows] for part in (table.points, table.pixels))
    focal = float(cv2.initCameraMatrix2D(points, pixels, size, 1.0)[0, 0]) if rows else np.inf
    if not 0.0 < focal < _LONGEST * max(size):
        said = "the images do not show the focal length"
        raise NotEnoughData("camera", said, "tilt the target by 20° to 45° to several sides, or state the intrinsics")
    return Lens.plain(focal, size)


def fit_lens(table: CornerTable, start: Lens, free: np.ndarray | None = None, prior: Array | None = None) -> LensFit:
    """The lens, from this start, and poses with least squares over all corners.

    free: which of its nine values to fit, (9,) bool; None: all. prior: information (9, 9) about the start; None: none.
    """
    use = np.flatnonzero(start.used if free is None else free & start.used)
    P0 = np.zeros((len(use), len(use))) if prior is None else prior[np.ix_(use, use)]
    p, c = slice(0, POSE), POSE + use

    def at(lens: Lens, T: Array) -> LensFit:
        G = grams(table, corner_rows(table, lens, _FLAT, T))
        off = (lens.values - start.values)[use]
        return LensFit(lens, T, G, float(G[:, -1, -1].sum() + off @ P0 @ off))

    def stepped(here: LensFit, damping: float) -> tuple[LensFit, float] | None:
        G = here.grams
        Hpp = G[:, p, p] * (1.0 + damping * np.eye(POSE))
        Hpp = Hpp + (np.einsum("nii->n", Hpp) == 0.0)[:, None, None] * np.eye(POSE)  # all corners left out: any pose
        Hcp = G[:, c, p]
        back = np.linalg.solve(Hpp, np.concatenate([np.swapaxes(Hcp, 1, 2), G[:, p, -1:]], axis=2))
        H = (G[:, c[:, None], c]).sum(0) - (Hcp @ back[:, :, :-1]).sum(0) + P0
        g = (G[:, c, -1] - (Hcp @ back[:, :, -1:])[:, :, 0]).sum(0) - P0 @ (here.lens.values - start.values)[use]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        change = np.zeros(COUNT)
        change[use] = scale * np.linalg.solve(H * np.outer(scale, scale) + damping * np.eye(len(use)), scale * g)
        lens, moves = (
            replace(here.lens, values=here.lens.values + change),
            back[:, :, -1] - back[:, :, :-1] @ change[use],
        )
        if lens.values[:2].min() <= 0.0:
            return None
        there = at(lens, se3.exp(moves) @ here.T_camera_target)
        return there, there.cost

    begin = at(start, board_poses(table, start).T[:, 0])
    return descend(
        begin, lambda fit: fit.cost, stepped, lambda _, gain, cost: gain <= _INTRINSICS_MET * cost, _INTRINSICS_STEPS
    ).place


ON_TIP, IN_WORLD = "camera on the tip, target in the world", "camera in the world, target on the tip"
MIN_VIEWS = 4  # three poses solve AX = ZB; a fourth tells whether they agree
_STILL_RAD, _STILL_M = 0.02, 0.005  # motion of the target in the images that is none, the arm having moved far more
_MOVED_RAD = 0.1  # of the arm
_TURNED = 0.15  # rad; relative turns about a second axis that show all of a hand-eye pose
_CLEAR = 2.0  # ratio of the misfits of both mountings, or of two orders of corners, that tells which it is
_ROUNDS = 5  # of choosing between the two poses of each image


@dataclass(frozen=True)
class Mounting:
    """camera_on_tip: else the target is. T_frame_base, T_tip_tool: of hand_eye, (4, 4) [m]. T_camera_target: the pose
    chosen in each image, (N, 4, 4). misfit_m: median distance of images from the solution. rival: misfit
    of the other mounting over this one's. turns: RMS of the arm's relative turns along their three main axes [rad].
    off_m: distance of each image that shows a pose from the solution, turns at the arm's range counted, (N,).
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
    if turns[0] < _MOVED_RAD:
        shift = 1e3 * float(np.ptp(T_base_tip[:, :3, 3], axis=0).max())
        said = f"the arm moves its tip by {shift:.0f} mm between them and turns it by {np.degrees(turns[0]):.1f}° only"
        raise NotEnoughData("images", said, "take images far apart, the wrist turned by 30° or more about two axes")
    if float(relative_turns(seen)[0]) < _STILL_RAD and float(np.ptp(seen[:, :3, 3], axis=0).max()) < _STILL_M:
        said = "the target does not move in the images while the arm does: camera and target move, or stand, together"
        raise BadRecording("images", said, "mount one of the two on the arm and the other in the world")
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


def explained(error: BadRecording, chain: Chain, q: Array, poses: BoardPose, on_tip: bool | None) -> BadRecording:
    """The error with what was written down wrongly, where that is beyond doubt. q (N, n). on_tip: as it is stated."""
    answers = []
    for carried in (True, False) if on_tip is None else (on_tip,):
        T = se3.inverse(poses.T[:, 0]) if carried else poses.T[:, 0]
        case = HandEye.of_arrays(chain, q, T[:, :3, 3], T[:, :3, :3])
        answers.append(explain(case, [*of_recording(case), *orders(case)], depth=1))
    best = max(answers, key=lambda answer: answer.gain)
    if not best.said or best.gain <= BEYOND_DOUBT:
        return error
    return BadRecording(error.offender, f"{error.limit}; {best.what}", best.remedy)


ENOUGH = 8  # images of a body with a pose: twice as many as a mounting needs, so that a misread one is outvoted
_LOOKED_AT = 30  # of these, for time, while the focal length is looked for
_FINER = np.linspace(0.85, 1.18, 9)  # between one of these and the next


def require_order(table: CornerTable, lens: Lens, target: MarkerBundle) -> None:
    """Raises BadTable where the corners of markers are numbered in another order than the target's file says."""
    whole = images_with_pose(table)
    if not target.turning or whole.sum() < ENOUGH:
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


def lens_by_arm(table: CornerTable, A: Array, usual: Lens, on_tip: bool | None) -> Lens:
    """The lens without distortion whose poses of the body in N images meet the flange's best. A: of this, (N, 4, 4)
    [m]. usual: of its model and image size. on_tip: the mounting where it is stated.
    """
    rows = np.zeros(table.views, bool)
    rows[np.unique(np.linspace(0, table.views - 1, _LOOKED_AT).astype(int))] = True
    table, A = table.select(rows), A[rows]

    def miss(lens: Lens) -> float:
        return _misfit(A, board_poses(table, lens), on_tip)

    best = min(plain_lenses(usual.size, usual.model), key=miss)
    return min((Lens.plain(best.values[0] * by, usual.size, usual.model) for by in _FINER), key=miss)
