"""The joints that follow a wanted pose smoothly: one step of Newton's method a tick, within speeds and accelerations.

The wanted pose may jump; what comes out does not. The way to it is taken with v = min(e / h, √(a e), v_max), and v
changes by no more than a h. Joints share what the arm can do: their step is cut as a whole, so that the tool stays on
its way, and what an arm has to spare goes towards a posture that was chosen beforehand.
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.geometry import Array, rotation_vector, se3
from modcal_core.impedance.safety_monitor import Limits
from modcal_core.robots import Chain, pose_and_jacobian

_SHARE = 0.8  # of the guard's limits that is used
_DAMPED = 1e-8 * np.eye(6)
_SPARE = 0.5  # 1/s at which spare joints go to the chosen posture
_EDGE = 1e-4  # rad or m from a limit where a joint stops


class SetpointFilter:
    """q (n,), velocity (n,), pose (4, 4) and jacobian (6, n) of the last step. offset (4, 4): pose = offset · FK(q).

    The offset is the identity unless the tool is measured by something that knows better than the chain does.
    """

    def __init__(self, chain: Chain, limits: Limits) -> None:
        self.chain, self.limits = chain, limits
        self.offset = np.eye(4)
        self.q, self.velocity = np.zeros(chain.n), np.zeros(chain.n)
        self.pose, self.jacobian = np.eye(4), np.zeros((6, chain.n))
        self._rates = np.zeros(6)  # of the tool, in the base
        self._h = limits.period

    def begin(self, q: Array, T_base_tool: Array) -> None:
        """Stand at joints (n,), where the tool is measured to be at a pose (4, 4)."""
        self.q = np.array(q, dtype=float)
        T, self.jacobian = pose_and_jacobian(self.chain, self.q)
        self.offset = T_base_tool @ se3.inverse(T)
        self.pose = self.offset @ T
        self.rest()

    def rest(self) -> None:
        """Stand still where it is; the next step begins from there."""
        self.velocity, self._rates = np.zeros(self.chain.n), np.zeros(6)
        self._h = self.limits.period

    def step(self, goal: Array, h: float, chosen: Array | None = None) -> None:
        """Go on towards a pose (4, 4) of the tool for h seconds. chosen (n,): posture that spare joints go to."""
        limits = self.limits
        span = min(h, 0.5 * (h + self._h))
        R = self.pose[:3, :3]
        way = _approach(
            goal[:3, 3] - self.pose[:3, 3],
            self._rates[:3],
            _SHARE * limits.speed,
            _SHARE * limits.acceleration,
            h,
            span,
        )
        turn = _approach(
            R @ rotation_vector(R.T @ goal[:3, :3]),
            self._rates[3:],
            _SHARE * limits.angular_speed,
            _SHARE * limits.angular_acceleration,
            h,
            span,
        )
        velocity = self._joint_speeds(np.concatenate([R.T @ way, R.T @ turn]), chosen)
        velocity = self._within(velocity, span)
        before = self.pose
        self.q, self.velocity = self.q + h * velocity, velocity
        T, self.jacobian = pose_and_jacobian(self.chain, self.q)
        self.pose = self.offset @ T
        D = self.pose[:3, :3] @ before[:3, :3].T
        self._rates = np.concatenate([self.pose[:3, 3] - before[:3, 3], rotation_vector(D)]) / h
        self._h = h

    def moved_by(self, wrench: Array) -> tuple[float, float]:
        """How far a wrench (6,), and one newton at most, moves the tool, joints yielding by 1 rad to 1 N m [N m²]."""
        J = self.jacobian
        way = J[:3] @ (J.T @ wrench)
        return math.sqrt(way @ way), float(np.linalg.eigvalsh(J[:3] @ J[:3].T)[-1])

    def lag(self, goal: Array) -> float:
        """How far the tool has stayed behind a pose (4, 4) [m]."""
        return float(np.linalg.norm(goal[:3, 3] - self.pose[:3, 3]))

    def _joint_speeds(self, twist: Array, chosen: Array | None) -> Array:
        """Joint speeds (n,) for a body twist (6,) of the tool."""
        J = self.jacobian
        A = J @ J.T + _DAMPED
        if chosen is None or self.chain.n <= 6:
            return J.T @ np.linalg.solve(A, twist)
        spare = np.clip(_SPARE * (chosen - self.q), -0.2, 0.2)
        return spare + J.T @ np.linalg.solve(A, twist - J @ spare)

    def _within(self, wish: Array, span: float) -> Array:
        """Joint speeds nearest to a wish (n,), in its direction, that joints can take up within ``span`` [s]."""
        limits, chain = self.limits, self.chain
        most, change = _SHARE * limits.joint_speed, _SHARE * limits.joint_acceleration
        wish = wish * min(1.0, 1.0 / max(float((np.abs(wish) / most).max()), 1e-9))
        step = wish - self.velocity
        share = min(1.0, span / max(float((np.abs(step) / change).max()), 1e-9))
        if (np.abs(self.velocity) > most).any():  # of limits that were lowered: the tool has limits for braking as well
            rates = self.jacobian @ step
            for part, allowed in ((rates[:3], limits.acceleration), (rates[3:], limits.angular_acceleration)):
                share = min(share, _SHARE * allowed * span / max(math.sqrt(part @ part), 1e-9))
        velocity = self.velocity + step * share
        # before a limit a joint brakes, at half the acceleration that it may have, and alone
        up = np.sqrt(change * np.maximum(chain.upper - _EDGE - self.q, 0.0))
        down = np.sqrt(change * np.maximum(self.q - chain.lower - _EDGE, 0.0))
        return np.clip(velocity, -down, up)


def _approach(e: Array, now: Array, most: float, change: float, h: float, span: float) -> Array:
    """The speed (3,) with which to make up for what is missing, e (3,), having a speed (3,) now."""
    far = math.sqrt(e @ e)
    speed = min(far / h, math.sqrt(change * far), most)
    step = e * (speed / far) - now if far > 1e-12 else -now
    size = math.sqrt(step @ step)
    return now + step * min(1.0, change * span / size) if size > 0.0 else now
