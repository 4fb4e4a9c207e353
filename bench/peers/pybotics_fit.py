"""A UR10 fitted to positions by pybotics, as its documentation does. Usage: pybotics_fit.py SAMPLES.npz.

The file holds q (N, 6), position (N, 3), frame (4, 4): a guess of the base in the readings, and tool (4, 4). Fitted are
those of the DH parameters, the base and the tool's point that the readings tell apart at the start; printed is the RMS
of what is left, which the caller compares. With all of them it does not end: what two parallel axes lack in DH is
sought in offsets of metres.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

import numpy as np
from pybotics.robot import Robot
from scipy.linalg import qr
from scipy.optimize import least_squares

# pybotics counts in millimetres; its rows are alpha, a, theta, d before the joint (modified DH)
ROWS = [
    [0.0, 0.0, 0.0, 127.3],
    [np.pi / 2, 0.0, 0.0, 0.0],
    [0.0, -612.0, 0.0, 0.0],
    [0.0, -572.3, 0.0, 163.941],
    [np.pi / 2, 0.0, 0.0, 115.7],
    [-np.pi / 2, 0.0, 0.0, 92.2],
]


def turned(w: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector."""
    angle = np.linalg.norm(w)
    x, y, z = w / max(angle, 1e-300)
    W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * W + (1.0 - np.cos(angle)) * W @ W


def told_apart(residual: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Which parameters have columns of their own in the derivative at zero, by a QR that takes the largest first."""
    still = residual(np.zeros(33))
    J = np.stack([(residual(1e-3 * row) - still) / 1e-3 for row in np.eye(33)], axis=1)
    _, R, order = qr(J, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    return np.sort(order[size > 1e-3 * size[0]])


def main() -> None:
    data = np.load(sys.argv[1])
    q, seen = data["q"], 1e3 * data["position"]
    frame, tool = data["frame"], 1e3 * data["tool"][:3, 3]
    table = np.array(ROWS).ravel()

    def residual(x: np.ndarray) -> np.ndarray:
        robot = Robot.from_parameters((table + x[:24] * np.tile([1e-3, 1.0, 1e-3, 1.0], 6)).reshape(6, 4))
        R = turned(1e-3 * x[24:27]) @ frame[:3, :3]
        at = 1e3 * frame[:3, 3] + x[27:30]
        point = tool + x[30:33]
        T = np.array([robot.fk(row) for row in q])
        return ((T[:, :3, :3] @ point + T[:, :3, 3]) @ R.T + at - seen).ravel()

    begun = time.process_time()
    chosen = told_apart(residual)

    def of_chosen(values: np.ndarray) -> np.ndarray:
        x = np.zeros(33)
        x[chosen] = values
        return residual(x)

    found = least_squares(of_chosen, np.zeros(len(chosen)))
    ms = 1e3 * (time.process_time() - begun)
    rms = float(np.sqrt(np.mean(found.fun**2)))
    print(json.dumps({"ms": ms, "found": [rms], "remark": f"{len(chosen)} parameters, {1e3 * rms:.1f} um left"}))


if __name__ == "__main__":
    main()
