"""Whether camera, target or arm were moved since the calibration, from the images that come in while the robot works.

Each image is compared with where the calibrated model has its target: six numbers, with the covariance of its corners,
of what an image has of its own, and of the model, which all images share. For the last few images the likelihood of
*nothing happened* stands against each half being elsewhere since one of them (six numbers) and each joint's zero having
slipped (one); the likeliest is named where it beats nothing by far and the next one clearly.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.arm_poses import ArmPoses
from modcal_core.camera.corners import POSE, CornerTable, corner_rows, grams
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.target import PrintedTarget
from modcal_core.camera.views import BoardView
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

WORLD, TIP = "world", "tip"
_WINDOW = 8  # images that are looked back on
_LEAST = 2  # of them that show a change: a single one may be a misread board
_GAIN = 20.0  # of −2 log likelihood against nothing, the price of the numbers taken off: odds of 1 : 20 000
_CLEAR = 6.0  # of the same against the next likeliest: odds of 20 : 1
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
        """For a person."""
        size = f"{np.degrees(self.turn_rad):.2f}°"
        if self.shift_m > 0.0:
            size = f"{1e3 * self.shift_m:.1f} mm and {size}"
        return f"The {self.what} was moved by {size}"


@dataclass(frozen=True)
class _Seen:
    """One image against the model. place: of the tool in the frame, (3,). offset: of its target as the camera sees it,
    (6,). cov: its own covariance, (6, 6). by_model: what the model's parameters move it by, (6, P). world, tip, joints:
    the same of each half, (6, 6), and of each joint, (6, n).
    """

    stamp: float
    place: Array
    offset: Array
    cov: Array
    by_model: Array
    world: Array
    tip: Array
    joints: Array


class CameraWatch:
    """Watches the images of a calibrated cell; give it each as it comes."""

    def __init__(self, fit: CameraFit, target: PrintedTarget) -> None:
        """fit: the calibration. target: as it was calibrated with."""
        self._fit, self._target = fit, target
        self._seen: deque[_Seen] = deque(maxlen=_WINDOW)
        self._count = 0

    def image(self, view: BoardView, q: Array) -> Moved | None:
        """What was moved by this image, the arm standing at q (n,); None while nothing stands out."""
        self._count += 1
        if (seen := self._look(view, q)) is not None:
            self._seen.append(seen)
        return self._judge()

    def _look(self, view: BoardView, q: Array) -> _Seen | None:
        fit = self._fit
        if len(view) < POSE:
            return None
        table = CornerTable.of([view], self._target)
        at: ArmPoses = fit.poses.at_postures(np.asarray(q)[None])
        T, motions = at.tool_motions(fit.state.values)
        rows = corner_rows(table, fit.state.lens, fit.state.shape, at.seen(T))
        G = grams(table, rows)[0] / fit.sizes.noise**2
        own = np.linalg.pinv(G[:POSE, :POSE], hermitian=True)
        joints = at.joint_motions(fit.state.values, T)
        by_joints = at.as_twists(T, joints)[0]
        shifts = at.as_twists(T, np.concatenate([np.eye(3), np.zeros((3, 3))])[None])[0]
        noise = fit.sizes.joint**2 * by_joints @ by_joints.T + fit.sizes.shift**2 * shifts @ shifts.T
        by_model = np.zeros((POSE, len(fit.covariance)))
        P = motions.shape[2]
        by_model[:, :P] = at.as_twists(T, motions)[0]
        by_model[:, P + 1 :] = own @ G[:POSE, POSE:-1]
        R, p = T[:, :3, :3], T[:, :3, 3]
        eye, zero = np.eye(3)[None], np.zeros((1, 3, 3))
        by_world = np.concatenate([np.concatenate([eye, -so3.hat(p)], 2), np.concatenate([zero, eye], 2)], 1)
        by_tool = np.concatenate([np.concatenate([R, zero], 2), np.concatenate([zero, R], 2)], 1)
        stamp = view.stamp if np.isfinite(view.stamp) else float(self._count)
        return _Seen(
            stamp,
            p[0],
            own @ G[:POSE, -1],
            own + noise,
            by_model,
            at.as_twists(T, by_world)[0],
            at.as_twists(T, by_tool)[0],
            by_joints,
        )

    def _judge(self) -> Moved | None:
        seen = list(self._seen)
        if len(seen) < _LEAST:
            return None
        K = len(seen)
        model = np.concatenate([s.by_model for s in seen])
        V = model @ self._fit.covariance @ model.T
        for k, s in enumerate(seen):
            rows = slice(POSE * k, POSE * (k + 1))
            V[rows, rows] += s.cov
        V += 1e-14 * np.trace(V) / len(V) * np.eye(len(V))
        offset = np.concatenate([s.offset for s in seen])
        white = np.linalg.inv(np.linalg.cholesky(V))
        y = white @ offset
        halves = np.r_[[_USUAL_M] * 3, [_USUAL_RAD] * 3]
        found: list[tuple[float, str, int, Array, Array]] = []
        for first in range(K - _LEAST + 1):
            since = np.repeat(np.arange(K) >= first, POSE)[:, None]
            stacked = {WORLD: [s.world for s in seen], TIP: [s.tip for s in seen]}
            for what, parts in stacked.items():
                columns = np.concatenate(parts) * since * halves
                gain, x = _gain(white @ columns, y)
                found.append((gain, what, first, x * halves, columns))
            joints = np.concatenate([s.joints for s in seen]) * since * _USUAL_RAD
            for j, name in enumerate(self._fit.poses.model.chain.names):
                gain, x = _gain(white @ joints[:, j : j + 1], y)
                found.append((gain, name, first, x * _USUAL_RAD, joints[:, j : j + 1]))
        found.sort(key=lambda f: -f[0])
        gain, what, first, x, columns = found[0]
        if gain < _GAIN or _least_without(columns, offset, V, range(first, K)) < 0.5 * _GAIN:
            return None
        # a change of everything from the first image on may be one from any time before
        rival = next((f for f in found if f[1] != what), None)
        names = [self._name(what)]
        if rival is not None and gain - rival[0] < _CLEAR:
            names.append(self._name(rival[1]))
        shift = np.zeros(3)
        if what == WORLD:
            p = np.mean([s.place for s in seen], axis=0)
            shift = x[:3] + np.cross(x[3:], p)
        elif what == TIP:
            shift = x[:3]
        turn = float(np.linalg.norm(x[3:] if len(x) == POSE else x))
        return Moved(" or ".join(dict.fromkeys(names)), seen[first].stamp, float(np.linalg.norm(shift)), turn, gain)

    def _name(self, what: str) -> str:
        on_tip = self._fit.poses.camera_on_tip
        if what == WORLD:
            return "target" if on_tip else "camera"
        if what == TIP:
            return "camera" if on_tip else "target"
        return f"joint {what}"

    def forget(self) -> None:
        """Begin again, with the next image: after something was put right."""
        self._seen.clear()


def _least_without(columns: Array, offset: Array, V: Array, among: range) -> float:
    """The least gain that is left without any one of these images: a single misread one is no move."""
    out = []
    for k in among:
        keep = np.delete(np.arange(len(V)), slice(POSE * k, POSE * (k + 1)))
        white = np.linalg.inv(np.linalg.cholesky(V[np.ix_(keep, keep)]))
        out.append(_gain(white @ columns[keep], white @ offset[keep])[0])
    return min(out)


def _gain(columns: Array, y: Array) -> tuple[float, Array]:
    """(gain of −2 log likelihood by columns (m, k) of unit prior, their values), the price of k numbers taken off."""
    H = columns.T @ columns + np.eye(columns.shape[1])
    b = columns.T @ y
    x = np.asarray(np.linalg.solve(H, b), dtype=float)
    return float(b @ x - np.linalg.slogdet(H)[1]), x
