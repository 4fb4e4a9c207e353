"""What each joint of a chain carries by itself: the links that move with it but not with the next joint, lumped."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import Array, se3, sealed
from modcal_core.robots.chain import Chain

if TYPE_CHECKING:
    from modcal_core.robots.urdf_tree import Inertial, Joint, Tree


# --- Bodies that hang on an arm beside its chain, such as another arm on the same torso: where joints move them to


@dataclass(frozen=True)
class CarryingJoint:
    """One joint on the way to a body. origin: (4, 4) [m]. axis: unit (3,); zero of a fixed one. turns: or slides.

    joint: whose position moves it, times a factor, plus an offset: of a joint that mimics, the one it mimics.
    """

    origin: Array
    axis: Array
    turns: bool
    joint: str
    factor: float = 1.0
    offset: float = 0.0

    def motion(self, position: Array) -> Array:
        """Its pose in the link before it, (N, 4, 4), where the joint that leads is at these positions (N,)."""
        along = (self.factor * np.asarray(position) + self.offset)[:, None] * self.axis
        zero = np.zeros_like(along)
        return np.asarray(self.origin @ se3.exp(np.concatenate([zero, along] if self.turns else [along, zero], axis=1)))


@dataclass(frozen=True)
class Hanging:
    """One body. carrier: number of the chain's joint on whose link it hangs. mass [kg], com (3,) [m]: in its link."""

    carrier: int
    steps: tuple[CarryingJoint, ...]
    mass: float
    com: Array

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that move it."""
        return tuple(dict.fromkeys(step.joint for step in self.steps if step.joint))

    def centre(self, positions: Mapping[str, Array], count: int) -> Array:
        """Its centre of mass seen from the carrier, (N, 3) [m]; a joint whose positions (N,) are unknown is at zero."""
        return np.asarray(se3.apply(_place(self.steps, positions, count), self.com))


def _place(steps: Sequence[CarryingJoint], positions: Mapping[str, Array], count: int) -> Array:
    """Where these joints lead, (N, 4, 4); those whose positions (N,) are unknown stand at zero."""
    T = np.tile(np.eye(4), (count, 1, 1))
    for step in steps:
        T = T @ step.motion(positions.get(step.joint, np.zeros(count)))
    return T


def moved_centres(bodies: Sequence[Hanging], mass: Array, positions: Mapping[str, Array], count: int) -> Array | None:
    """How far lumped centres of mass, of these masses (n,) [kg], are from where they are with all other joints at zero,
    (n, N, 3) [m], in the frame behind each joint; None if they stay there.
    """
    moving = [body for body in bodies if any(name in positions for name in body.joints)]
    if not moving:
        return None
    out = np.zeros((len(mass), count, 3))
    for body in moving:
        out[body.carrier] += body.mass * (body.centre(positions, count) - body.centre({}, 1))
    return out / np.maximum(mass, 1e-12)[:, None, None]


@dataclass(frozen=True)
class HeldBehind:
    """Where an arm is held that nothing holds at its base, as where both arms of a robot are one chain from tip to tip:
    behind the first joints, which bear what is before them, not what is beyond.

    joints: their number. mass: of the base and what hangs on it [kg]. com: its centre in the base, (3,) [m].
    """

    joints: int
    mass: float
    com: Array

    @property
    def empty(self) -> HeldBehind:
        """The same without a mass."""
        return replace(self, mass=0.0)


@dataclass(frozen=True)
class Inertias:
    """Lumped bodies of a chain's joints, each in the frame of its joint after the joint's motion.

    mass: (n,) [kg]. com: centres of mass, (n, 3) [m]. inertia: about those centres, (n, 3, 3) [kg m²]. All are zero for
    a joint whose links state no mass. branches: those of the bodies, contained in the others with all joints beside the
    chain at zero, that such joints move. down: unit vector (3,) in the base in which gravity pulls; of an arm that is
    held elsewhere, with all joints at zero. held: where that is, None at its base.
    """

    mass: Array
    com: Array
    inertia: Array
    branches: tuple[Hanging, ...] = ()
    down: Array = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    held: HeldBehind | None = None

    @property
    def known(self) -> bool:
        """Whether the robot description states any mass."""
        return bool(self.mass.any())

    def pulled(self, way: ArrayLike) -> Inertias:
        """The same bodies where weight pulls this way (3,) in the base, of any length."""
        down = np.asarray(way, dtype=float)
        return replace(self, down=down / np.linalg.norm(down))


def held_behind(urdf_xml: str, inertias: Inertias, chain: Chain, joints: int, down: ArrayLike) -> Inertias:
    """The bodies of a chain of this URDF, which is held behind its first joints. down: as of Inertias."""
    from modcal_core.robots.urdf_tree import parse

    mass, com, _ = _lumped(list(_bodies(parse(urdf_xml), chain.base, (), {chain.names[0]})))
    return replace(inertias.pulled(down), held=HeldBehind(joints, mass, com))


def weightless(joints: int) -> Inertias:
    """Massless bodies for a chain with this many joints."""
    return Inertias(np.zeros(joints), np.zeros((joints, 3)), np.zeros((joints, 3, 3)))


def read_inertias(urdf_xml: str, chain: Chain) -> Inertias:
    """The lumped bodies of a chain that was read from this URDF.

    With each joint moves everything that hangs on its link up to the chain's next joint: fixed parts, and branches such
    as grippers, which are taken with their joints at zero; where joints move these is kept beside that. Down is where
    the root's z points away from. Raises BadRobot when the chain is not of this URDF.
    """
    from modcal_core.robots.urdf_tree import parse  # few need what reads XML; a table or a Delta does not

    tree = parse(urdf_xml)
    mass, com, inertia = np.zeros(chain.n), np.zeros((chain.n, 3)), np.zeros((chain.n, 3, 3))
    hanging: list[Hanging] = []
    for k, name in enumerate(chain.names):
        bodies = list(_bodies(tree, tree.joint(name).child, (), set(chain.names[k + 1 :])))
        mass[k], com[k], inertia[k] = _lumped(bodies)
        moved = [(steps, own) for steps, own in bodies if own.mass > 0.0 and any(step.joint for step in steps)]
        hanging += [Hanging(k, steps, own.mass, own.centre) for steps, own in moved]
    return sealed(Inertias(mass, com, inertia, tuple(hanging), _down(tree, chain.base)))


_Body = tuple[tuple[CarryingJoint, ...], "Inertial"]  # the joints on the way to it, and what it weighs


def _bodies(tree: Tree, link: str, steps: tuple[CarryingJoint, ...], stop: set[str]) -> Iterator[_Body]:
    """The bodies of a link and of what hangs on it, up to these joints."""
    if link in tree.inertials:
        yield steps, tree.inertials[link]
    for joint in tree.below[link]:
        if joint.name not in stop:
            yield from _bodies(tree, joint.child, (*steps, _step(joint)), stop)


def _lumped(bodies: Sequence[_Body]) -> tuple[float, Array, Array]:
    """Mass [kg], common centre (3,) [m] and inertia about it (3, 3) [kg m²] with all joints on the way at zero."""
    mass, inertia = sum(own.mass for _, own in bodies), np.zeros((3, 3))
    if mass == 0.0:
        return 0.0, np.zeros(3), inertia
    places = [_place(steps, {}, 1)[0] for steps, _ in bodies]
    centres = [se3.apply(T, own.centre) for T, (_, own) in zip(places, bodies, strict=True)]
    com = np.sum([own.mass * c for c, (_, own) in zip(centres, bodies, strict=True)], axis=0) / mass
    for T, c, (_, own) in zip(places, centres, bodies, strict=True):
        R, r = T[:3, :3], c - com
        inertia += R @ own.inertia @ R.T + own.mass * (r @ r * np.eye(3) - np.outer(r, r))  # Steiner
    return mass, com, inertia


def _step(joint: Joint) -> CarryingJoint:
    turns = joint.kind != "prismatic"
    if not joint.moves or not joint.axis.any():
        return CarryingJoint(joint.T_parent_joint, np.zeros(3), turns, "")
    axis = joint.axis / np.linalg.norm(joint.axis)
    if joint.mimics is None:
        return CarryingJoint(joint.T_parent_joint, axis, turns, joint.name)
    return CarryingJoint(joint.T_parent_joint, axis, turns, joint.mimics, joint.mimic_factor, joint.mimic_offset)


def _down(tree: Tree, base: str) -> Array:
    """Where the weight pulls, (3,), in the base: away from the root's z, the joints between them at zero."""
    R, link = np.eye(3), base
    while link in tree.above:
        joint = tree.above[link]
        R = _step(joint).motion(np.zeros(1))[0, :3, :3] @ R
        link = joint.parent
    return np.asarray(-R[2])
