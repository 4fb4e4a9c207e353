"""Which of camera and target the arm carries, and where both are: from images and flange poses, without a guess.

Camera on the tip and target in the world: ``T_target_camera = Y T_base_tip X``. Camera in the world and target on the
tip: ``T_camera_target = Y T_base_tip X``. Both are the robot-world / hand-eye problem AX = ZB, with the images' poses
or their inverses; its rotations are linear (Shah 2013), its positions follow. Whichever meets the images better is the
mounting. Where both are on the tip, or both in the world, images do not change while the arm moves, which is said. Of
the two poses that a flat sheet may have in an image, the one is taken that agrees with the rest.

Tables go wrong in a few ways: rows of joints one image early or late, two joints exchanged, one of the other sign,
pixels mirrored since u and v were exchanged or v was counted from the bottom. Each is tried with the poses that the
images show; where one meets the arm as nothing else does, it is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import hand_eye
from modcal_core.camera.corners import CornerTable
from modcal_core.camera.intrinsics import BoardPose
from modcal_core.camera.lens import PINHOLE, Lens
from modcal_core.errors import BadRecording, ModcalError, NotEnoughData
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots import Chain, chain_forward

ON_TIP, IN_WORLD = "camera on the tip, target in the world", "camera in the world, target on the tip"
MIN_VIEWS = 4  # three poses solve AX = ZB; a fourth tells whether they agree
_STILL_RAD, _STILL_M = 0.02, 0.005  # motion of the target in the images that is none, the arm having moved far more
_MOVED_RAD, _MOVED_M = 0.1, 0.05  # of the arm
_TURNED = 0.15  # rad; relative turns about a second axis that show all of a hand-eye pose
_CLEAR = 2.0  # ratio of the two mountings' misfits, below which the images do not tell which it is
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


def find_mounting(T_base_tip: Array, poses: BoardPose, stated: bool | None = None) -> Mounting:
    """The mounting that flange poses (N, 4, 4) and the target's poses in N images show.

    stated: whether the camera is on the tip, where somebody says so. Raises NotEnoughData for too few images or too
    little motion, BadRecording where images do not change or both mountings meet them alike.
    """
    N = len(T_base_tip)
    if N < MIN_VIEWS:
        raise NotEnoughData("images", f"{N} show the target, at least {MIN_VIEWS} are needed", "take more images")
    turns = relative_turns(T_base_tip)
    _require_motion(T_base_tip, poses.T[:, 0], turns)
    found = [_solve(T_base_tip, poses, on_tip) for on_tip in (True, False)]
    miss = [_size(one, T_base_tip) for one in found]
    best = int(miss[1] < miss[0]) if stated is None else int(not stated)
    rival = miss[1 - best] / max(miss[best], 1e-12)
    if stated is None and rival < _CLEAR:
        said = f"they fit {ON_TIP} and {IN_WORLD} alike ({1e3 * miss[0]:.0f} mm and {1e3 * miss[1]:.0f} mm off)"
        remedy = "check that images and joints belong together, turn the wrist more, or state --mounting"
        raise BadRecording("images", said, remedy)
    Y, X, chosen, gap = found[best]
    shift, _ = _median(gap)
    parts = np.linalg.norm(gap.reshape(N, 2, 3), axis=2)
    return Mounting(best == 0, Y, X, chosen, shift, rival, turns, parts @ [1.0, _range(T_base_tip)])


def mounting_misfit(T_base_tip: Array, poses: BoardPose, stated: bool | None = None) -> float:
    """By how much images miss flange poses (N, 4, 4) as one length [m], in the mounting that suits them better."""
    both = (True, False) if stated is None else (stated,)
    return min(_size(_solve(T_base_tip, poses, on_tip), T_base_tip) for on_tip in both)


def _solve(A: Array, poses: BoardPose, on_tip: bool) -> tuple[Array, Array, Array, Array]:
    """(Y, X, chosen T_camera_target, distance of each image from these (N, 6)) of one mounting."""
    N = len(A)
    both = se3.inverse(poses.T) if on_tip else poses.T
    ratio = np.sqrt(poses.cost[:, 1] / np.maximum(poses.cost[:, 0], 1e-300))
    # images whose two poses differ clearly in cost decide first
    rows = np.argsort(-ratio)[: max(MIN_VIEWS, N // 2)]
    pick = np.zeros(N, int)
    gap = np.zeros((N, 6))
    Y = X = np.eye(4)
    for _ in range(_ROUNDS):
        B = both[np.arange(N), pick]
        Y, X = hand_eye(A[rows], B[rows])
        predicted = Y @ A @ X
        gaps = np.stack([se3.error(predicted, both[:, k]) for k in (0, 1)])
        lever = 1.0  # m; a turn is dear against a shift, for it is the turn that the twins differ in
        size = np.linalg.norm(gaps[:, :, :3], axis=2) + lever * np.linalg.norm(gaps[:, :, 3:], axis=2)
        new = np.argmin(size, axis=0)
        gap = gaps[new, np.arange(N)]
        good = size[new, np.arange(N)]
        keep = np.flatnonzero(good <= 5.0 * np.median(good))
        if (new == pick).all() and len(keep) == len(rows) and (keep == rows).all():
            break
        pick, rows = new, keep if len(keep) >= MIN_VIEWS else rows
    return Y, X, poses.T[np.arange(N), pick], gap


def _median(gap: Array) -> tuple[float, float]:
    """(median shift [m], median turn [rad]) of distances (N, 6)."""
    shift, turn = (float(np.median(np.linalg.norm(part, axis=1))) for part in (gap[:, :3], gap[:, 3:]))
    return shift, turn


def _range(A: Array) -> float:
    """Largest spread of flange poses (N, 4, 4) along one axis [m]."""
    return max(float(np.ptp(A[:, :3, 3], axis=0).max()), 0.1)


def _size(found: tuple[Array, Array, Array, Array], A: Array) -> float:
    """Misfit of a solution as one length [m]."""
    shift, turn = _median(found[3])
    return shift + _range(A) * turn


def relative_turns(T: Array) -> Array:
    """RMS of the turns between all pairs of poses (N, 4, 4) along their three main axes [rad], largest first."""
    R = T[:, :3, :3]
    mean = so3.mean(R)
    w = so3.log(mean.T @ R)
    w = w - w.mean(axis=0)
    return np.linalg.svd(w, compute_uv=False)[:3] / np.sqrt(len(w))


def _require_motion(T_base_tip: Array, seen: Array, turns: Array) -> None:
    arm_turn, arm_shift = float(turns[0]), float(np.ptp(T_base_tip[:, :3, 3], axis=0).max())
    if arm_turn < _MOVED_RAD and arm_shift < _MOVED_M:
        said = f"the arm moves by {1e3 * arm_shift:.0f} mm and {np.degrees(arm_turn):.1f}° between them"
        raise NotEnoughData("images", said, "take images in postures far apart, the wrist turned about two axes")
    still = float(relative_turns(seen)[0]) < _STILL_RAD and float(np.ptp(seen[:, :3, 3], axis=0).max()) < _STILL_M
    if still:
        said = "the target does not move in the images while the arm does: camera and target move, or stand, together"
        raise BadRecording("images", said, "mount one of the two on the arm and the other in the world")
    if arm_turn < _MOVED_RAD:
        said = f"the arm turns its tip by {np.degrees(arm_turn):.1f}° only"
        raise NotEnoughData("images", said, "turn the wrist by 30° or more about two axes")


_NEAR = 0.03  # misfit as a share of the reach: no arm is built worse than that
_MISMATCHED_CLEAR = 3.0  # times that of any other way
_P1 = 6  # of a lens's values
_Posed = Callable[[CornerTable, Lens], BoardPose]


def explained(
    error: BadRecording, chain: Chain, q: Array, table: CornerTable, lens: Lens, posed: _Posed, on_tip: bool | None
) -> BadRecording:
    """The error with what would make images and joints meet, or as it was where nothing does.

    q: (N, n) of the images of the table. posed: the target's poses in them. on_tip: the mounting where it is stated.
    """
    try:
        seen = posed(table, lens)
        found = [(_misfit(chain, at, seen, rows, on_tip), said, remedy) for said, remedy, at, rows in _joints(chain, q)]
        mirrored = posed(*_mirrored(table, lens))
    except ModcalError:
        return error
    every = np.arange(len(q))
    said = "with the pixels mirrored", "exchange u and v, or count v from the top: they may be the other way round"
    found.append((_misfit(chain, q, mirrored, every, on_tip), *said))
    found.sort(key=lambda one: one[0])
    (best, what, remedy), second = found[0], found[1][0]
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
        turned = q.copy()
        turned[:, i] *= -1.0
        yield f"with {names[i]} of the other sign", "state joints as the URDF turns them", turned, every
        for j in range(i + 1, chain.n):
            other = q.copy()
            other[:, [i, j]] = q[:, [j, i]]
            yield f"with {names[i]} and {names[j]} exchanged", "name the columns of joints as they are", other, every


def _misfit(chain: Chain, q: Array, poses: BoardPose, rows: np.ndarray, on_tip: bool | None) -> float:
    """By how much images (rows of the poses) miss these joints (m, n) [m]."""
    return mounting_misfit(chain_forward(chain, q), replace(poses, T=poses.T[rows], cost=poses.cost[rows]), on_tip)


def _mirrored(table: CornerTable, lens: Lens) -> tuple[CornerTable, Lens]:
    """The corners of mirrored images, and the lens by which those are seen as the others are by this."""
    pixels, values = table.pixels.copy(), lens.values.copy()
    pixels[:, 1] = lens.size[1] - 1.0 - pixels[:, 1]
    values[3] = lens.size[1] - 1.0 - values[3]
    if lens.model == PINHOLE:
        values[_P1] = -values[_P1]
    return replace(table, pixels=pixels), replace(lens, values=values)
