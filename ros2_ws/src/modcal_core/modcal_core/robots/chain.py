"""The serial chain as a product of exponentials.

The pose of the tip in the base is ``T(q) = M_0 exp(a_1 q_1) M_1 ... exp(a_n q_n) M_n``: constant transforms M_k, and
between them one joint each, turning about (or sliding along) a unit axis a_k fixed in the frame that M_{k-1} ends in.
This *local* form keeps every constant beside the joint it belongs to, which is where errors happen; moving all
constants to the right gives the *spatial* form ``exp(ξ_1 q_1) ... exp(ξ_n q_n) T(0)`` (Brockett 1984), see
:meth:`Chain.spatial_twists`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, se3

FREE_TURN, FREE_SLIDE = np.pi, 0.5  # rad, m; how far from zero a joint without limits is taken to go


def read_only(a: ArrayLike, dtype: type = float) -> np.ndarray:
    """A copy as an array that cannot be written to."""
    out: np.ndarray = np.array(a, dtype=dtype)
    out.flags.writeable = False
    return out


@dataclass(frozen=True)
class Follower:
    """The joint of this number in a chain that mimics another, its leader, which may be off the chain: it stands at
    ``factor`` times that one's position, plus ``offset``.
    """

    joint: int
    leader: str
    factor: float
    offset: float


@dataclass(frozen=True)
class JointColumns:
    """Which joints of an arm a message tells, and how. joints: their numbers (k,). columns: of the message (k,), for a
    joint that mimics another and is not named itself that of its leader. factor, offset: from there to the joint (k,).
    own: whether the joint is named itself (k,).
    """

    joints: np.ndarray
    columns: np.ndarray
    factor: Array
    offset: Array
    own: np.ndarray

    @staticmethod
    def of(joints: Sequence[str], follows: Sequence[Follower], names: Sequence[str]) -> JointColumns:
        """Those of messages of these names."""
        at = {name: i for i, name in enumerate(names)}
        rows = [(j, at[name], 1.0, 0.0, 1.0) for j, name in enumerate(joints) if name in at]
        led = [f for f in follows if joints[f.joint] not in at and f.leader in at]
        rows += [(f.joint, at[f.leader], f.factor, f.offset, 0.0) for f in led]
        joint, column, factor, offset, own = np.array(sorted(rows), dtype=float).reshape(-1, 5).T
        return JointColumns(joint.astype(int), column.astype(int), factor, offset, own > 0.0)

    def positions(self, told: Array) -> Array:
        """Positions (..., k) [rad, m] of the joints, from those of a message or track (..., m)."""
        return np.asarray(told)[..., self.columns] * self.factor + self.offset

    def velocities(self, told: Array) -> Array:
        """The same of velocities."""
        return np.asarray(told)[..., self.columns] * self.factor

    def efforts(self, told: Array) -> Array:
        """The same of efforts; NaN for a joint that only follows, whose drive is its leader's."""
        return np.where(self.own, np.asarray(told)[..., self.columns], np.nan)


