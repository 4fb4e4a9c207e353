"""Whether camera, target or arm were moved since the calibration, from the images that come in while the robot works.

Each image is compared with where the calibrated model has its target: six numbers, with the covariance of its corners,
of what an image has of its own, and of the model, which all images share. For the last few images the likelihood of
*nothing happened* stands against each half being elsewhere since one of them (six numbers) and each joint's zero having
slipped (one); the likeliest is named where it beats nothing by far and the next one clearly. Images of several cameras
are judged together: each camera may have been moved by itself, while joints, and a target that cameras see from the
same side, are one for all. What joints and tool are off by at a stop is one for all images of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from modcal_core.camera.arm_poses import ArmPoses
from modcal_core.camera.bundle import BoardView, PrintedTarget
from modcal_core.camera.corners import POSE, CameraState, CornerTable
from modcal_core.camera.fit import CameraFit, camera_rows
from modcal_core.geometry import Array

WORLD, TIP = "world", "tip"
_WINDOW = 8  # images that are looked back on
_MIN = 2  # of them that show a change: a single one may be a misread board
_GAIN = 20.0  # of −2 log likelihood against nothing, the price of the numbers taken off: odds of 1 : 20 000
_CLEAR = 6.0  # of the same against the next likeliest: odds of 20 : 1
_SAME = 1e-3  # rad or m by which joints differ within a stop
_USUAL_M, _USUAL_RAD = 0.01, 0.02  # how far something is moved that is kicked, or a joint that slips


@dataclass(frozen=True)
class Moved:
    """what: "camera", "target" or the name of a joint; "camera or arm", and so on, where images do not tell. since: the
    stamp, or number, of the first image after it. shift_m, turn_rad: by how much. gain: of −2 log likelihood.
    """

    what: str
    since: float
    shift_m: float
    turn_rad: float
    gain: float

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        size = f"{np.degrees(self.turn_rad):.2f}°"
        if self.shift_m > 0.0:
            size = f"{1e3 * self.shift_m:.1f} mm and {size}"
        return f"The {self.what} was moved by {size}"


@dataclass(frozen=True)
class _Half:
    """what: "camera" or "target". which: the camera's name, or the side of the target. half: world or tip."""

    what: str
    which: str
    half: str


@dataclass(frozen=True)
class _ImageResidual:
    """One image against the model. place: of the tool in the frame, (3,). offset: of its target as the camera sees it,
    (6,). cov: of its corners, (6, 6). own: what the arm is off by at this stop, (6, n + 3), of unit variance. q: (n,).
    by_model: what the model's parameters move it by, (6, P). halves: the same of each half, (6, 6), by what that is.
    joints: of each joint, (6, n).
    """

    stamp: float
    place: Array
    offset: Array
    cov: Array
    own: Array
    q: Array
    by_model: Array
    halves: dict[_Half, Array]
    joints: Array


@dataclass(frozen=True)
class _Watched:
    """A camera. poses, state: of the fit. columns: of each of its parameters among those of all, −1 for none."""

    poses: ArmPoses
    state: CameraState
    columns: np.ndarray

    def half(self, half: str, name: str) -> _Half:
        """What one of the two halves is."""
        if (half == TIP) == self.poses.camera_on_tip:
            return _Half("camera", name, half)
        return _Half("target", half, half)


