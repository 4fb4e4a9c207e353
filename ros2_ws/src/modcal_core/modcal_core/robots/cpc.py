"""Complete and parametrically continuous (CPC) tables, to and from chains.

After H. Zhuang, Z. S. Roth and F. Hamano, "A complete and parametrically continuous kinematic model for robot
manipulators", IEEE Transactions on Robotics and Automation 8(4), 1992. With each joint axis as z of its frame, the step
from one joint to the next is ``V = R(b) Rz(beta) Trans(l)``: b (3,) is the direction of the next axis seen from this
one, and

            | 1 - bx²/(1+bz)    -bx by/(1+bz)    bx |
    R(b) =  | -bx by/(1+bz)     1 - by²/(1+bz)   by |
            | -bx               -by              bz |

is the shortest turn that brings z there. l (3,) [m] leads to the next joint's frame. A row is the step *behind* its
joint; beta and the third component of l commute with the next joint's motion, so an export leaves them 0: four numbers
a joint, and no angle at which they jump but for opposite axes. Those are avoided by ``reversed: true``, which says that
the joint counts negatively about its b. Base and tool, which need all six, are poses; the rest of the table is as in
:mod:`modcal_core.robots.table_rows`.

The paper keeps bx and by and takes bz = √(1 - bx² - by²) ≥ 0. Between perpendicular axes, the commonest case, that root
loses half of the digits, so all three are written here; two are read, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.table_rows import plain, read_rows, vector, write_rows

_KEYS = {"b", "l", "beta", "reversed"}
_FLIP_BELOW = -0.5  # an axis that points more than 120° away is followed backwards
_HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # about x: takes z to -z


def from_cpc(table: Mapping[str, Any]) -> Chain:
    """The chain of a CPC table. Raises BadTable."""
    rows = read_rows(table, "cpc", _KEYS)
    beta = rows.column("beta")
    steps = [np.eye(4)]
    for name, row, turn in zip(rows.names, rows.rows, beta, strict=True):
        b = _direction(row.get("b", (0.0, 0.0, 1.0)), f"cpc table, joint {name}: b")
        shift = vector(row.get("l", (0.0, 0.0, 0.0)), 3, f"cpc table, joint {name}: l")
        steps.append(_tilt(b) @ se3.exp([0, 0, 0, 0, 0, turn]) @ se3.transform(p=shift))
        if not isinstance(row.get("reversed", False), bool):
            raise BadTable(f"cpc table, joint {name}: reversed", f"is {row['reversed']!r}", "give true or false")
    side = np.array([-1.0 if row.get("reversed", False) else 1.0 for row in rows.rows])
    return rows.chain(np.stack(steps), side[:, None] * [0.0, 0.0, 1.0])


def to_cpc(chain: Chain) -> dict[str, Any]:
    """The CPC table of a chain, with the same kinematics to rounding. Any serial chain has one."""
    constants = chain.along_z
    flip, rest = np.eye(4), np.eye(4)
    columns: list[dict[str, Any]] = []
    flipped = False
    for k in range(chain.n):
        own: dict[str, Any] = {"reversed": True} if flipped else {}
        # where the last joint's axis leads is the tool's business
        V = np.eye(4)
        if k < chain.n - 1:
            T = rest @ flip @ constants[k + 1]
            flipped = bool(T[2, 2] < _FLIP_BELOW)
            flip = _HALF_TURN if flipped else np.eye(4)
            T = T @ flip
            V = _tilt(T[:3, 2])
            V[:3, 3] = T[:3, 3]
            V = V @ se3.transform(p=[0.0, 0.0, -(se3.inverse(V)[:3, :3] @ T[:3, 3])[2]])
            rest = se3.inverse(V) @ T
        shift = V[:3, :3].T @ V[:3, 3]
        shift[2] = 0.0
        columns.append({"b": plain(V[:3, 2]), "l": plain(shift), **own})
    return write_rows("cpc", chain, columns, constants[0], rest @ flip @ constants[-1])


def _direction(values: object, what: str) -> Array:
    count = len(values) if isinstance(values, list | tuple) else 3
    b = vector(values, 2 if count == 2 else 3, what)
    if len(b) == 2:
        if b @ b > 1.0:
            raise BadTable(what, f"is longer than 1 ({np.sqrt(b @ b):.6g})", "give a direction")
        b = np.r_[b, np.sqrt(1.0 - b @ b)]
    length = float(np.linalg.norm(b))
    if abs(length - 1.0) > 1e-6:
        raise BadTable(what, f"has length {length:.6g}, not 1", "give a direction")
    if b[2] / length < -1.0 + 1e-9:
        raise BadTable(what, "points straight back, where CPC is singular", "write b forwards and reversed: true")
    return b / length


def _tilt(b: Array) -> Array:
    """R(b) of the module's heading, as a transform (4, 4)."""
    x, y, z = b
    k = 1.0 / (1.0 + z)
    R = np.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])
    return se3.transform(R)