@dataclass(frozen=True)
class Chain:
    """A serial arm from its base link to its tip link. Immutable; arrays are read-only.

    names: the n moving joints, base to tip.
    origins: M_0 … M_n, (n + 1, 4, 4) [m].
    axes: unit axes in their joint frames, (n, 3).
    revolute: True where the joint turns, False where it slides, (n,).
    lower, upper: limits [rad or m], (n,); ±inf where the robot states none.
    links: the link in front of each joint, where the robot names them; empty otherwise.
    follows: the joints that mimic another.
    """

    names: tuple[str, ...]
    origins: Array
    axes: Array
    revolute: np.ndarray
    lower: Array
    upper: Array
    base: str = "base"
    tip: str = "tip"
    links: tuple[str, ...] = ()
    follows: tuple[Follower, ...] = ()

    closed: ClassVar[bool] = False  # its links form no loops
    first_place: ClassVar[int] = 0  # of the first joint; what stands before it is the base, so they share it

    @classmethod
    def build(
        cls,
        names: Sequence[str],
        origins: ArrayLike,
        axes: ArrayLike | None = None,
        revolute: ArrayLike | None = None,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        base: str = "base",
        tip: str = "tip",
    ) -> Chain:
        """A chain from its constants; axes default to z, joints to revolute, limits to none. Raises BadRobot."""
        n = len(names)
        M = read_only(origins)
        if n == 0:
            raise BadRobot(f"chain {base} → {tip}", "no moving joint", "name a base and a tip with joints between them")
        if M.shape != (n + 1, 4, 4) or not np.isfinite(M).all():
            raise BadRobot(f"chain {base} → {tip}", f"{n} joints need {n + 1} finite 4 x 4 origins", "check the table")
        a = np.tile([0.0, 0.0, 1.0], (n, 1)) if axes is None else np.asarray(axes, dtype=float)
        norm = np.linalg.norm(a, axis=-1, keepdims=True)
        if not (norm > 1e-9).all():
            worst = names[int(np.argmin(norm))]
            raise BadRobot(f"joint {worst}", "its axis has no length", "give it a unit axis")
        return cls(
            names=tuple(names),
            origins=M,
            axes=read_only(a / norm),
            revolute=read_only(np.ones(n, bool) if revolute is None else revolute, bool),
            lower=read_only(np.full(n, -np.inf) if lower is None else lower),
            upper=read_only(np.full(n, np.inf) if upper is None else upper),
            base=base,
            tip=tip,
        )

    @property
    def n(self) -> int:
        """Number of moving joints."""
        return len(self.names)

    @cached_property
    def led(self) -> tuple[tuple[int, int, float, float], ...]:
        """Joints that mimic another of this chain: number, the leader's number, factor and offset."""
        numbers = {name: k for k, name in enumerate(self.names)}
        return tuple((f.joint, numbers[f.leader], f.factor, f.offset) for f in self.follows if f.leader in numbers)

    @cached_property
    def own(self) -> np.ndarray:
        """Which joints follow no other of this chain, (n,) bool."""
        return read_only(~np.isin(np.arange(self.n), [joint for joint, *_ in self.led]), bool)

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of these joints."""
        return tuple(name for name, own in zip(self.names, self.own, strict=True) if own)

    def followed(self, q: Array) -> Array:
        """Positions (..., n) [rad, m] with the joints that mimic another of this chain where they follow it."""
        if not self.led:
            return q
        out = np.array(q, dtype=float)
        for joint, leader, factor, offset in self.led:
            out[..., joint] = factor * out[..., leader] + offset
        return out

    def by_leaders(self, J: Array) -> Array:
        """Derivatives (..., n) by the joints, of those that follow added to their leaders', whose place they take."""
        for joint, leader, factor, _ in self.led:
            J[..., leader] += factor * J[..., joint]
            J[..., joint] = 0.0
        return J

    @property
    def tool_place(self) -> int:
        """The place of the tool, behind the last joint."""
        return self.n

    @cached_property
    def T_base_root(self) -> Array:
        """The frame of the first joint before it moves, its axis along z, in the base, (4, 4)."""
        return read_only(self.origins[0] @ se3.transform(self.joint_basis[0]))

    @cached_property
    def T_base_joint_home(self) -> Array:
        """Joint frames, then the tip, in the base with every joint at zero, (n + 1, 4, 4)."""
        frames = [self.origins[0]]
        for M in self.origins[1:]:
            frames.append(frames[-1] @ M)
        return read_only(frames)

    @cached_property
    def spatial_twists(self) -> Array:
        """ξ_1 … ξ_n of the spatial form, in the base frame, (n, 6)."""
        local = np.where(self.revolute[:, None], np.c_[np.zeros((self.n, 3)), self.axes], 0.0)
        local[~self.revolute, :3] = self.axes[~self.revolute]
        return read_only((se3.adjoint(self.T_base_joint_home[:-1]) @ local[..., None])[..., 0])

    @property
    def home(self) -> Array:
        """Pose of the tip in the base with every joint at zero, (4, 4)."""
        return self.T_base_joint_home[-1]

    @cached_property
    def along_z(self) -> Array:
        """The same constants with every joint frame turned so that its axis is z, (n + 1, 4, 4)."""
        A = se3.transform(self.joint_basis)
        M = np.array(self.origins)
        M[:-1] = M[:-1] @ A
        M[1:] = se3.inverse(A) @ M[1:]
        return read_only(M)

    @cached_property
    def joint_basis(self) -> Array:
        """For each joint a right-handed basis (columns) of its frame whose third column is the axis, (n, 3, 3), as of
        ``along_z``.
        """
        return read_only(np.stack([rotation_to_axis(a) for a in self.axes]))

    def with_origins(self, origins: ArrayLike) -> Chain:
        """The same robot with other constants M_0 … M_n, (n + 1, 4, 4)."""
        other = replace(self, origins=read_only(origins))
        other.__dict__["joint_basis"] = self.joint_basis  # depends on the axes only, and is asked for at every step
        return other

    def from_root_to(self, T_tip_tool: Array) -> Chain:
        """The same robot from the root, with the tool as its tip. The last result is cached for the corrector."""
        kept: tuple[Array, Chain] | None = self.__dict__.get("_last_tool")
        if kept is None or not np.array_equal(kept[0], T_tip_tool):
            origins = np.array(self.origins)
            origins[0] = se3.inverse(se3.transform(self.joint_basis[0]))
            origins[-1] = origins[-1] @ T_tip_tool
            kept = self.__dict__["_last_tool"] = np.array(T_tip_tool), self.with_origins(origins)
        return kept[1]

    def with_limits(self, lower: ArrayLike, upper: ArrayLike) -> Chain:
        """The same robot with other limits of its joints [rad or m], (n,) each."""
        return replace(self, lower=read_only(lower), upper=read_only(upper))

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """Random postures (count, n) [rad, m] within the limits, each joint within one turn, or 1 m, near zero."""
        low, high = ranges(self.revolute, self.lower, self.upper)
        turn = 2.0 * np.where(self.revolute, FREE_TURN, FREE_SLIDE)
        first = np.where(high - low > turn, np.clip(-0.5 * turn, low, high - turn), low)
        return self.followed(rng.uniform(first, np.minimum(high, first + turn), (count, self.n)))

    def with_errors(self, E: Array, constants: Array) -> Chain:
        """The same robot with small motions E (n, 4, 4) of its places behind the first, the tool's last; a chain has no
        constants.
        """
        A = se3.transform(self.joint_basis)
        origins = np.array(self.origins)
        origins[1:-1] = origins[1:-1] @ A[1:] @ E[:-1] @ se3.inverse(A[1:])
        return self.with_origins(origins)

    def length_direction(self, k: int) -> Array:
        """Unit vector along the link that ends in place k, in that place's frame, (3,); zero where it has no length."""
        M = self.along_z[k]
        along = M[:3, :3].T @ M[:3, 3]
        size = float(np.linalg.norm(along))
        return np.asarray(along / size) if size > 1e-3 else np.zeros(3)

    def digits(self) -> bytes:
        """Origins, axes and kinds of the joints, to 1 nm and 1 nrad, as bytes."""
        numbers = [np.round(a * 1e9).astype("<i8").tobytes() for a in (self.origins, self.axes)]
        return b"".join([*numbers, np.asarray(self.revolute, dtype="u1").tobytes()])

    def reach(self) -> float:
        """An upper bound on the distance from the first joint to the tip [m], used to recognise wrong units."""
        slides = np.where(self.revolute, 0.0, np.where(np.isfinite(self.upper), np.abs(self.upper), 0.0))
        return float(np.linalg.norm(self.origins[1:, :3, 3], axis=1).sum() + slides.sum())


def ranges(revolute: np.ndarray, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Least and largest joint positions (n,) [rad, m]: the limits; a full turn, or ±0.5 m, where there is none."""
    span = np.where(revolute, FREE_TURN, FREE_SLIDE)
    low = np.where(np.isfinite(lower), lower, np.where(upper > -span, -span, upper - 2.0 * span))
    return low, np.where(np.isfinite(upper), upper, np.where(lower < span, span, lower + 2.0 * span))


def rotation_to_axis(axis: ArrayLike) -> Array:
    """A rotation (3, 3) whose third column is the given unit axis. A coordinate axis, of either sign, gets the other
    two as its first columns, so that directions across it keep their names; z gets the identity.
    """
    a = np.asarray(axis, dtype=float)
    k = int(np.argmax(np.abs(a)))
    first = np.eye(3)[(k + 1) % 3 if a[k] > 0.0 else (k + 2) % 3]
    x = first - a * (a @ first)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(a, x), a], axis=1)
