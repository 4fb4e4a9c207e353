"""Nominal arm, and the least squares that robot_calibration poses, solved by SciPy without a prior."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares as scipy_least_squares

from league import geometry
from league.arm import Array, pose, quaternion_rotation, rotation, rotation_vector
from league.task import Answer, Task

TURNS = 0.3  # m: what an error of orientation counts beside one of position, as robot_calibration scales them


def nominal(task: Task) -> Answer:
    """Base and tool alone are fitted."""
    found = geometry.fit(task, geometry=False)
    return Answer(found.predict(task.q)[0], parameters=12)


def offsets(task: Task) -> Answer:
    """Zeros of the joints, base and tool."""
    return _solved(task, links=False)


def least_squares(task: Task) -> Answer:
    """Six errors of every link, base and tool; those that are not independent end somewhere in their valley."""
    return _solved(task, links=True)


def _solved(task: Task, links: bool) -> Answer:
    arm, q = task.arm, task.q[task.train]
    n = len(arm.names)
    start = geometry.fit(task, geometry=False).steps

    def bent(x: Array) -> Array:
        twist = np.zeros((n + 1, 6))
        twist[0], twist[-1] = x[:6], x[-6:]
        if links:
            twist[1:-1] = x[6:-6].reshape(n - 1, 6)
        return start @ pose(rotation(twist[:, 3:]), twist[:, :3])

    def tips(x: Array, q: Array) -> Array:
        return arm.frames(q if links else q + x[6:-6], bent(x))[:, -1]

    def residual(x: Array) -> Array:
        T = tips(x, q)
        r = (T[:, :3, 3] - task.position).ravel()
        if task.kind == "point":
            return r
        off = np.swapaxes(T[:, :3, :3], 1, 2) @ quaternion_rotation(task.reading[:, 3:])
        return np.r_[r, TURNS * rotation_vector(off).ravel()]

    free = 12 + (6 * (n - 1) if links else n)
    done = scipy_least_squares(residual, np.zeros(free), method="trf", x_scale=1.0, max_nfev=60)
    return Answer(tips(done.x, task.q), parameters=free, remark=done.message)
