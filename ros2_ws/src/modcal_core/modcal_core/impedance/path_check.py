"""Whether an arm can lead its tool along a whole path, before it begins: joints for every pose, or where it ends.

The path is walked from the posture that the arm has, pose by pose, with Newton's method; what the arm has to spare
turns joints away from their limits. A walk can be taken in pieces, so that a control loop goes on meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import NotReachable
from modcal_core.geometry.single import pose_error
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import pose_and_jacobian

_METRES, _RADIANS = 1e-4, 1e-3  # met by every pose of the path
_TRIES = 12  # steps a pose
_STEP = 0.3  # rad or m, of one joint in one step
_CLOSE = 0.4  # rad from a limit where spare joints begin to turn away
_AWAY = 0.15  # of that distance in one step


@dataclass(frozen=True)
class Reach:
    """joints (k, n): postures of the first k poses. whole: whether these are all. why: what the next one breaks."""

    joints: Array
    whole: bool
    why: str = ""

    def require(self, what: str = "path") -> Reach:
        """Itself. Raises NotReachable unless it is whole."""
        if not self.whole:
            raise NotReachable(what, self.why, "place the arm differently before it grasps, or open less far")
        return self

    def posture(self, share: float) -> Array:
        """The posture (n,) at a share of the path, 0 … 1."""
        at = min(max(share, 0.0), 1.0) * (len(self.joints) - 1)
        k = min(int(at), len(self.joints) - 2) if len(self.joints) > 1 else 0
        low, high = self.joints[k], self.joints[min(k + 1, len(self.joints) - 1)]
        return low + (at - k) * (high - low)


class PathCheck:
    """Check along a path of poses, some steps for each call."""

    def __init__(
        self,
        chain: Chain,
        poses: Sequence[Array],
        q0: Array,
        margin: float = 0.02,
        gain: float = 0.03,
        stride: float = 0.35,
    ) -> None:
        """poses: m of T_base_tip (4, 4), so close that no joint moves by more than ``stride`` between two.

        margin: distance of joints to their limits [rad or m]. gain: least singular value of the Jacobian.
        """
        self._chain, self._poses = chain, poses
        self._lower, self._upper = chain.lower + margin, chain.upper - margin
        self._gain, self._stride = gain, stride
        self._q = np.clip(q0, chain.lower, chain.upper)
        self._before = self._q
        self._tries = 0
        self._joints: list[Array] = []
        self.result: Reach | None = None

    def advance(self, steps: int) -> Reach | None:
        """Go on for some steps of Newton's method; the result when there is one."""
        for _ in range(steps):
            if self.result is not None:
                break
            self._step()
        return self.result

    def _step(self) -> None:
        chain, k = self._chain, len(self._joints)
        T, J = pose_and_jacobian(chain, self._q)
        e = pose_error(T, self._poses[k])
        within = bool(((self._q >= self._lower) & (self._q <= self._upper)).all())
        met = float(np.abs(e[:3]).max()) <= _METRES and float(np.abs(e[3:]).max()) <= _RADIANS
        if met and (within or self._tries >= _TRIES):
            self._arrive(J)
        elif self._tries >= _TRIES:
            far = f"{1e3 * float(np.linalg.norm(e[:3])):.3g} mm and {float(np.linalg.norm(e[3:])):.3g} rad"
            at_limit = [chain.names[j] for j in np.flatnonzero((self._q <= chain.lower) | (self._q >= chain.upper))]
            self._end(f"missed by {far}" + (f" with {', '.join(at_limit)} at its limit" if at_limit else ""))
        else:
            self._tries += 1
            self._q = self._moved(J, e)

    def _moved(self, J: Array, e: Array) -> Array:
        """The next posture: towards the pose, and where joints are to spare, away from limits."""
        chain, q = self._chain, self._q
        # where a side has no limit the distance is infinite and nothing pushes
        push = np.maximum(_CLOSE - (q - self._lower), 0.0) - np.maximum(_CLOSE - (self._upper - q), 0.0)
        away = _AWAY * push if chain.n > 6 else np.zeros(chain.n)
        free = np.ones(chain.n)
        step = away
        for _ in range(chain.n):
            B = J * free
            A = B @ B.T + 1e-8 * np.eye(6)
            step = free * (away + B.T @ np.linalg.solve(A, e - B @ away))
            step *= min(1.0, _STEP / max(float(np.abs(step).max()), 1e-9))
            out = (free > 0.0) & ((q + step > chain.upper) | (q + step < chain.lower))
            if not out.any():
                break
            free[out] = 0.0
        return np.clip(q + step, chain.lower, chain.upper)

    def _arrive(self, J: Array) -> None:
        chain, q, k = self._chain, self._q, len(self._joints)
        near = (q < self._lower) | (q > self._upper)
        gain = float(np.sqrt(max(np.linalg.eigvalsh(J @ J.T)[0], 0.0))) if chain.n >= 6 else self._gain
        moved = np.abs(q - self._before)
        if near.any():
            j = int(np.argmax(near))
            limit = (chain.upper if q[j] > self._upper[j] else chain.lower)[j]
            self._end(f"{chain.names[j]} reaches its limit of {limit:.3g} {'rad' if chain.revolute[j] else 'm'}")
        elif gain < self._gain:
            self._end(f"the arm is next to singular (gain {gain:.3g}, {self._gain:g} is the limit)")
        elif k > 0 and moved.max() > self._stride:
            j = int(np.argmax(moved))
            self._end(f"{chain.names[j]} would jump by {moved[j]:.2g}")
        else:
            self._joints.append(q)
            self._before, self._tries = q, 0
            if len(self._joints) == len(self._poses):
                self.result = Reach(np.array(self._joints), True)

    def _end(self, why: str) -> None:
        k, m = len(self._joints), len(self._poses)
        joints = np.array(self._joints).reshape(-1, self._chain.n)
        self.result = Reach(joints, False, f"{100.0 * k / max(m - 1, 1):.0f} % of the path is reached, then {why}")
