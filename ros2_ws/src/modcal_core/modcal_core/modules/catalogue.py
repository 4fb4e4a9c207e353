"""Everything that a search asks of the modules, looked up by gene: ways, bodies and limits of many assemblies at once.

The constant M_k of the chain behind joint k is the way through the joint, a turn, the way through the link, a turn: a
function of the gene alone. So are the tubes, the masses and the limits. All are computed once and then only indexed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import Array, se3
from modcal_core.modules.coding import BASES, Coding
from modcal_core.modules.library import TURNS, ModuleType
from modcal_core.modules.poe import TURN
from modcal_core.modules.urdf import body, path


@dataclass(frozen=True)
class Arms:
    """N assemblies of n joints each, their kinematics along the first axis.

    origins: M_0 … M_n, (N, n + 1, 4, 4) [m], every joint about or along z of the frame before it. revolute: (N, n).
    lower, upper: (N, n) [rad, m].
    """

    origins: Array
    revolute: np.ndarray
    lower: Array
    upper: Array

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.revolute.shape[1]

    def take(self, which: np.ndarray) -> Arms:
        """Arms with these indices, which may repeat."""
        return Arms(self.origins[which], self.revolute[which], self.lower[which], self.upper[which])


@dataclass(frozen=True)
class ModuleBodies:
    """What moves with each joint of N arms, seen from the frame behind its motion; base and gripper apart.

    points: corners of the tubes' middle lines, (N, n, P, 3) [m]; radius: of the tubes between them, (N, n, P - 1) [m],
    0 where there is none. base, base_radius: the same of the base, in the base frame, (N, Q, 3) and (N,). mass: (N, n)
    [kg], centre: (N, n, 3) [m]; the gripper is part of the last. effort: what the joints can do, (N, n) [N m, N].
    """

    points: Array
    radius: Array
    base: Array
    base_radius: Array
    mass: Array
    centre: Array
    effort: Array


class Catalogue:
    """Tables over all genes and bases of a coding."""

    def __init__(self, coding: Coding) -> None:
        self.coding = coding
        library = coding.library
        joint, turn, link, size, next_turn = coding.fields(np.arange(coding.genes))
        nothing = ModuleTables.none()
        joints = [nothing if kind is None else ModuleTables.of(kind, 0) for kind in coding.joints]
        links = [
            [nothing if kind is None or s >= kind.sizes else ModuleTables.of(kind, s) for s in range(coding.shape[3])]
            for kind in coding.links
        ]
        gripper = ModuleTables.of(library.gripper, 0)
        bases = [ModuleTables.of(library.base, min(b // TURNS, library.base.sizes - 1)) for b in range(BASES)]
        T_joint = np.stack([t.T for t in joints])[joint]
        T_link = np.stack([[t.T for t in row] for row in links])[link, size]
        T_flange = T_joint @ TURN[turn]  # where the link begins, behind the joint's motion
        self._M = T_flange @ T_link @ TURN[next_turn]
        self._T_gripper = gripper.T
        self._M_base = np.stack([t.T for t in bases]) @ TURN[np.arange(BASES) % TURNS]
        self._revolute = np.array([kind is None or kind.revolute for kind in coding.joints])[joint]
        self._lower = np.array([-1.0 if kind is None else kind.lower for kind in coding.joints])[joint]
        self._upper = np.array([1.0 if kind is None else kind.upper for kind in coding.joints])[joint]
        self._effort = np.array([0.0 if kind is None else kind.effort for kind in coding.joints])[joint]
        most_j = max(len(t.points) for t in joints)
        most_l = max(len(t.points) for row in links for t in row)
        of_joint = np.stack([t.padded(most_j) for t in joints])[joint]
        of_link = np.stack([[t.padded(most_l) for t in row] for row in links])[link, size]
        of_link = se3.apply(T_flange[:, None], of_link)
        r_joint = np.array([t.radius for t in joints])[joint]
        r_link = np.array([[t.radius for t in row] for row in links])[link, size]
        self._points = np.concatenate([of_joint, of_link], axis=1)
        # where one module ends the next begins: the tube between the two has no length, and no radius
        self._radius = np.concatenate(
            [np.tile(r_joint[:, None], most_j - 1), np.zeros((len(joint), 1)), np.tile(r_link[:, None], most_l - 1)],
            axis=1,
        )
        self._tool_points = gripper.points
        self._tool_radius = gripper.radius
        most_b = max(len(t.points) for t in bases)
        self._base_points = np.stack([t.padded(most_b) for t in bases])
        self._base_radius = np.array([t.radius for t in bases])
        m_joint = np.array([t.mass for t in joints])[joint]
        m_link = np.array([[t.mass for t in row] for row in links])[link, size]
        moment = m_joint[:, None] * np.stack([t.centre for t in joints])[joint]
        centre = np.stack([[t.centre for t in row] for row in links])[link, size]
        moment += m_link[:, None] * se3.apply(T_flange, centre)
        self._mass, self._moment = m_joint + m_link, moment
        self._tool_mass, self._tool_centre = gripper.mass, gripper.centre

    def arms(self, genomes: np.ndarray) -> Arms:
        """Kinematics of genomes (N, n + 1)."""
        genes = genomes[:, 1:]
        M = np.concatenate([self._M_base[genomes[:, :1]], self._M[genes]], axis=1)
        M[:, -1] = M[:, -1] @ self._T_gripper
        return Arms(M, self._revolute[genes], self._lower[genes], self._upper[genes])

    def bodies(self, genomes: np.ndarray) -> ModuleBodies:
        """Tubes, masses and strengths of genomes (N, n + 1)."""
        genes = genomes[:, 1:]
        count, n = genes.shape
        tool = len(self._tool_points)
        points = np.empty((count, n, self._points.shape[1] + tool, 3))
        points[:, :, :-tool] = self._points[genes]
        points[:, :, -tool:] = points[:, :, -tool - 1 : -tool]  # no gripper there: a tube without length
        radius = np.zeros((count, n, points.shape[2] - 1))
        radius[:, :, : self._radius.shape[1]] = self._radius[genes]
        T = self._M[genes[:, -1]]
        points[:, -1, -tool:] = se3.apply(T[:, None], self._tool_points)
        radius[:, -1, -(tool - 1) :] = self._tool_radius
        mass, moment = self._mass[genes], self._moment[genes]
        mass[:, -1] += self._tool_mass
        moment[:, -1] += self._tool_mass * se3.apply(T, self._tool_centre)
        return ModuleBodies(
            points,
            radius,
            self._base_points[genomes[:, 0]],
            self._base_radius[genomes[:, 0]],
            mass,
            moment / mass[..., None],
            self._effort[genes],
        )


@dataclass(frozen=True)
class ModuleTables:
    """One module of one length: its way T (4, 4), middle line (k, 3) [m], radius [m], mass [kg] and centre (3,) [m]."""

    T: Array
    points: Array
    radius: float
    mass: float
    centre: Array

    @classmethod
    def of(cls, kind: ModuleType, size: int) -> ModuleTables:
        """Tables of a module of the library in one size."""
        whole = body(kind, size)
        return cls(kind.T_in_out[size], path(kind, size), kind.radius, whole.mass, whole.centre)

    @classmethod
    def none(cls) -> ModuleTables:
        """Where there is no module; such genes are refused before any of this counts."""
        return cls(np.eye(4), np.zeros((2, 3)), 0.0, 1.0, np.zeros(3))

    def padded(self, count: int) -> Array:
        """The middle line with its end repeated, (count, 3)."""
        return np.concatenate([self.points, np.tile(self.points[-1], (count - len(self.points), 1))])
