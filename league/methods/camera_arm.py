"""OpenCV's lens and hand-eye, and a bundle of all corners from there: what most calibrations by a camera do.

``Y`` is where the one that the arm carries is in the frame of the one that stands.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from league.arm import Array, pose, rotation
from league.geometry import ANGLE, LENGTH
from league.task import Answer, Task

SIGMA = 0.15  # px, of a corner
FAR = 3.0  # deviations from which a corner counts less
LENS = 9  # fx fy cx cy k1 k2 p1 p2 k3


def hand_eye(task: Task) -> Answer:
    """Lens by calibrateCamera, then calibrateRobotWorldHandEye; the arm as its maker has it."""
    _, base, tool = _placed(task)
    return Answer(_by_board(task, base @ task.arm.frames(task.q)[:, -1] @ tool), parameters=LENS + 12)


def bundle(task: Task) -> Answer:
    """Lens, camera and board fitted to all corners."""
    return _bundle(task, 0)


def offsets(task: Task) -> Answer:
    """The same with zeros of the joints, as robot_calibration does it."""
    return _bundle(task, len(task.arm.names))


def links(task: Task) -> Answer:
    """The same with six errors a link, held near nominal."""
    return _bundle(task, 6 * (len(task.arm.names) - 1))


def _by_board(task: Task, Y: Array) -> Array:
    """Poses (N, 4, 4) of the camera in the board's frame."""
    return Y if task.on_tip else np.linalg.inv(Y)


def _corners(task: Task) -> Array:
    return task.reading.reshape(len(task.train), -1, 2)


def _placed(task: Task) -> tuple[Array, Array, Array]:
    """(Lens (9,), base and tool (4, 4) so that Y ≈ base · tip · tool)."""
    import cv2

    seen = [np.isfinite(view[:, 0]) for view in _corners(task)]
    points = [task.board[rows].astype(np.float32) for rows in seen]
    pixels = [view[rows].astype(np.float32) for view, rows in zip(_corners(task), seen, strict=True)]
    _, K, bend, turns, places = cv2.calibrateCamera(points, pixels, tuple(int(x) for x in task.size), None, None)
    board = pose(rotation(np.array(turns)[..., 0]), np.array(places)[..., 0])  # by the camera
    Y = np.linalg.inv(board) if task.on_tip else board
    tip = task.arm.frames(task.q[task.train])[:, -1]
    world, gripper = np.linalg.inv(Y), np.linalg.inv(tip)
    told = (world[:, :3, :3], world[:, :3, 3], gripper[:, :3, :3], gripper[:, :3, 3])
    R, t, R2, t2 = cv2.calibrateRobotWorldHandEye(*(list(part) for part in told))
    lens = np.r_[K[0, 0], K[1, 1], K[0, 2], K[1, 2], bend.ravel()[:5]]
    return lens, pose(R, t.ravel()), np.linalg.inv(pose(R2, t2.ravel()))


def project(lens: Array, X: Array) -> Array:
    """Pixels (…, 2) of points (…, 3) by the pinhole with radial and tangential bending."""
    x, y = np.moveaxis(X[..., :2] / np.maximum(X[..., 2:], 1e-3), -1, 0)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    r = x * x + y * y
    radial = 1.0 + r * (k1 + r * (k2 + r * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x)
    v = y * radial + p1 * (r + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], axis=-1)


def _bundle(task: Task, own: int) -> Answer:
    """own: how many values of the arm are fitted: none, a zero a joint, or six errors a link."""
    arm, corners = task.arm, _corners(task)
    lens, base, tool = _placed(task)
    n, seen = len(arm.names), np.isfinite(corners)
    board = np.concatenate([task.board, np.ones((len(task.board), 1))], axis=1)
    by_links = own > n
    scale = np.r_[np.full(4, 100.0), np.full(5, 0.1), np.full(12, 0.01), np.full(own, 1e-3)]
    prior = np.tile(np.r_[np.full(3, LENGTH), np.full(3, ANGLE)], own // 6) if by_links else np.empty(0)

    def carried(x: Array, q: Array) -> Array:
        twist = x[LENS : LENS + 12].reshape(2, 6)
        left, right = pose(rotation(twist[:, 3:]), twist[:, :3])
        steps, values = arm.steps.copy(), x[LENS + 12 :]
        if by_links:
            bend = values.reshape(-1, 6)
            steps[1:-1] = steps[1:-1] @ pose(rotation(bend[:, 3:]), bend[:, :3])
        turned = q + values if own and not by_links else q
        return base @ left @ arm.frames(turned, steps)[:, -1] @ right @ tool

    def residual(v: Array) -> Array:
        x = v * scale
        Y = carried(x, task.q[task.train])
        T = np.linalg.inv(_by_board(task, Y))
        X = np.einsum("nij,cj->nci", T[:, :3], board)
        off = (project(lens + x[:LENS], X) - corners)[seen] / SIGMA
        return np.r_[off, x[LENS + 12 :] / prior] if by_links else off

    done = least_squares(residual, np.zeros(len(scale)), loss="soft_l1", f_scale=FAR, max_nfev=40)
    return Answer(_by_board(task, carried(done.x * scale, task.q)), parameters=len(scale), remark=done.message)
