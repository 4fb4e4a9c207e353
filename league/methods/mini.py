"""A calibrator of a page: six errors a place, harmonics and a spring a joint, ridge."""

from __future__ import annotations

import numpy as np

from league import geometry
from league.arm import Arm, Array
from league.task import Answer, Task

HARMONICS, MORE = 20, 40  # a turn; gears of 17 teeth a turn and their neighbours are among them
WIDTH = 1.5e-4  # rad, of each coefficient


def _basis(count: int):  # type: ignore[no-untyped-def]
    def basis(arm: Arm, q: Array, torque: Array) -> list[Array]:
        """For each joint: sines and cosines of its angle, and the torque of a unit weight at the tip."""
        k = np.arange(1, count + 1)
        parts = [
            np.concatenate([np.sin(q[:, j, None] * k), np.cos(q[:, j, None] * k)], axis=1) for j in range(q.shape[1])
        ]
        return [np.concatenate([part, torque[:, j, None]], axis=1) for j, part in enumerate(parts)]

    return basis


def answer(task: Task) -> Answer:
    """Widths as stated."""
    return _answer(task, geometry.fit(task, basis=_basis(HARMONICS), width=WIDTH))


def learned(task: Task) -> Answer:
    """Widths of links and of each joint's functions learned."""
    return _answer(task, geometry.fit(task, basis=_basis(MORE), learn=True, width=WIDTH))


def _answer(task: Task, found: geometry.Fit) -> Answer:
    T, radius = found.predict(task.q)
    return Answer(T, radius95=radius, parameters=len(found.covariance))
