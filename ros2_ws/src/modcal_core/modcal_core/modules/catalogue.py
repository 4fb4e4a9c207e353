"""Everything that a search asks of the modules, looked up by gene: ways, bodies and limits of many assemblies at once.

The constant M_k of the chain behind joint k is the way through the joint, a turn, the way through the link, a turn: a
function of the gene alone. So are the tubes, the masses and the limits. All are computed once and then only indexed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from modcal_core.geometry import Array, se3
from modcal_core.modules.coding import BASES, Coding
from modcal_core.modules.library import SIZES, TURN, TURNS, ModuleType
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


@dataclass(frozen=True)
class _Tables:
    """k modules, one length each: ways T (k, 4, 4), middle lines (k, P, 3) [m], radius (k,) [m], mass (k,) [kg], centre
    (k, 3) [m]; where there is no module nothing counts, for such genes are refused before.
    """

    T: Array
    points: Array
    radius: Array
    mass: Array
    centre: Array

    @classmethod
    def of(cls, modules: Iterable[tuple[ModuleType | None, int]], points: int) -> _Tables:
        """The tables of modules of these lengths; lines end with their last point repeated."""
        rows: list[tuple[Any, ...]] = []
        for kind, size in modules:
            if kind is None or size >= kind.sizes:
                rows.append((np.eye(4), np.zeros((points, 3)), 0.0, 1.0, np.zeros(3)))
                continue
            line, whole = path(kind, size), body(kind, size)
            line = np.concatenate([line, np.tile(line[-1], (points - len(line), 1))])
            rows.append((kind.T_in_out[size], line, kind.radius, whole.mass, whole.centre))
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))

    def take(self, which: np.ndarray) -> _Tables:
        """Those with these numbers."""
        return _Tables(*(getattr(self, f.name)[which] for f in fields(self)))


class Catalogue:
    """Tables over all genes and bases of a coding."""

    def __init__(self, coding: Coding) -> None:
        self.coding = coding
        library, bases = coding.library, np.arange(BASES)
        P = 2 + max(len(kind.elbows) for kind in library.types.values())
        joint, turn, link, size, next_turn = coding.fields(np.arange(coding.genes))
        joints = _Tables.of(((kind, 0) for kind in coding.joints), P).take(joint)
        links = _Tables.of(((kind, s) for kind in coding.links for s in range(SIZES)), P).take(link * SIZES + size)
        self._tool = _Tables.of([(library.gripper, 0)], P)
        self._base = _Tables.of(((library.base, min(b // TURNS, library.base.sizes - 1)) for b in range(BASES)), P)
        T_flange = joints.T @ TURN[turn]  # where the link begins, behind the joint's motion
        self._M = T_flange @ links.T @ TURN[next_turn]
        self._M_base = self._base.T @ TURN[bases % TURNS]
        # where one module ends the next begins: the tube between the two has no length, and no radius
        self._points = np.concatenate([joints.points, se3.apply(T_flange[:, None], links.points)], axis=1)
        tubes = [np.repeat(part.radius[:, None], P - 1, axis=1) for part in (joints, links)]
        self._radius = np.concatenate([tubes[0], np.zeros((len(joint), 1)), tubes[1]], axis=1)
        self._mass = joints.mass + links.mass
        self._moment = joints.mass[:, None] * joints.centre
        self._moment += links.mass[:, None] * se3.apply(T_flange, links.centre)
        self._revolute = np.array([kind is None or kind.revolute for kind in coding.joints])[joint]
        limits = [(-1.0, 1.0, 0.0) if kind is None else (kind.lower, kind.upper, kind.effort) for kind in coding.joints]
        self._lower, self._upper, self._effort = np.array(limits)[joint].T

    def arms(self, genomes: np.ndarray) -> Arms:
        """Kinematics of genomes (N, n + 1)."""
        genes = genomes[:, 1:]
        M = np.concatenate([self._M_base[genomes[:, :1]], self._M[genes]], axis=1)
        M[:, -1] = M[:, -1] @ self._tool.T[0]
        return Arms(M, self._revolute[genes], self._lower[genes], self._upper[genes])

    def bodies(self, genomes: np.ndarray) -> ModuleBodies:
        """Tubes, masses and strengths of genomes (N, n + 1)."""
        genes, tool = genomes[:, 1:], self._tool
        P = tool.points.shape[1]
        # no gripper but at the last joint: a tube without length
        points = np.pad(self._points[genes], ((0, 0), (0, 0), (0, P), (0, 0)), mode="edge")
        radius = np.pad(self._radius[genes], ((0, 0), (0, 0), (0, P)))
        T = self._M[genes[:, -1]]
        points[:, -1, -P:] = se3.apply(T[:, None], tool.points[0])
        radius[:, -1, -(P - 1) :] = tool.radius[0]
        mass, moment = self._mass[genes], self._moment[genes]
        mass[:, -1] += tool.mass[0]
        moment[:, -1] += tool.mass[0] * se3.apply(T, tool.centre[0])
        base = self._base.take(genomes[:, 0])
        return ModuleBodies(
            points, radius, base.points, base.radius, mass, moment / mass[..., None], self._effort[genes]
        )
