"""What calibration asks of a robot, whatever it is built like: today a serial chain or a Delta.

:class:`Mechanism` is what such a class has to offer. The functions here are the ones whose formulas differ and that
need kinematics; each class registers its own (:func:`functools.singledispatch`).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from typing import Protocol, Self, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import Array
from modcal_core.robots import bodies, delta_kinematics, kinematics
from modcal_core.robots.chain import Chain, Follower
from modcal_core.robots.delta import Delta
from modcal_core.robots.kinematics import Frames
from modcal_core.robots.urdf_inertias import HeldBehind, Inertias

_STEP = 0.1  # rad, on a way that is looked at


class Mechanism(Protocol):
    """A robot: n joints at places ``first_place`` …, a tool at ``tool_place``, between a base and a tip link."""

    @property
    def names(self) -> tuple[str, ...]:
        """The joints that move, n of them."""

    @property
    def links(self) -> tuple[str, ...]:
        """The link in front of each joint, where the robot names them; empty otherwise."""

    @property
    def base(self) -> str:
        """Name of the base link."""

    @property
    def tip(self) -> str:
        """Name of the tip link."""

    @property
    def n(self) -> int:
        """Number of joints."""

    @property
    def revolute(self) -> np.ndarray:
        """True where a joint turns, False where it slides, (n,)."""

    @property
    def lower(self) -> Array:
        """Lower limits (n,) [rad or m]; −inf where the robot states none."""

    @property
    def upper(self) -> Array:
        """Upper limits (n,) [rad or m]; inf where the robot states none."""

    @property
    def first_place(self) -> int:
        """The place of the first joint."""

    @property
    def tool_place(self) -> int:
        """The place of the tool."""

    @property
    def T_base_root(self) -> Array:
        """The frame that the places are counted from, in the base, (4, 4)."""

    @property
    def joint_basis(self) -> Array:
        """For each joint the directions (columns) in which errors of its place are counted, (n, 3, 3)."""

    @property
    def closed(self) -> bool:
        """Whether its links form loops, so that there are postures within the limits that it cannot take."""

    def reach(self) -> float:
        """An upper bound on the distance from the first joint to the tip [m]."""

    def length_direction(self, k: int) -> Array:
        """Unit vector along the link that ends in place k, in that place's frame, (3,); zero where it has no length."""

    def digits(self) -> bytes:
        """The nominal kinematics to 1 nm and 1 nrad, as bytes that differ where they do."""

    def with_limits(self, lower: ArrayLike, upper: ArrayLike) -> Self:
        """The robot with other limits of its joints [rad or m], (n,) each."""

    def with_errors(self, E: Array, constants: Array) -> Self:
        """The robot with small motions E of its places behind the first, the tool's last, (n, 4, 4), and errors of its
        joints' constants (k, 3), of which each kind of robot takes what it has.
        """


@singledispatch
def forward(robot: Mechanism, q: ArrayLike) -> Array:
    """Tip poses T_base_tip (..., 4, 4) for joint positions q (..., n) [rad, m].

    Raises NotReachable for postures that a Delta cannot take.
    """
    raise NotImplementedError(type(robot).__name__)


forward.register(Chain, kinematics.chain_forward)
forward.register(Delta, delta_kinematics.forward)


@singledispatch
def tool_frames(robot: Mechanism, T_tip_tool: Array, q: ArrayLike, twists: Mapping[int, Array] | None = None) -> Frames:
    """Frames of every place up to the tool, seen from the root, for joint positions q (N, n) [rad, m].

    T_tip_tool: (4, 4) [m]. twists: small motions (6, N) [m, rad] put in at places, each in the frame of its place.
    Postures that a Delta cannot take are NaN.
    """
    raise NotImplementedError(type(robot).__name__)


@tool_frames.register
def _(robot: Delta, T_tip_tool: Array, q: ArrayLike, twists: Mapping[int, Array] | None = None) -> Frames:
    return delta_kinematics.frames(robot, q, twists, T_tip_tool)


