"""What the kinematic tables have in common: plain data with one row a joint, between a base and a tool pose.

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots.chain import Chain

_TABLE = {"convention", "base_link", "tip_link", "base", "tool", "joints"}
_ROW = {"name", "type", "lower", "upper"}


@dataclass(frozen=True)
class TableRows:
    """A table that was read. rows: the mappings of the joints, checked for names that do not belong."""

    names: list[str]
    revolute: list[bool]
    lower: list[float]
    upper: list[float]
    base_link: str
    tip_link: str
    T_base: Array
    T_tool: Array
    rows: list[Mapping[str, Any]]

    def column(self, key: str) -> Array:
        """One number of every joint, (n,); 0 where it is left out. Raises BadTable."""
        return np.array([number(row, key, name) for row, name in zip(self.rows, self.names, strict=True)])

    def chain(self, origins: Array, axes: Array | None = None) -> Chain:
        """The chain of these joints with constants M_0 … M_n between which base and tool are not yet."""
        origins = np.array(origins)
        origins[0] = self.T_base @ origins[0]
        origins[-1] = origins[-1] @ self.T_tool
        return Chain.build(
            self.names, origins, axes, self.revolute, self.lower, self.upper, self.base_link, self.tip_link
        )


def read_rows(table: Mapping[str, Any], convention: str, keys: set[str]) -> TableRows:
    """The joints of a table of this convention, whose rows have these keys beside the common ones. Raises BadTable."""
    what = f"{convention} table"
    if not isinstance(table, Mapping):
        raise BadTable(what, "is not a mapping", "give one with a list 'joints'")
    _known(table, _TABLE, what)
    if table.get("convention", convention) != convention:
        raise BadTable(what, f"its convention is '{table['convention']}'", f"read it as {table['convention']}")
    rows = table.get("joints")
    if not isinstance(rows, Sequence) or isinstance(rows, str) or not rows:
        raise BadTable(what, "holds no list 'joints'", "give one row a joint, base to tip")
    names: list[str] = []
    unnamed = all(isinstance(row, Mapping) and "name" not in row for row in rows)
    for i, row in enumerate(rows):
        name = row.get("name", f"joint_{i + 1}" if unnamed else None) if isinstance(row, Mapping) else None
        if not isinstance(name, str) or not name or name in names:
            raise BadTable(f"{what}, row {i + 1}", "needs a name of its own", "name the joint as its messages do")
        _known(row, _ROW | keys, f"{what}, joint {name}")
        if row.get("type", "revolute") not in ("revolute", "prismatic"):
            raise BadTable(f"{what}, joint {name}", f"is of type {row['type']}", "make it revolute or prismatic")
        names.append(name)
    return TableRows(
        names=names,
        revolute=[row.get("type", "revolute") == "revolute" for row in rows],
        lower=[number(row, "lower", name, -np.inf) for row, name in zip(rows, names, strict=True)],
        upper=[number(row, "upper", name, np.inf) for row, name in zip(rows, names, strict=True)],
        base_link=str(table.get("base_link", "base")),
        tip_link=str(table.get("tip_link", "tip")),
        T_base=_pose(table, "base", what),
        T_tool=_pose(table, "tool", what),
        rows=list(rows),
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


def number(row: Mapping[str, Any], key: str, joint: str, default: float = 0.0) -> float:
    """A finite number of a joint's row, or what stands for one that is left out. Raises BadTable."""
    value = row.get(key)
    return default if value is None else float(vector([value], 1, f"joint {joint}: {key}")[0])


def vector(values: object, count: int, what: str) -> Array:
    """So many finite numbers, (count,). Raises BadTable."""
    try:
        out = np.array([_float(v) for v in values])  # type: ignore[attr-defined]
    except (TypeError, ValueError, OverflowError):
        out = np.empty(0)
    if out.shape != (count,) or not np.isfinite(out).all():
        raise BadTable(what, f"needs {count} finite number{'s' * (count > 1)}, has {values!r}", "correct the table")
    return out


def _float(value: object) -> float:
    if isinstance(value, bool):
        raise TypeError
    return float(value)  # type: ignore[arg-type]


def _known(mapping: Mapping[str, Any], keys: set[str], what: str) -> None:
    unknown = sorted(str(key) for key in set(mapping) - keys)
    if unknown:
        raise BadTable(what, f"'{unknown[0]}' is not one of its keys", f"choose from {', '.join(sorted(keys))}")


def _pose(table: Mapping[str, Any], key: str, what: str) -> Array:
    pose = table.get(key) or {}
    if not isinstance(pose, Mapping):
        raise BadTable(f"{what}, {key}", "is not a pose", "give {xyz: [...], rpy: [...]}")
    _known(pose, {"xyz", "rpy"}, f"{what}, {key}")
    xyz = vector(pose.get("xyz", (0, 0, 0)), 3, f"{what}, {key}: xyz")
    return se3.transform(so3.from_rpy(vector(pose.get("rpy", (0, 0, 0)), 3, f"{what}, {key}: rpy")), xyz)


def _pose_data(T: Array) -> dict[str, list[float]]:
    return {"xyz": plain(T[:3, 3]), "rpy": plain(so3.to_rpy(T[:3, :3]))}


def plain(values: Array) -> list[float]:
    """Python floats of an array, without negative zeros."""
    return [float(v) + 0.0 for v in values]
