"""MUKCa's formulation (Franzese et al. 2025): joints alone, the ball at rest in two sockets a known distance apart."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from league.arm import Array, pose, rotation
from league.task import Answer, Task

WEIGHT = 1e-4  # of a squared change of a joint's origin, m² and rad², as published


def answer(task: Task) -> Answer:
    """Six errors of every joint's origin and of the ball, so that sockets are points, the right distance apart, and
    origins near their nominal ones.
    """
    arm, q, frame = task.arm, task.q[task.train], task.frame[task.train]

    def bent(x: Array) -> Array:
        twist = x.reshape(-1, 6)
        return arm.steps @ pose(rotation(twist[:, 3:]), twist[:, :3])

    def residual(x: Array) -> Array:
        p, parts = arm.frames(q, bent(x))[:, -1, :3, 3], []
        for pair in task.pairs:
            own = [p[frame == f] for f in pair]
            size = np.sqrt(sum(len(seen) for seen in own))
            parts += [(seen - seen.mean(axis=0)).ravel() / size for seen in own]
            gap = np.linalg.norm(own[0].mean(axis=0) - own[1].mean(axis=0))
            parts.append(np.array([gap - task.distance]))
        return np.concatenate([*parts, np.sqrt(len(task.pairs) * WEIGHT) * x[:-6]])

    done = least_squares(residual, np.zeros(6 * len(arm.steps)), max_nfev=30)
    return Answer(arm.frames(task.q, bent(done.x))[:, -1], parameters=len(done.x), remark=done.message, oriented=False)