class CameraWatch:
    """Watches the images of a calibrated cell; give it each as it comes."""

    def __init__(self, fit: CameraFit, target: PrintedTarget) -> None:
        """fit: the calibration, of one camera or several. target: as it was calibrated with, by all of them."""
        self._fit, self._target = fit, target
        self._cameras = {"": _Watched(fit.poses, fit.state, np.arange(len(fit.covariance)))}
        for one, columns, state in fit.poses.further_at(fit.state):
            self._cameras[one.name] = _Watched(one.poses, state, columns)
        self._seen: deque[_ImageResidual] = deque(maxlen=_WINDOW * len(self._cameras))
        self._count = 0

    def image(self, view: BoardView, q: Array, camera: str = "") -> Moved | None:
        """What was moved by this image, the arm standing at q (n,); None while nothing stands out.

        camera: of a further one its name. One that is not in the calibration says nothing.
        """
        self._count += 1
        if camera in self._cameras and (seen := self._look(view, np.asarray(q), camera)) is not None:
            self._seen.append(seen)
        return self._judge()

    def _look(self, view: BoardView, q: Array, camera: str) -> _ImageResidual | None:
        fit, watched = self._fit, self._cameras[camera]
        if len(view) < POSE:
            return None
        table = CornerTable.of([view], self._target)
        state, at = watched.state, watched.poses.at_postures(q[None])
        T = at.tool_at(state.values)
        rows = camera_rows(table, at, state, watched.columns)
        G = rows.grams[0] / fit.sizes.noise**2
        own = np.linalg.pinv(G[:POSE, :POSE], hermitian=True)
        by_own = np.concatenate([rows.moved[0], own @ G[:POSE, POSE:-1]], axis=1)
        by_model = np.zeros((POSE, len(fit.covariance)))
        fitted = watched.columns >= 0
        by_model[:, watched.columns[fitted]] = by_own[:, fitted]
        halves = [watched.half(half, camera) for half in (WORLD, TIP)]
        return _ImageResidual(
            view.stamp if np.isfinite(view.stamp) else float(self._count),
            T[0, :3, 3],
            own @ G[:POSE, -1],
            own,
            np.concatenate([fit.sizes.joint * rows.joints[0], fit.sizes.shift * rows.shifts[0]], axis=1),
            q,
            by_model,
            {half: twists[0] for half, twists in zip(halves, at.half_motions(T), strict=True)},
            rows.joints[0],
        )

    def _judge(self) -> Moved | None:
        seen = list(self._seen)
        if len(seen) < _MIN:
            return None
        K = len(seen)
        stops = _stops(seen)
        model = np.concatenate([s.by_model for s in seen])
        V = model @ self._fit.covariance @ model.T
        for k, one in enumerate(seen):
            rows = slice(POSE * k, POSE * (k + 1))
            V[rows, rows] += one.cov
            for other in np.flatnonzero(stops == stops[k]):
                V[rows, POSE * other : POSE * (other + 1)] += one.own @ seen[other].own.T
        V += 1e-14 * np.trace(V) / len(V) * np.eye(len(V))
        offset = np.concatenate([s.offset for s in seen])
        white = np.linalg.inv(np.linalg.cholesky(V))
        y = white @ offset
        usual = np.r_[[_USUAL_M] * 3, [_USUAL_RAD] * 3]
        halves = list(dict.fromkeys(half for s in seen for half in s.halves))
        nothing = np.zeros((POSE, POSE))
        found: list[tuple[float, _Half | str, int, Array, Array]] = []
        for first in range(K - _MIN + 1):
            since = np.repeat(np.arange(K) >= first, POSE)[:, None]
            for half in halves:
                columns = np.concatenate([s.halves.get(half, nothing) for s in seen]) * since * usual
                gain, x = _gain(white @ columns, y)
                found.append((gain, half, first, x * usual, columns))
            joints = np.concatenate([s.joints for s in seen]) * since * _USUAL_RAD
            for j, name in enumerate(self._fit.poses.model.chain.names):
                gain, x = _gain(white @ joints[:, j : j + 1], y)
                found.append((gain, name, first, x * _USUAL_RAD, joints[:, j : j + 1]))
        found.sort(key=lambda f: -f[0])
        gain, what, first, x, columns = found[0]
        if gain < _GAIN or _least_without(columns, offset, V, stops, first) < 0.5 * _GAIN:
            return None
        # a change of everything from the first image on may be one from any time before
        rival = next((f for f in found if f[1] != what), None)
        names = [self._name(what)]
        if rival is not None and gain - rival[0] < _CLEAR:
            names.append(self._name(rival[1]))
        shift = np.zeros(3)
        if isinstance(what, _Half):
            p = np.mean([s.place for s in seen if what in s.halves], axis=0)
            shift = x[:3] + np.cross(x[3:], p) if what.half == WORLD else x[:3]
        turn = float(np.linalg.norm(x[3:] if len(x) == POSE else x))
        return Moved(" or ".join(dict.fromkeys(names)), seen[first].stamp, float(np.linalg.norm(shift)), turn, gain)

    def _name(self, what: _Half | str) -> str:
        if isinstance(what, str):
            return f"joint {what}"
        if what.what == "target" or len(self._cameras) == 1:
            return what.what
        return f"camera {what.which}" if what.which else "first camera"

    def forget(self) -> None:
        """Begin again, with the next image: after something was put right."""
        self._seen.clear()


def _stops(seen: Sequence[_ImageResidual]) -> np.ndarray:
    """The number of the stop of each image: those one after the other at the same joints are of one."""
    apart = [np.abs(b.q - a.q).max() > _SAME for a, b in pairwise(seen)]
    return np.r_[0, np.cumsum(apart)].astype(int)


def _least_without(columns: Array, offset: Array, V: Array, stops: np.ndarray, first: int) -> float:
    """The least gain that is left without any one stop since an image: a single one may be misread, or its joints be of
    another moment, which is no move.
    """
    out = []
    for stop in np.unique(stops[first:]):
        keep = np.repeat(stops != stop, POSE)
        white = np.linalg.inv(np.linalg.cholesky(V[np.ix_(keep, keep)]))
        out.append(_gain(white @ columns[keep], white @ offset[keep])[0])
    return min(out)


def _gain(columns: Array, y: Array) -> tuple[float, Array]:
    """(gain of −2 log likelihood by columns (m, k) of unit prior, their values), the price of k numbers taken off."""
    H = columns.T @ columns + np.eye(columns.shape[1])
    b = columns.T @ y
    x = np.asarray(np.linalg.solve(H, b), dtype=float)
    return float(b @ x - np.linalg.slogdet(H)[1]), x