@tool_frames.register
def _(robot: Chain, T_tip_tool: Array, q: ArrayLike, twists: Mapping[int, Array] | None = None) -> Frames:
    return kinematics.frames(robot.from_root_to(T_tip_tool), q, twists)


@singledispatch
def payload_wrench(robot: Mechanism, q: Array, down: Array = bodies.DOWN, held: HeldBehind | None = None) -> Array:
    """Weight of 1 kg at the tip as every joint bears it, (n, 6, N), as in :mod:`modcal_core.robots.bodies`."""
    raise NotImplementedError(type(robot).__name__)


payload_wrench.register(Chain, bodies.payload_wrench)


@payload_wrench.register
def _(robot: Delta, q: Array, down: Array = bodies.DOWN, held: HeldBehind | None = None) -> Array:
    return delta_kinematics.payload_wrench(robot, q, bodies.STANDARD_GRAVITY)


@singledispatch
def offset_wrench(robot: Mechanism, q: Array, down: Array = bodies.DOWN, held: HeldBehind | None = None) -> Array:
    """How the weight of 1 kg as every joint bears it changes with its offset from the tip, (3, n, 6, N), as in
    :mod:`modcal_core.robots.bodies`; of others than serial arms nothing is known of it, and it is zero.
    """
    return np.zeros((3, robot.n, 6, len(np.asarray(q))))


offset_wrench.register(Chain, bodies.offset_wrench)


@singledispatch
def gravity_wrench(robot: Mechanism, inertias: Inertias, q: ArrayLike, moved: Array | None = None) -> Array:
    """Weight of the links beyond each joint, (n, 6, N), as in :mod:`modcal_core.robots.bodies`; of others than serial
    arms nothing is known of it, and it is zero.
    """
    return np.zeros((robot.n, 6, len(np.asarray(q))))


gravity_wrench.register(Chain, bodies.chain_gravity_wrench)


@singledispatch
def takes(robot: Mechanism, q: Array) -> np.ndarray:
    """Which postures (N, n) the robot can take, apart from its limits, (N,): a Delta's platform must fit its arms."""
    return np.ones(len(q), dtype=bool)


takes.register(Delta, delta_kinematics.reachable)


def is_serial_arm(robot: Mechanism) -> TypeGuard[Chain]:
    """Whether the robot is a serial chain: what is known of such only, asks here and passes over others."""
    return isinstance(robot, Chain)


def followers_of(robot: Mechanism) -> tuple[Follower, ...]:
    """Its joints that mimic another one."""
    return robot.follows if is_serial_arm(robot) else ()


def is_delta(robot: object) -> TypeGuard[Delta]:
    """Whether the robot is a Delta, for what only its parallelograms have."""
    return isinstance(robot, Delta)


def passable(robot: Mechanism, start: Array, end: Array) -> bool:
    """Whether a robot can go straight from one posture (n,) to another: a Delta's platform must fit all the way."""
    if not robot.closed:
        return True
    steps = max(int(np.ceil(np.abs(end - start).max() / _STEP)), 1)
    between = start + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - start)
    return bool(takes(robot, between).all())


def random_postures(robot: Mechanism, count: int, rng: np.random.Generator) -> Array:
    """Joint positions (count, n), uniform within the limits; a full turn, or ±0.5 m, where there is none.

    Of a Delta, only postures that its platform can take.
    """
    span = np.where(robot.revolute, np.pi, 0.5)
    low = np.where(np.isfinite(robot.lower), robot.lower, -span)
    high = np.where(np.isfinite(robot.upper), robot.upper, span)
    if is_serial_arm(robot):
        return robot.followed(rng.uniform(low, high, (count, robot.n)))
    found = np.empty((0, robot.n))
    for _ in range(1000):
        q = rng.uniform(low, high, (4 * count, robot.n))
        found = np.concatenate([found, q[takes(robot, q)]])
        if len(found) >= count:
            break
    return found[:count]
