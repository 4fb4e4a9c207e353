"""A handle that turns about an axis: a door on hinges, a flap, a lever."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.articulation import furniture
from modcal_core.articulation.joint_motion import InUrdf, Kind, Motion, best_of, far_apart, few, scaled, some_three
from modcal_core.articulation.joints import JointModel, followed, placed, span, wrapped
from modcal_core.articulation.models.axis import AxisModel, AxisMotion, robust
from modcal_core.articulation.models.prismatic import line
from modcal_core.articulation.scene import LOG_2PI
from modcal_core.articulation.track import Track
from modcal_core.geometry import HAT, Array, crossed, rotation_vector, so3, turned

RADIUS = (2e-3, 200.0)  # m; beyond, a circle cannot be told from a turn on the spot, or from a line
# How far a turn weighs against a shift where one configuration must satisfy both: a hand is about this long.
_LENGTH = 0.1  # m


@dataclass(frozen=True)
class RevoluteJoint(JointModel):
    """ξ = (point × axis, axis)."""

    kind: ClassVar[str] = "revolute"
    turns: ClassVar[bool] = True

    @property
    def radius(self) -> float:
        """Distance [m] from the handle to the axis."""
        arm = self.start[:3, 3] - self.point
        arm = arm - self.axis * (self.axis @ arm)
        return math.sqrt(arm @ arm)

    @property
    def length_per_unit(self) -> float:
        """Path of the handle [m/rad]."""
        return math.hypot(self.radius, self.pitch)

    def configuration(self, seen: ArrayLike) -> Array:
        """As :meth:`JointModel.configuration`."""
        p, R = placed(seen)
        if not self.oriented:
            R = None
        arm = self.start[:3, 3] - self.point
        rise0 = float(arm @ self.axis)
        arm = arm - rise0 * self.axis
        r = math.sqrt(arm @ arm)
        across = crossed(self.axis, arm)
        x = p - self.point
        a = np.arctan2(x @ across, x @ arm)
        weight = 0.0
        if R is not None:
            # the turn about the axis that brings start nearest to R: its sine and cosine are linear in R
            S = self.start[:3, :3]
            sine, cosine = (self.axis @ HAT).reshape(3, 3) @ S, S - self.axis[:, None] * (self.axis @ S)
            flat = R.reshape(*R.shape[:-2], 9)
            about = np.arctan2(flat @ sine.ravel(), flat @ cosine.ravel())
            weight = _LENGTH**2 / (_LENGTH**2 + r * r)
            a = about + (1.0 - weight) * wrapped(a - about) if r > 0.0 else about
        return self.on_thread(wrapped(a), x, rise0, r, weight)

    def on_thread(self, a: Array, x: Array, rise0: float, r: float, weight: float) -> Array:
        """Configurations nearest to points x from the axis, where the angles are a: the same, but on a thread."""
        return a

    def sentence(self, a: Array, extent: float, std: Mapping[str, float]) -> str:
        """How far it turned, and how far away its axis is."""
        return f"turned {np.degrees(span(a)):.0f}° at {1e2 * self.radius:.0f} cm from its axis"


@dataclass(frozen=True)
class RevoluteMotion(AxisMotion):
    """It goes round the axis at p + r G[:, 1]."""

    kind: ClassVar[str] = "revolute"
    turns: ClassVar[bool] = True
    flat: ClassVar[bool] = True
    made: ClassVar[type[JointModel]] = RevoluteJoint
    frame_turns: ClassVar[int] = 3
    sizes: ClassVar[int] = 1
    radius_at: ClassVar[int] = -1  # which parameter from the end is log r

    @property
    def length_per_unit(self) -> float:
        """Path of the handle [m/rad]."""
        return math.hypot(self.r, self.h)

    @property
    def climb(self) -> tuple[float, float]:
        """Sine and cosine of the angle between the path and the circle that it goes round."""
        length = self.length_per_unit
        return self.h / length, self.r / length

    def resized(self, z: Array) -> tuple[float, float]:
        """The radius changed by its logarithm's step."""
        return scaled(self.r, z[0], RADIUS), self.h

    def counted(self, a: Array, sound: np.ndarray) -> Array:
        """Angles (n,) that go on beyond a turn; a thread has followed them already."""
        return followed(a, sound) if self.flat else a

    def along(self, y: Array, track: Track, sigma: tuple[float, float]) -> Array:
        """Angles (n,) [rad]: of positions, and of rotations where their noise is bounded."""
        x = y - np.array([0.0, self.r, 0.0])
        a = np.arctan2(x[:, 0], -x[:, 1])
        w = (np.hypot(x[:, 0], x[:, 1]) * self.r + 1e-12) / sigma[0] ** 2  # curvatures of both parts of the cost
        u = 0.0
        if self.R is not None and track.rotations is not None and sigma[1] < 1e6:
            Q = self.against_start(track)
            about = np.arctan2(Q[:, 1, 0] - Q[:, 0, 1], Q[:, 0, 0] + Q[:, 1, 1])  # nearest turn about the axis
            u = 1.0 / sigma[1] ** 2
            a = wrapped(about + wrapped(a - about) * w / (w + u))
        return self.along_thread(a, x, w, u, sigma[0])

    def along_thread(self, a: Array, x: Array, w: Array, u: float, sigma: float) -> Array:
        """Configurations (n,) where the angles are a: the same, but on a thread."""
        return a

    def by_shift(self) -> Array:
        """What no position changes (3, 3): how residuals shift with the start and log r, before unwinding."""
        rise, run = self.climb
        return np.array([[0.0, rise, 0.0], [-1.0, 0.0, -self.r], [0.0, -run, 0.0]])

    def unwind(self, part: Array, a: Array, both: Array, by_a: Array, derivatives: bool) -> Array:
        """Write what positions leave; Rz(−a) (n, 3, 3)."""
        part[:, 1, 0] -= self.r
        C = _unwinding(a)
        part = C @ part
        by_a[:, 0], by_a[:, 1], by_a[:, 2] = part[:, 1, 0], -part[:, 0, 0], -self.h
        part[:, 1, 0] += self.r
        part[:, 2, 0] -= self.h * a
        if not derivatives:
            both[:, :3, :1] = part
            return C
        part[:, 1, -1] += self.r
        # a turn of the start stands before the radius
        both[:, :3, :6], both[:, :3, self.radius_at] = part[:, :, :6], part[:, :, 6]
        return C

    def turns_apart(self, both: Array) -> tuple[Array, Array | None]:
        """Rotation residuals across the axis (k, 2, 1 + size), and those about it (k, 1, 1 + size)."""
        return both[:, 3:5], both[:, 5:]

    def priors(self) -> list[tuple[float, tuple[float, float]]]:
        """Logarithm of the radius with its prior."""
        return [(math.log(self.r), furniture.RADIUS)]

    def log_prior(self) -> float:
        """What the prior's density has beside its exponent, in the coordinates of the motion."""
        return super().log_prior() + (-LOG_2PI - math.log(furniture.RADIUS[1]) - 0.5 * LOG_2PI)

    def rarity(self) -> float:
        """Ties go to the nearer axis."""
        return 1e-3 * abs(np.log(self.r / 0.4))

    def at(self, a: float, R: Array) -> tuple[Array, Array, Array]:
        """The start turned about the axis, and the point that stays nearest to it."""
        axis, point = self.axis, self.p + self.r * self.G[:, 1]
        turn = turned(a * axis)
        rise = self.h * a * axis
        p = point + turn @ (self.p - point) + rise
        return p, point + rise, turn @ R if self.R is not None else R

    def own_gradients(self, turn: Array, shift: Array) -> dict[str, Array]:
        """Gradient of the point on the axis (3, size)."""
        arm = self.r * self.G[:, 1]
        point = shift - so3.hat(arm) @ turn
        point[:, self.start_turn + 3 * (self.R is not None)] += arm
        return {"point": point}


