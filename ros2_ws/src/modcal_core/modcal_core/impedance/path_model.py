"""Where the tool is expected while something is opened: a pull into the unknown, then the way that a model knows.

The path is walked from the posture that the arm has, pose by pose, with Newton's method, in pieces, so that a control
loop goes on meanwhile; what the arm has to spare turns joints away from their limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.articulation import JointModel
from modcal_core.errors import BadCommand, NotReachable
from modcal_core.geometry import Array, along_screw, crossed, pose_error, posed, rotation_vector, turned
from modcal_core.impedance.impedance import axes_along
from modcal_core.robots import Chain, pose_and_jacobian

_LED = 0.9  # share of what the tool was led aside that is expected to go on; below one, or nothing would bring it back
# The same of how it was turned. What is left resists: about a hinge of 20 cm, a share of 0.1 of 30° against 20 N m/rad,
# and of its speed against 80 N m s/rad, is felt as 9 N at the handle, more than most doors need.
_TURNED = 0.97
_LED_AFTER = 0.1  # s
_HARDLY = 0.05  # rad that say nothing of whether the tool turns along
_TRAIL_STEP, _TRAIL = 0.003, 6  # m, and how many of them the direction is taken from
_STEP_M, _STEP_RAD = 0.015, 0.05  # between poses of a path
# m; no door is this wide. What seems to turn about an axis farther off slides, for all that can be told, and is opened
# as far as what slides: a drawer that is taken for a circle of 8 m for a moment must not be opened by 60° of it
_SLIDES_BEYOND = 1.5


class Exploration:
    """The expected pose while the way is unknown: along the expected direction at first, then where the tool is led.
    moved (3,): the direction in the base in which it pulls now.

    What leads the tool aside or turns it is followed, so that a hinge need not fight the arm: a door that turns the
    hand by 10° over 10 cm would otherwise have to turn it against the damping of the impedance law.
    """

    def __init__(self, T_base_tool: Array, direction: Array, aside: float = 0.03) -> None:
        """Begin at a pose (4, 4). direction (3,): of the pull, seen from the tool. aside: fastest it is led so [m/s].

        Without a limit, a pose that is centimetres ahead, as one is that turns a hand against its damping about a near
        axis, would be swung across to the new direction in a tenth of a second, and the hand with it.
        """
        self._fastest = aside
        self.start, self.pose = np.array(T_base_tool), np.array(T_base_tool)
        self.way = 0.0  # m that it has gone on
        self.moved = self.start[:3, :3] @ axes_along(direction)[:, 0]
        self._trail = [self.start[:3, 3].copy()]  # of the tool, every few millimetres
        self._line = self.start[:3, 3].copy()
        self._aside, self._turn = np.zeros(3), np.zeros(3)

    def advance(self, ds: float, T_measured: Array, h: float, T_sent: Array | None = None) -> Array:
        """The expected pose (4, 4) after ds [m] more, with the tool measured at a pose (4, 4), h seconds later.

        T_sent (4, 4): where the tool was sent, which yields to moments; None where the stack that follows does. By
        what servos yield to a force the tool is turned as well, and to go on with that would turn it ever farther.
        """
        share = h / (h + _LED_AFTER)
        R0 = self.start[:3, :3]
        turn = rotation_vector((T_measured if T_sent is None else T_sent)[:3, :3] @ R0.T)
        self._turn = self._turn + share * (_TURNED * turn - self._turn)
        R = turned(self._turn) @ R0
        d = self._towards(T_measured[:3, 3], share)
        self.way += ds
        self._line = self._line + ds * d
        off = T_measured[:3, 3] - self._line
        off = off - (off @ d) * d
        led = share * (_LED * off - self._aside)
        self._aside = self._aside + led * min(1.0, self._fastest * h / max(math.sqrt(led @ led), 1e-12))
        self.pose = posed(R, self._line + self._aside)
        return self.pose

    def _towards(self, p: Array, share: float) -> Array:
        """The direction (3,) in the base: the one in which the tool came the last centimetres, once it has come."""
        if math.dist(p, self._trail[-1]) >= _TRAIL_STEP:
            self._trail = [*self._trail[-_TRAIL:], p.copy()]
        chord = p - self._trail[0]
        far = math.sqrt(chord @ chord)
        if len(self._trail) > _TRAIL and far > 0.5 * _TRAIL * _TRAIL_STEP:
            d = self.moved + share * (chord / far - self.moved)
            self.moved = d / math.sqrt(d @ d)
        return self.moved

    def progress(self, T_measured: Array) -> float:
        """How far the tool has come [m], at the pose (4, 4) it is measured at."""
        return float(np.linalg.norm(T_measured[:3, 3] - self.start[:3, 3]))


class PathModel:
    """The way of a handle that a model knows, from where it was closed to a goal."""

    def __init__(
        self, model: JointModel, closed: Array, now: Array, ahead: Array, goal_rad: float, goal_m: float, over: float
    ) -> None:
        """model: of the tool's poses in the base. closed, now (4, 4): the tool when it was closed and as it is.

        ahead (3,): the direction in the base in which it opens. goal_rad, goal_m: from closed, for what turns and what
        slides. over: way [m] beyond the goal to which it may be expected, to make up for what the hand yields.
        Raises BadCommand for a model of something that does not move.
        """
        self._closed, self._goals, self._over = closed, (goal_rad, goal_m), over
        self._ahead = ahead
        self.take(model, now)

    def take(self, model: JointModel, expected: Array) -> Array:
        """Pose (4, 4) on a new model that is nearest to the expected one (4, 4); the path continues there."""
        self.per_unit = model.length_per_unit
        if not self.per_unit > 1e-3:
            said = f"a handle that moves {1e3 * self.per_unit:.3g} mm per unit cannot be opened"
            raise BadCommand(f"model of the object ({model.kind})", said, "check whether it is locked")
        self.model = model
        self._twist = model.twist()
        at = self.configuration(expected)
        # where only positions were seen, the tool's own orientation is turned along, or kept
        self._origin, self._origin_at = (model.start, 0.0) if model.oriented else (expected, at)
        self._turns = model.oriented or self._turned_along(expected, at)
        v = self._twist[:3] + crossed(self._twist[3:], expected[:3, 3])
        self.sign = 1.0 if v @ self._ahead >= 0.0 else -1.0
        self.closed_at = self.configuration(self._closed)
        self.turns = bool(model.turns and model.radius < _SLIDES_BEYOND)
        goal = self._goals[0] if self.turns else self._goals[1] / self.per_unit
        self.goal_at = self.closed_at + self.sign * goal
        self.at = at
        return self.pose(self.at)

    def configuration(self, T: Array) -> float:
        """The configuration nearest to a pose (4, 4)."""
        return float(self.model.configuration(T if self.model.oriented else T[:3, 3]))

    def pose(self, a: float) -> Array:
        """The expected tool (4, 4) at a configuration."""
        return _posed(self._origin, (a - self._origin_at) * self._twist, self._turns)

    def _turned_along(self, T: Array, at: float) -> bool:
        """Whether the tool has turned with the object so far, as a firm grasp does, rather than stayed as it was."""
        moved = at - self.configuration(self._closed)
        turn = float(rotation_vector(T[:3, :3] @ self._closed[:3, :3].T) @ self.model.axis)
        return abs(moved) < _HARDLY or turn / moved > 0.5

    def advance(self, ds: float) -> Array:
        """The expected pose (4, 4) after ds [m] more, or as far beyond the goal as it may be."""
        last = self.goal_at + self.sign * self._over / self.per_unit
        room = self.sign * (last - self.at) * self.per_unit
        self.at += self.sign * min(ds, max(room, 0.0)) / self.per_unit
        return self.pose(self.at)

    def left(self, a: float) -> float:
        """The way from a configuration to the goal [m], negative beyond it."""
        return self.sign * (self.goal_at - a) * self.per_unit

    @property
    def way(self) -> float:
        """The way from closed to the goal [m]."""
        return abs(self.goal_at - self.closed_at) * self.per_unit

    def opened(self, a: float) -> float:
        """How far it is open at a configuration of the model [its unit]."""
        return self.sign * (a - self.closed_at)

    def said(self, a: float) -> float:
        """Opening at a configuration [rad; m for what slides, or while the kind is unknown]."""
        return self.opened(a) if self.turns else self.opened(a) * self.per_unit

    def tangent(self) -> Array:
        """The direction (3,) in which it opens, seen from the expected tool."""
        T = self.pose(self.at)
        v = self.sign * (self._twist[:3] + crossed(self._twist[3:], T[:3, 3]))
        return T[:3, :3].T @ (v / np.linalg.norm(v))

    def path(self, T_nominal: ArrayLike | None = None) -> Path:
        """Poses from where it is expected now to the goal, all multiplied by ``T_nominal`` (4, 4) from the left."""
        span = self.goal_at - self.at
        steps = max(abs(span) * self.per_unit / _STEP_M, abs(span) / _STEP_RAD if self.model.turns else 0.0)
        configurations = np.linspace(self.at, self.goal_at, max(math.ceil(steps), 1) + 1)
        left = np.eye(4) if T_nominal is None else np.asarray(T_nominal, dtype=float)
        return Path(self._origin, self._twist, configurations - self._origin_at, self._turns, left)


class Path(Sequence[Array]):
    """Poses (4, 4) along a way, computed when asked for: a control loop has no time for all of them at once."""

    def __init__(self, origin: Array, twist: Array, configurations: Array, turns: bool, left: Array) -> None:
        self._origin, self._twist, self._configurations = origin, twist, configurations
        self._turns, self._left = turns, left

    def __len__(self) -> int:
        return len(self._configurations)

    def __getitem__(self, k: Any) -> Any:
        return self._left @ _posed(self._origin, float(self._configurations[k]) * self._twist, self._turns)


def _posed(origin: Array, xi: Array, turns: bool) -> Array:
    """The pose (4, 4) that a screw motion (6,) brings an origin to, turned along or not."""
    T = along_screw(origin, xi)
    if not turns:
        T[:3, :3] = origin[:3, :3]
    return T


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
