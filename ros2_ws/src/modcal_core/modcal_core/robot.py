"""The robot as a user of the library holds it: its kinematics, and what its description says besides."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.files import read_yaml
from modcal_core.geometry import Array, so3
from modcal_core.robots import Chain, Delta, Inertias, Mechanism, forward, is_serial_arm

if TYPE_CHECKING:
    from modcal_core.modules import Assembly, Library

Table = str | Path | Mapping[str, Any]
_ROUNDED = 1e-6  # how far the rotation of a pose that was asked for may be from one, for rounding


@dataclass(frozen=True)
class Robot:
    """Nominal serial arm or Delta.

    mechanism: kinematics, a Chain or a Delta. inertias: lumped bodies of the joints; None where they are unknown.
    description: URDF text; None for a Delta. name: used in reports. other_tips: other arms with as many joints, which
    may have been meant where no tip was named. notes: what the description lacks, and joints that follow others.
    """

    mechanism: Mechanism
    inertias: Inertias | None = None
    description: str | None = None
    name: str = "robot"
    other_tips: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def from_urdf(
        cls,
        source: str | Path,
        base: str | None = None,
        tip: str | None = None,
        recorded: Collection[str] | None = None,
    ) -> Robot:
        """The arm between two links of a URDF.

        source: path of the file, or its text. base: the first link; None: the root. tip: the last link; None: the one
        behind most of the joints named in recorded, or behind most joints. Raises BadRobot.
        """
        from modcal_core.robots import other_tips, parse, read_chain, read_inertias

        is_text = isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<")
        text = str(source) if is_text else Path(source).read_text(encoding="utf-8", errors="replace")
        chain = read_chain(text, base, tip, recorded)
        others = () if tip is not None else other_tips(text, chain.base, recorded)
        tree = parse(text)
        followed = (
            f"Joint {chain.names[f.joint]} follows {f.leader}: {f.factor:g} times its position, plus {f.offset:g}."
            for f in chain.follows
        )
        return cls(chain, read_inertias(text, chain), text, tree.name or "robot", others, (*tree.notes, *followed))

    @classmethod
    def from_dh(cls, table: Table) -> Robot:
        """The arm of a Denavit-Hartenberg table: classical, or modified where it states ``convention: mdh``.

        table: the data, or the path of a YAML file; docs/robots.md has its keys. Raises BadTable.
        """
        return cls.from_table({"convention": "dh", **_data(table)})

    @classmethod
    def from_cpc(cls, table: Table) -> Robot:
        """The arm of a table of the complete and parametrically continuous model; as :meth:`from_dh`."""
        return cls.from_table({"convention": "cpc", **_data(table)})

    @classmethod
    def from_table(cls, table: Table) -> Robot:
        """The arm of a kinematic table that states its convention: dh, mdh or cpc. Raises BadTable."""
        from modcal_core.robots import from_table

        return cls.from_chain(from_table(_data(table)))

    @classmethod
    def from_chain(cls, chain: Chain, name: str = "arm") -> Robot:
        """The arm with these kinematics, and a URDF made from them."""
        from modcal_core.robots import chain_urdf

        return cls(chain, None, chain_urdf(chain, name), name)

    @classmethod
    def from_modules(cls, assembly: Assembly, library: Library | None = None) -> Robot:
        """The arm that an assembly of modules makes. library: of the modules; None: the published one.

        Raises BadTable where it cannot be built.
        """
        from modcal_core.modules import published, urdf_of

        return cls.from_urdf(urdf_of(assembly, published() if library is None else library))

    @classmethod
    def from_delta(cls, table: Table) -> Robot:
        """The Delta robot that this data, or this YAML file, describes; docs/delta.md has the keys. Raises BadTable."""
        from modcal_core.robots import delta_from_data

        source = "delta" if isinstance(table, Mapping) else str(table)
        return cls(delta_from_data(_data(table), source), name="delta")

    @classmethod
    def delta(cls, *arguments: Any, **constants: Any) -> Robot:
        """A Delta robot from its constants [m, rad], as :meth:`modcal_core.Delta.build` takes them. Raises BadRobot."""
        return cls(Delta.build(*arguments, **constants), name="delta")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints, base to tip."""
        return self.mechanism.names

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.mechanism.n

    @property
    def base(self) -> str:
        """The first link."""
        return self.mechanism.base

    @property
    def tip(self) -> str:
        """The last link."""
        return self.mechanism.tip

    @property
    def limits(self) -> Array:
        """Lower and upper limits of the joints [rad, m], (2, n); ±inf where none are stated."""
        return np.stack([self.mechanism.lower, self.mechanism.upper])

    @property
    def chain(self) -> Chain:
        """The kinematics of a serial arm. Raises BadRobot for a Delta."""
        if is_serial_arm(self.mechanism):
            return self.mechanism
        raise BadRobot(f"robot {self.name}", "is a Delta", "give a serial arm: this works on no other")

    def forward(self, q: ArrayLike) -> Array:
        """Poses T_base_tip (..., 4, 4) [m] at joint positions q (..., n) [rad, m].

        Raises BadRobot for another number of joints, and NotReachable for postures that a Delta cannot take.
        """
        postures = np.asarray(q, dtype=float)
        if postures.ndim == 0 or postures.shape[-1] != self.n:
            raise BadRobot("q", f"has shape {postures.shape}, not (..., {self.n})", f"order: {', '.join(self.names)}")
        return forward(self.mechanism, postures)

    def inverse(
        self,
        T_base_tip: ArrayLike,
        near: ArrayLike | None = None,
        seed: int = 0,
        mask: ArrayLike = (True, True, True, True, True, True),
    ) -> Array:
        """Joint positions (n,) [rad, m], within the limits, that put the tip at a pose (4, 4) [m] of the base.

        near: posture to begin from, (n,); None: the middle of the limits. seed: of the other postures that are tried.
        mask: which of x y z rx ry rz, along and about the axes of the tip, must be met (6,); of a Delta the position
        and the turn about z count, whatever the mask. Raises BadRobot for a pose, mask or posture that is none, and
        NotReachable with what was left.
        """
        goal, wanted = np.array(T_base_tip, dtype=float), np.asarray(mask)
        if goal.shape != (4, 4) or not np.isfinite(goal).all():
            said = f"has shape {goal.shape}, or a number that is not finite"
            raise BadRobot("pose", said, "give one homogeneous transform (4, 4)")
        off = float(np.abs(goal[:3, :3] @ goal[:3, :3].T - np.eye(3)).max())
        if off > _ROUNDED or np.linalg.det(goal[:3, :3]) < 0.0 or not np.array_equal(goal[3], [0.0, 0.0, 0.0, 1.0]):
            said = f"is no rigid motion: R Rᵀ is off by {off:.2g}, det R is {np.linalg.det(goal[:3, :3]):.3g}"
            raise BadRobot("pose", said, "give a rotation, a position, and 0 0 0 1 below them")
        if wanted.shape != (6,) or not np.isin(wanted, (0, 1)).all() or not wanted.any():
            raise BadRobot("mask", f"is {mask!r}, not six of true and false", "name x y z rx ry rz, one at least")
        from modcal_core.robots import delta_inverse, inverse

        if isinstance(self.mechanism, Delta):
            return delta_inverse(self.mechanism, goal[:3, 3], float(np.arctan2(goal[1, 0], goal[0, 0])))
        low, high = self.limits
        middle = np.where(np.isfinite(low) & np.isfinite(high), 0.5 * (low + high), np.clip(0.0, low, high))
        start = middle if near is None else np.asarray(near, dtype=float)
        if start.shape != (self.n,) or not np.isfinite(start).all():
            raise BadRobot("near", f"is not {self.n} finite numbers", f"order: {', '.join(self.names)}")
        goal[:3, :3] = so3.nearest_rotation(goal[:3, :3])
        return inverse(self.chain, goal, start, wanted, np.random.default_rng(seed))


def _data(table: Table) -> Mapping[str, Any]:
    return read_yaml(Path(table)) if isinstance(table, str | Path) else table