class Revolute(AxisModel):
    """Revolute joint. Its prior probability equals that of a prismatic joint."""

    name = "revolute"
    share = 0.49
    usual = True
    slots = (0, 2)
    urdf = InUrdf("revolute", np.pi)
    joint = RevoluteJoint

    def guesses(self, track: Track, rng: np.random.Generator) -> Sequence[Motion]:
        """Circles through three positions, and those that bring one pose to another."""
        some = few(track)
        return robust(circles(some, rng), some, RevoluteMotion)

    def quick_guess(self, track: Track, known: Mapping[Kind, Motion], turn: int) -> Motion | None:
        """Circle through the two samples that are farthest apart and one between, or from their poses."""
        first, between, last = far_apart(track)
        p, R = track.positions, track.rotations
        # guesses of hinges come every other turn, so that half of them are of points
        of_poses = None if R is None or (turn // 2) % 2 else _of_poses(p[first], R[first], p[last], R[last])
        found = of_poses or _of_points(p[first], p[between], p[last], None if R is None else R[between])
        # three on a line lie on no circle, but on many that are wide
        return found or line(RevoluteMotion, track)


def circles(track: Track, rng: np.random.Generator) -> Iterator[RevoluteMotion]:
    """Circles through samples that are drawn, by turns of points and of poses."""
    p, R = track.positions, track.rotations
    for t, (i, j, k) in some_three(track, rng):
        if R is not None and t % 2:
            guess = _of_poses(p[i], R[i], p[k], R[k])
        else:
            guess = _of_points(p[i], p[j], p[k], None if R is None else R[j])
        if guess is not None:
            yield guess


def best_circles(track: Track, rng: np.random.Generator, keep: int) -> list[RevoluteMotion]:
    """The ``keep`` best of the circles through drawn samples."""
    return best_of(circles(track, rng), track, keep)


def _of_points(a: Array, b: Array, c: Array, R: Array | None) -> RevoluteMotion | None:
    u, v = a - b, c - b
    w = crossed(u, v)
    ww = float(w @ w)
    if ww < 1e-16:
        return None
    arm = (float(u @ u) * crossed(v, w) + float(v @ v) * crossed(w, u)) / (2.0 * ww)
    return _circle(b, arm, -w, R)


def _of_poses(p1: Array, R1: Array, p2: Array, R2: Array) -> RevoluteMotion | None:
    w = rotation_vector(R2 @ R1.T)
    angle = math.sqrt(w @ w)
    if angle < 0.02:
        return None
    axis, d = w / angle, p2 - p1
    d = d - axis * (axis @ d)
    arm = 0.5 * (d + crossed(axis, d) / math.tan(0.5 * angle))
    return _circle(p1, arm, axis, R1)


def _circle(p: Array, arm: Array, axis: Array, R: Array | None) -> RevoluteMotion | None:
    r = math.sqrt(arm @ arm)
    if not RADIUS[0] < r < RADIUS[1]:
        return None
    n, d = arm / r, axis / math.sqrt(axis @ axis)
    return RevoluteMotion(p, np.array([crossed(n, d), n, d]).T, R, r)


def _unwinding(a: Array) -> Array:
    C = np.zeros((len(a), 3, 3))
    C[:, 0, 0] = C[:, 1, 1] = np.cos(a)
    C[:, 0, 1] = np.sin(a)
    C[:, 1, 0] = -C[:, 0, 1]
    C[:, 2, 2] = 1.0
    return C


MODEL = Revolute()
