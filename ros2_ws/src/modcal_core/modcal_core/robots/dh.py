"""Denavit-Hartenberg tables, classical and modified (Craig), to and from chains.

Classical: joint k turns about (or slides along) z of frame k - 1, and ``A_k = Rz(theta + q) Tz(d) Tx(a) Rx(alpha)``.
Modified: it does so about z of its own frame, and ``A_k = Rx(alpha) Tx(a) Rz(theta + q) Tz(d)``, where alpha and a lead
from the axis before. theta is the joint's offset; a prismatic joint's q is added to d instead. Rows: ``theta, d, a,
alpha`` [rad, m]; the rest of the table is what all kinds have in common, see below.

Export. Between two axes a DH row places its frame on their common normal. With both joint axes as z, the constant
between them is ``Rz(theta) Tz(d) Tx(a) Rx(alpha) Rz(phi) Tz(c)``, six numbers for six; the last two commute with the
next joint's motion, so they are added to its theta and d. Where the axes are nearly parallel, the common normal is far
away: an offset |c| of lateral distance / sin(angle), which is why DH cannot carry small corrections of parallel axes.
Exactly parallel axes are no trouble.

::

    convention: dh                # or mdh, cpc
    base_link: base               # names of the chain's ends
    tip_link: tool0
    base: {xyz: [0, 0, 0], rpy: [0, 0, 0]}      # base link → first frame of the table [m, rad]
    tool: {xyz: [0, 0, 0], rpy: [0, 0, 0]}      # last frame of the table → tip link
    joints:
      - {name: shoulder_pan_joint, type: revolute, lower: -6.28, upper: 6.28, ...}

What stands in place of the dots depends on the convention. All but ``joints`` may be left out: poses are then the
identity, numbers 0, limits none, joints revolute, and named joint_1, joint_2, … where none has a name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, NotRepresentable
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots.chain import Chain
from modcal_core.schema import NUMBER, TEXT, Schema, list_of, record, require, stated

# --- What the kinematic tables have in common: plain data with one row a joint, between a base and a tool pose

SEE = "correct the table, as docs/robots.md shows one"
_POSE = record((), xyz=list_of(NUMBER, 3, 3), rpy=list_of(NUMBER, 3, 3))
_COMMON = {"name": TEXT, "type": {"enum": ("revolute", "prismatic")}, "lower": NUMBER, "upper": NUMBER}


@dataclass(frozen=True)
class TableRows:
    """A table that was read. rows: the mappings of the joints, as checked."""

    names: list[str]
    base_link: str
    tip_link: str
    T_base: Array
    T_tool: Array
    rows: list[Mapping[str, Any]]

    def column(self, key: str) -> Array:
        """One number of every joint, (n,); 0 where it is left out."""
        return np.array([row.get(key, 0.0) for row in self.rows], dtype=float)

    def chain(self, origins: Array, axes: Array | None = None) -> Chain:
        """The chain of these joints with constants M_0 … M_n between which base and tool are not yet."""
        origins = np.array(origins)
        origins[0] = self.T_base @ origins[0]
        origins[-1] = origins[-1] @ self.T_tool
        revolute = [row.get("type", "revolute") == "revolute" for row in self.rows]
        lower = [row.get("lower", -np.inf) for row in self.rows]
        upper = [row.get("upper", np.inf) for row in self.rows]
        return Chain.build(self.names, origins, axes, revolute, lower, upper, self.base_link, self.tip_link)


def table_schema(keys: Mapping[str, Schema]) -> Schema:
    """Of a table whose rows have these keys beside the common ones."""
    joints = list_of(record((), **_COMMON, **keys), 1)
    return record(("joints",), convention={}, base=_POSE, tool=_POSE, joints=joints, base_link=TEXT, tip_link=TEXT)


def read_rows(table: Mapping[str, Any], convention: str, keys: Mapping[str, Schema]) -> TableRows:
    """The joints of a table of this convention, whose rows have these keys beside the common ones. Raises BadTable."""
    what = f"{convention} table"
    top = stated(table)
    other = top.get("convention", convention) if isinstance(top, Mapping) else convention
    if other != convention:
        raise BadTable(what, f"its convention is '{other}'", f"read it as {other}")
    require(top, table_schema(keys), what, SEE)
    rows = [stated(row) for row in top["joints"]]
    unnamed = not any("name" in row for row in rows)
    names = [row.get("name", f"joint_{i + 1}" if unnamed else "") for i, row in enumerate(rows)]
    for i, name in enumerate(names):
        if not name or name in names[:i]:
            raise BadTable(f"{what}, row {i + 1}", "needs a name of its own", "name the joint as its messages do")
    return TableRows(
        names=names,
        base_link=top.get("base_link", "base"),
        tip_link=top.get("tip_link", "tip"),
        T_base=_pose(top.get("base", {})),
        T_tool=_pose(top.get("tool", {})),
        rows=rows,
    )


def write_rows(
    convention: str, chain: Chain, columns: Sequence[Mapping[str, Any]], T_base: Array, T_tool: Array
) -> dict[str, Any]:
    """The table of a chain as plain data; columns: what this convention says of each joint."""
    joints = []
    for k, own in enumerate(columns):
        row: dict[str, Any] = {"name": chain.names[k], "type": "revolute" if chain.revolute[k] else "prismatic"}
        row.update(own)
        limits = {"lower": chain.lower[k], "upper": chain.upper[k]}
        row.update({key: float(value) for key, value in limits.items() if np.isfinite(value)})
        joints.append(row)
    return {
        "convention": convention,
        "base_link": chain.base,
        "tip_link": chain.tip,
        "base": _pose_data(T_base),
        "tool": _pose_data(T_tool),
        "joints": joints,
    }


def vector(values: object, count: int, what: str) -> Array:
    """So many finite numbers, (count,). Raises BadTable."""
    try:
        out = np.array([np.nan if isinstance(v, bool) else float(v) for v in values])  # type: ignore[attr-defined]
    except (TypeError, ValueError, OverflowError):
        out = np.empty(0)
    if out.shape != (count,) or not np.isfinite(out).all():
        raise BadTable(what, f"needs {count} finite number{'s' * (count > 1)}, has {values!r}", "correct the table")
    return out


def _pose(pose: Mapping[str, Any]) -> Array:
    return se3.transform(so3.from_rpy(pose.get("rpy", (0.0,) * 3)), pose.get("xyz", (0.0,) * 3))


def _pose_data(T: Array) -> dict[str, list[float]]:
    return {"xyz": plain(T[:3, 3]), "rpy": plain(so3.to_rpy(T[:3, :3]))}


def plain(values: Array) -> list[float]:
    """Python floats of an array, without negative zeros."""
    return [float(v) + 0.0 for v in values]


DH = ("theta", "d", "a", "alpha")
KEYS = dict.fromkeys(DH, NUMBER)
_PARALLEL = 1e-11  # sine of the angle below which axes count as parallel; FK is then off by that times the reach
_NEARLY = 0.1  # sine of the angle below which a slide is moved, for its line may lie anywhere


def from_dh(table: Mapping[str, Any]) -> Chain:
    """The chain of a classical DH table. Raises BadTable."""
    rows = read_rows(table, "dh", KEYS)
    about_z, about_x = _row_motions(rows)
    return rows.chain(np.concatenate([np.eye(4)[None], about_z @ about_x]))


def from_mdh(table: Mapping[str, Any]) -> Chain:
    """The chain of a modified (Craig) DH table. Raises BadTable."""
    rows = read_rows(table, "mdh", KEYS)
    about_z, about_x = _row_motions(rows)
    return rows.chain(np.concatenate([about_x @ about_z, np.eye(4)[None]]))


def _row_motions(rows: TableRows) -> tuple[Array, Array]:
    """Rz(theta) Tz(d) and Rx(alpha) Tx(a) of every row, (n, 4, 4)."""
    theta, d, a, alpha = (rows.column(key) for key in DH)
    return _about_z(theta, d), _about_x(alpha, a)


def to_dh(chain: Chain, largest_offset: float = 10.0) -> dict[str, Any]:
    """The classical DH table of a chain, with the same kinematics to 1e-9. Raises NotRepresentable for a row that needs
    a d larger than ``largest_offset`` [m].
    """
    rows = _rows(chain, largest_offset)
    last, T_tool = rows.last, rows.beyond
    end = _between(rows.beyond, keep=True)
    if end.offset <= largest_offset:  # else the tool pose takes what a row cannot
        last = end.turned(_wrap(last.theta + end.theta), last.d + end.d)
        T_tool = _about_z(last.phi, last.c)
    return write_rows("dh", chain, [link.data() for link in [*rows.links, last]], rows.T_base, T_tool)


def to_mdh(chain: Chain, largest_offset: float = 10.0) -> dict[str, Any]:
    """The modified DH table of a chain, with the same kinematics to 1e-9. Refuses as :func:`to_dh` does."""
    rows = _rows(chain, largest_offset)
    twist = _twist(rows.beyond[:3, :3])
    along = float(rows.beyond[2, 3])
    last = _Link(_wrap(rows.last.theta + twist), rows.last.d + along)
    T_tool = _about_z(-twist, -along) @ rows.beyond
    joints = [*rows.links, last]
    before = [_Link(0.0, 0.0), *rows.links]
    columns = [replace(own, a=b.a, alpha=b.alpha).data() for own, b in zip(joints, before, strict=True)]
    return write_rows("mdh", chain, columns, rows.T_base, T_tool)


@dataclass(frozen=True)
class _Link:
    """``Rz(theta) Tz(d) Tx(a) Rx(alpha) Rz(phi) Tz(c)`` between two joint axes [rad, m]."""

    theta: float
    d: float
    a: float = 0.0
    alpha: float = 0.0
    phi: float = 0.0
    c: float = 0.0
    offset: float = 0.0  # m; how far away the common normal is from either frame

    def turned(self, theta: float, d: float) -> _Link:
        """The same with another theta and d; of the two x axes along the normal, the one nearer to theta = 0."""
        coaxial = self.a == 0.0 and self.alpha == 0.0
        if coaxial or abs(theta) <= 0.5 * np.pi + 1e-9:
            return replace(self, theta=theta, d=d)
        return _Link(_wrap(theta + np.pi), d, -self.a, -self.alpha, _wrap(self.phi - np.pi), self.c)

    def data(self) -> dict[str, float]:
        return {key: float(getattr(self, key)) + 0.0 for key in DH}


@dataclass(frozen=True)
class _Rows:
    """links: rows of joints 1 … n - 1. last: theta and d of joint n so far. beyond: what follows it, (4, 4)."""

    T_base: Array
    links: list[_Link]
    last: _Link
    beyond: Array


def _rows(chain: Chain, largest_offset: float) -> _Rows:
    constants = _with_slides_moved(chain)
    # what the base has along and about the first axis belongs to the first row
    first = constants[0]
    theta, d = _twist(first[:3, :3]), float(first[:3, 2] @ first[:3, 3])
    T_base = first @ _about_z(-theta, -d)
    links: list[_Link] = []
    pairs: list[str] = []
    farthest, most = 0.0, 0.0
    for k in range(1, chain.n):
        link = _between(constants[k])
        if link.offset > largest_offset:
            angle = math.asin(min(1.0, abs(math.sin(link.alpha))))
            pairs.append(f"{chain.names[k - 1]} and {chain.names[k]}, {angle:.2g} rad")
            # c = distance / s, so it changes by c / s with the angle
            farthest = max(farthest, link.offset)
            most = max(most, 1e-3 * link.offset / abs(math.sin(link.alpha)))
            continue
        link = link.turned(_wrap(theta + link.theta), d + link.d)
        links.append(link)
        theta, d = link.phi, link.c
    if pairs:
        said = (
            f"DH's offset would move by {most:.3g} m with a mrad, and be {farthest:.3g} m, "
            f"{largest_offset:g} m is the limit"
        )
        raise NotRepresentable(f"axes of joints {'; '.join(pairs)} from parallel", said, "write a CPC table instead")
    return _Rows(T_base, links, _Link(theta, d), constants[-1])


def _between(T: Array, keep: bool = False) -> _Link:
    """The link from one z axis to another at T. On parallel axes a shift along them, and a turn if there is no
    distance, may go to either joint: to the second, unless keep.
    """
    x, y, z = T[:3, 3]
    u, v, w = T[:3, 2]
    s = math.hypot(u, v)
    if s < _PARALLEL:
        side = 1.0 if w > 0.0 else -1.0
        a = math.hypot(x, y)
        turn = math.atan2(T[1, 0], T[0, 0])
        theta = math.atan2(y, x) if a > _PARALLEL else (turn if keep else 0.0)
        phi = _wrap(side * (turn - theta))
        return _Link(theta, z if keep else 0.0, a, 0.0 if w > 0.0 else np.pi, phi, 0.0 if keep else side * z)
    theta, alpha = math.atan2(u, -v), math.atan2(s, w)
    c = (x * u + y * v) / (s * s)
    d = z - c * w
    rest = (_about_z(theta, 0.0) @ _about_x(alpha, 0.0))[:3, :3].T @ T[:3, :3]
    return _Link(theta, d, (y * u - x * v) / s, alpha, math.atan2(rest[1, 0], rest[0, 0]), c, max(abs(c), abs(d)))


def _with_slides_moved(chain: Chain) -> Array:
    """The constants with every joint along z, and the lines of slides moved where a neighbour is nearly parallel."""
    constants = np.array(chain.along_z)
    for k in range(chain.n):
        if chain.revolute[k]:
            continue
        before, after = constants[k], constants[k + 1]
        shift = np.zeros(3)
        if k > 0 and np.linalg.norm(before[:2, 2]) < _NEARLY:
            shift = -before[:3, :3].T @ before[:3, 3]
        elif k < chain.n - 1 and np.linalg.norm(after[:2, 2]) < _NEARLY:
            shift = after[:3, 3].copy()
        constants[k] = before @ se3.transform(p=shift)
        constants[k + 1] = se3.transform(p=-shift) @ after
    return constants


def _twist(R: Array) -> float:
    """How far a rotation turns about z, in its shortest way there; 0 where it turns z around and the way is any."""
    _, _, z, w = so3.to_quaternion(R)
    return 0.0 if math.hypot(z, w) < 1e-12 else _wrap(2.0 * math.atan2(z, w))


def _wrap(angle: float) -> float:
    return float(np.pi - (np.pi - angle) % (2.0 * np.pi))


def _about_z(theta: Any, d: Any) -> Array:
    """Rz(theta) Tz(d), (..., 4, 4)."""
    return se3.exp(np.multiply.outer(d, np.eye(6)[2]) + np.multiply.outer(theta, np.eye(6)[5]))


def _about_x(alpha: Any, a: Any) -> Array:
    """Rx(alpha) Tx(a), (..., 4, 4)."""
    return se3.exp(np.multiply.outer(a, np.eye(6)[0]) + np.multiply.outer(alpha, np.eye(6)[3]))
