"""pybotics: modified DH parameters, base and tool, by SciPy's least squares on its forward kinematics."""

from __future__ import annotations

import numpy as np

from league.arm import Arm, Array, align, pose, rotation
from league.task import Answer, Task

_PARALLEL = 1e-6
_ALONG = np.array([1e-3, 1.0, 1e-3, 1.0])  # steps of alpha, a, theta, d: rad and mm


def answer(task: Task) -> Answer:
    """Fitted are those parameters that the readings tell apart at the start, by a QR of the derivative: with all of
    them two parallel axes lead to offsets of metres.
    """
    from pybotics.robot import Robot
    from scipy.linalg import qr
    from scipy.optimize import least_squares

    arm, q, seen = task.arm, task.q[task.train], 1e3 * task.position
    table, offsets = modified_dh(arm)
    n = len(q[0])

    def poses(x: Array, q: Array) -> Array:
        robot = Robot.from_parameters((table + x * np.tile(_ALONG, n)).reshape(n, 4))
        return np.array([robot.fk(row) for row in q + offsets])

    base, tool = align(poses(np.zeros(4 * n), q), seen)

    def placed(x: Array, q: Array) -> Array:
        turn, move, point = np.split(x[4 * n :], 3)
        moved = pose(rotation(1e-3 * turn) @ base[:3, :3], base[:3, 3] + move)
        return moved @ poses(x[: 4 * n], q) @ pose(np.eye(3), tool + point)

    def residual(x: Array) -> Array:
        return (placed(x, q)[:, :3, 3] - seen).ravel()

    count = 4 * n + 9
    still = residual(np.zeros(count))
    J = np.stack([(residual(1e-3 * row) - still) / 1e-3 for row in np.eye(count)], axis=1)
    _, R, order = qr(J, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    chosen = np.sort(order[: len(size)][size > 1e-3 * size[0]])
    done = least_squares(lambda v: residual(np.eye(count)[:, chosen] @ v), np.zeros(len(chosen)), max_nfev=20)
    T = placed(np.eye(count)[:, chosen] @ done.x, task.q)
    T[:, :3, 3] *= 1e-3
    return Answer(T, parameters=len(chosen), remark=done.message, oriented=False)


def modified_dh(arm: Arm) -> tuple[Array, Array]:
    """Rows alpha, a, theta, d [rad, mm] (4 n,) of an arm without its base and tool, and offsets (n,) of its joints.

    The frame of each joint lies where the common normal to the next axis leaves its own.
    """
    T = arm.frames(np.zeros((1, len(arm.names))))[0, :-1]
    points, axes = 1e3 * T[:, :3, 3], T[:, :3, 2]
    origins, xs = [], []
    for k in range(len(T) - 1):
        (p, z), (p2, z2) = (points[k], axes[k]), (points[k + 1], axes[k + 1])
        normal = np.cross(z, z2)
        if np.linalg.norm(normal) > _PARALLEL:
            s = np.linalg.solve(np.stack([z, -z2, normal], axis=1), p2 - p)
            origin = p + s[0] * z
            gap = s[2] * normal
            x = gap if np.linalg.norm(gap) > _PARALLEL else normal
        else:
            gap = (p2 - p) - (p2 - p) @ z * z
            origin = p
            x = gap if np.linalg.norm(gap) > _PARALLEL else T[k, :3, 0]
        origins.append(origin)
        xs.append(x / np.linalg.norm(x))
    origins.append(points[-1])
    xs.append(T[-1, :3, 0] - T[-1, :3, 0] @ axes[-1] * axes[-1])
    rows, offsets = [np.zeros(4)], [0.0]
    for k in range(1, len(T)):
        x, z, z2 = xs[k - 1], axes[k - 1], axes[k]
        alpha = np.arctan2(np.cross(z, z2) @ x, z @ z2)
        gap = origins[k] - origins[k - 1]
        theta = np.arctan2(np.cross(x, xs[k]) @ z2, x @ xs[k])
        rows.append(np.array([alpha, gap @ x, 0.0, gap @ z2]))
        offsets.append(theta)
    return np.concatenate(rows), np.array(offsets)
