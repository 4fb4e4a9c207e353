"""Where the tool is expected while something is opened: a pull into the unknown, then the way that a model knows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.articulation.joints import JointModel
from modcal_core.errors import BadCommand
from modcal_core.geometry.single import along_screw, crossed, posed, rotation_vector, turned
from modcal_core.geometry.so3 import Array

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
        length = float(np.linalg.norm(direction))
        if not (math.isfinite(length) and length > 1e-6):
            raise BadCommand(f"direction {np.asarray(direction).tolist()}", "has no length", "give x y z of the pull")
        self.direction = np.asarray(direction, dtype=float) / length
        self.way = 0.0  # m that it has gone on
        self._d = self.start[:3, :3] @ self.direction
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
            d = self._d + share * (chord / far - self._d)
            self._d = d / math.sqrt(d @ d)
        return self._d

    def progress(self, T_measured: Array) -> float:
        """How far the tool has come [m], at the pose (4, 4) it is measured at."""
        return float(np.linalg.norm(T_measured[:3, 3] - self.start[:3, 3]))

    @property
    def moved(self) -> Array:
        """The direction (3,) in the base in which it pulls now."""
        return self._d


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
