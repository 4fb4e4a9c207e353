"""Chains from and to kinematic tables: CPC, any table by its convention, CSV, and the DH table nearest to an arm.

CPC (Zhuang, Roth and Hamano, IEEE Transactions on Robotics and Automation 8(4), 1992). With each joint axis as z of its
frame, the step from one joint to the next is ``V = R(b) Rz(beta) Trans(l)``, with b (3,) the direction of the next axis
seen from this one, l (3,) [m] the way to the next joint's frame, and the shortest turn that brings z to b:

            | 1 - bx²/(1+bz)    -bx by/(1+bz)    bx |
    R(b) =  | -bx by/(1+bz)     1 - by²/(1+bz)   by |
            | -bx               -by              bz |

A row is the step *behind* its joint. beta and the third component of l commute with the next joint's motion, so an
export leaves them 0: four numbers a joint, and no jump but for opposite axes. Those are avoided by ``reversed: true``:
the joint counts negatively about its b. Base and tool are poses; the rest of the table is as in
:mod:`modcal_core.robots.dh`. All of b is written: bz from bx and by loses half of the digits.

CSV has comment lines (``# convention: dh``, ``# base_link: …``, ``# tip_link: …``, ``# base: x y z roll pitch yaw``,
``# tool: …``, ``# unit: mm deg``), then a head and one row a joint: name, type, the convention's columns, lower, upper.
CPC's columns are bx by bz lx ly lz beta reversed. Numbers keep every digit. Without names joints are joint_1, joint_2,
…; ``joint`` and ``offset`` are read as name and theta, semicolons as commas. A turn or length that no arm has is
refused.

Nearest DH: of the two ways in which axes that are meant to be parallel are tilted in a calibrated arm, a DH row holds
one; the other needs offsets of kilometres. Here such neighbours are made parallel, and all numbers of that arm's table,
base and tool included, are fitted to the true poses over the joint ranges. What is lost is measured at other postures.
"""

from __future__ import annotations

import copy
import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, NotRepresentable, refusing
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots.chain import Chain
from modcal_core.robots.dh import (
    DH,
    KEYS,
    SEE,
    from_dh,
    from_mdh,
    plain,
    read_rows,
    table_schema,
    to_dh,
    to_mdh,
    write_rows,
)
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.makers import from_ur_kinematics, laid_out_as, ur_conf_table
from modcal_core.schema import NUMBER, Schema, list_of, require

# --- Complete and parametrically continuous (CPC) tables, to and from chains

_KEYS: dict[str, Schema] = {
    "b": list_of(NUMBER, 3, 3),
    "l": list_of(NUMBER, 3, 3),
    "beta": NUMBER,
    "reversed": {"type": "boolean"},
}
_FLIP_BELOW = -0.5  # an axis that points more than 120° away is followed backwards
_HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # about x: takes z to -z


def from_cpc(table: Mapping[str, Any]) -> Chain:
    """The chain of a CPC table. Raises BadTable."""
    rows = read_rows(table, "cpc", _KEYS)
    beta = rows.column("beta")
    steps = [np.eye(4)]
    for name, row, turn in zip(rows.names, rows.rows, beta, strict=True):
        b = _direction(np.array(row.get("b", (0.0, 0.0, 1.0)), dtype=float), f"cpc table, joint {name}: b")
        steps.append(_tilt(b) @ se3.exp([0, 0, 0, 0, 0, turn]) @ se3.transform(p=row.get("l", (0.0, 0.0, 0.0))))
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


def _direction(b: Array, what: str) -> Array:
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


_READERS = {"dh": from_dh, "mdh": from_mdh, "cpc": from_cpc}


@refusing
def from_table(table: Mapping[str, Any]) -> Chain:
    """The chain of a DH, modified DH or CPC table, which must say its ``convention``, or of UR's ``kinematics``. Of
    nearly parallel axes, whose common normal is far away, constants stand at the arm itself. Raises BadTable.
    """
    if isinstance(table, Mapping) and "kinematics" in table:
        return from_ur_kinematics(table)
    convention = table.get("convention") if isinstance(table, Mapping) else None
    if convention not in _READERS:
        said = "has no key 'convention'" if convention is None else f"convention {convention!r} is unknown"
        raise BadTable("kinematic table", said, f"write convention: {', '.join(_READERS)}")
    chain = _READERS[convention](table)
    _require_units(table["joints"], chain, "m rad", "kinematic table")
    return from_cpc(to_cpc(chain)) if _longest(chain) > _LONGEST_M else chain


def from_ur_conf(text: str, nominal: Chain) -> Chain:
    """The arm of a UR controller's calibration.conf. nominal: its model as UR's description lays it out, from base_link
    to tool0, whose frames it keeps as far as its axes let it. Raises BadTable.
    """
    return laid_out_as(from_table(ur_conf_table(text, nominal)), nominal)


def _longest(chain: Chain) -> float:
    """The largest shift [m] of the chain's constants."""
    return float(np.linalg.norm(chain.origins[:, :3, 3], axis=1).max())


# --- A chain as a table of any convention, with the proof that nothing was lost

CONVENTIONS = ("cpc", "dh", "mdh")
EXACT = 1e-10  # m, and entries of rotations, by which an exported table may be off
_POSTURES = 64


def to_table(chain: Chain, convention: str, largest_offset: float = 10.0) -> dict[str, Any]:
    """The table of a chain as plain data. CPC holds every chain; raises NotRepresentable where DH cannot, with offsets
    up to the largest [m].
    """
    if convention not in CONVENTIONS:
        raise BadTable(f"convention '{convention}'", "is unknown", f"choose {', '.join(CONVENTIONS)}")
    table = {"dh": to_dh, "mdh": to_mdh}[convention](chain, largest_offset) if convention != "cpc" else to_cpc(chain)
    off = loss(chain, table)
    if off > EXACT * max(1.0, largest_offset / 10.0):
        said = f"read back, it is off by {off:.2g}, {EXACT:g} is the limit"
        raise NotRepresentable(f"{convention} table", said, "write a CPC table instead")
    return table


def loss(chain: Chain, table: dict[str, Any]) -> float:
    """The largest difference [m, and of rotations] of the tip's pose between a chain and its table, over postures."""
    q = chain.drawn(_POSTURES, np.random.default_rng(0))
    again = _READERS[table["convention"]](table)
    return float(np.abs(chain_forward(again, q) - chain_forward(chain, q)).max())


# --- Kinematic tables as CSV, one row a joint; what is not of a joint stands in comment lines before them

_VECTORS = {"b": ("bx", "by", "bz"), "l": ("lx", "ly", "lz")}
_COLUMNS = {"dh": DH, "mdh": DH, "cpc": ("bx", "by", "bz", "lx", "ly", "lz", "beta", "reversed")}
_TEXTS = ("convention", "base_link", "tip_link")
_POSES = ("base", "tool")
_NOTE, _UNIT = "note", "unit"
# what a metre and a radian are in each unit
_DEGREES = 180.0 / math.pi
UNITS = {"m rad": (1.0, 1.0), "mm deg": (1e3, _DEGREES), "m deg": (1.0, _DEGREES), "mm rad": (1e3, 1.0)}
_ALSO_CALLED = {"joint": "name", "offset": "theta"}
_FULL_TURN = 6.3  # rad; a joint's offset or twist beyond is in degrees
_LONGEST_M = 10.0  # of a link; longer is in millimetres
_LENGTHS, _ANGLES = ("d", "a"), ("theta", "alpha", "beta")


def to_csv(table: Mapping[str, Any], notes: Sequence[str] = (), unit: str = "m rad") -> str:
    """The CSV text of a table as data (see :mod:`modcal_core.robots.dh`); notes become comments.

    unit: of :data:`UNITS`, in which the text is; the table is in m and rad.
    """
    out = io.StringIO()
    table = _scaled(table, *UNITS[unit])
    for key in _TEXTS:
        out.write(f"# {key}: {table[key]}\n")
    if unit != "m rad":
        out.write(f"# {_UNIT}: {unit}\n")
    for key in _POSES:
        out.write(f"# {key}: {' '.join(repr(v) for v in (*table[key]['xyz'], *table[key]['rpy']))}\n")
    for note in notes:
        out.write(f"# {_NOTE}: {note}\n")
    columns = ("name", "type", *_COLUMNS[table["convention"]], "lower", "upper")
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(columns)
    for joint in table["joints"]:
        cells = dict(joint)
        for key, names in _VECTORS.items():
            cells.update(zip(names, cells.pop(key, ()), strict=False))
        rows.writerow([_cell(cells.get(column)) for column in columns])
    return out.getvalue()


def from_csv(text: str, source: str = "table") -> dict[str, Any]:
    """The table as data, in m and rad, that a CSV text holds. Raises BadTable with the line."""
    table: dict[str, Any] = {}
    unit = "m rad"
    lines = text.lstrip("\ufeff").splitlines()
    while lines and (lines[0].startswith("#") or not lines[0].strip()):
        key, _, value = lines.pop(0).lstrip("# ").partition(":")
        key, value = key.strip(), value.strip()
        if key in _TEXTS:
            table[key] = value
        elif key in _POSES:
            numbers = [_value(word) for word in value.split()]
            table[key] = {"xyz": numbers[:3], "rpy": numbers[3:]}
        elif key == _UNIT:
            if value not in UNITS:
                raise BadTable(f"{source}, unit", f"is '{value}'", f"write one of {', '.join(UNITS)}")
            unit = value
        elif key and key != _NOTE:
            known = ", ".join((*_TEXTS, *_POSES, _UNIT, _NOTE))
            raise BadTable(f"{source}, comment '{key}'", "is not a key of the table", f"write one of {known}")
    convention = table.get("convention")
    if convention not in _COLUMNS:
        said = "states no convention" if convention is None else f"convention '{convention}' is unknown"
        raise BadTable(source, said, f"begin with a line such as '# convention: dh' ({', '.join(_COLUMNS)})")
    rows = csv.reader(lines, delimiter=";" if lines and ";" in lines[0] and "," not in lines[0] else ",")
    header = [_ALSO_CALLED.get(cell.strip(), cell.strip()) for cell in next(rows, [])]
    if len(set(header)) < len(header):
        raise BadTable(source, f"has a column twice: {', '.join(header)}", "leave one of them out")
    table["joints"] = [_joint(row, header, f"{source}, joint {i + 1}") for i, row in enumerate(rows) if any(row)]
    for joint in table["joints"]:
        if joint.get("name", "").isdigit():
            joint["name"] = f"joint_{joint['name']}"
    require(table, table_schema(_KEYS if convention == "cpc" else KEYS), source, SEE)
    found = _scaled(table, *(1.0 / factor for factor in UNITS[unit]))
    _require_units(table["joints"], _READERS[convention](found), unit, source)
    return found


def _require_units(joints: Sequence[Mapping[str, Any]], chain: Chain, unit: str, source: str) -> None:
    """Raises BadTable for a turn, or a length that does not cancel with another, that no arm has, in this unit."""
    limits = [(key, _FULL_TURN * UNITS[unit][1]) for key in _ANGLES]
    if _longest(chain) > _LONGEST_M and _longest(from_cpc(to_cpc(chain))) > _LONGEST_M:
        limits += [(key, _LONGEST_M * UNITS[unit][0]) for key in _LENGTHS]
    for key, most in limits:
        for i, joint in enumerate(joints):
            if abs(joint.get(key, 0.0)) > most:
                said = f"is {joint[key]:g}, in the unit {unit}"
                remedy = f"write the unit as '# unit: mm deg' ({', '.join(UNITS)}) in a CSV; YAML is in m and rad"
                raise BadTable(f"{source}, joint {i + 1}: {key}", said, remedy)


def _scaled(table: Mapping[str, Any], length: float, angle: float) -> dict[str, Any]:
    """The table with every length and every angle times a factor."""
    factors = dict.fromkeys((*_LENGTHS, "xyz", "l"), length) | dict.fromkeys((*_ANGLES, "rpy"), angle)

    def scaled(part: Mapping[str, Any]) -> dict[str, Any]:
        limit = length if part.get("type") == "prismatic" else angle
        own = factors | {"lower": limit, "upper": limit}
        return {key: np.multiply(value, own[key]).tolist() if key in own else value for key, value in part.items()}

    poses = {key: scaled(table[key]) for key in _POSES if key in table}
    return {**table, **poses, "joints": [scaled(row) for row in table["joints"]]}


def _joint(row: list[str], header: list[str], where: str) -> dict[str, Any]:
    if len(row) != len(header):
        raise BadTable(where, f"has {len(row)} cells, the header {len(header)}", "correct the line")
    cells = {key: cell.strip() for key, cell in zip(header, row, strict=True) if cell.strip()}
    out: dict[str, Any] = {key: cell if key in ("name", "type") else _value(cell) for key, cell in cells.items()}
    for key, names in _VECTORS.items():
        if any(name in out for name in names):
            out[key] = [out.pop(name, "") for name in names]
    return out


def _value(cell: str) -> float | bool | str:
    try:
        return float(cell)
    except ValueError:
        return {"true": True, "false": False}.get(cell.lower(), cell)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(float(value)) if isinstance(value, int | float) else str(value)


# --- The DH table that is nearest to an arm which no DH table of reasonable size holds

# rad; far more than manufacture leaves between axes that are meant to be parallel, far less than any designed angle
NEARLY_PARALLEL = 0.02
_LEVER = 0.2  # m; a turn of the tip counts as what it moves at this distance, about the length of a tool
_FITTED, _CHECKED = 200, 1000  # postures
_STEP = 1e-6  # m, rad; of the differences, between rounding (1e-10) and curvature (1e-12 / 1e-6)
_ITERATIONS = 10
# Combinations of numbers that move the tip less than this, relative to the strongest, stay: the offsets along two axes
# that are a few mrad from parallel differ by that much only, and would be moved by metres to gain nothing.
_WEAKEST = 0.01


@dataclass(frozen=True)
class NearestTable:
    """A table, and how far the tip is off with it: RMS and largest distance [m], largest angle [rad]. parallel: the
    joints whose axes are nearly parallel, in pairs.
    """

    table: dict[str, Any]
    rms: float
    largest: float
    angle: float
    parallel: tuple[tuple[str, str], ...]


def nearest_dh(chain: Chain, convention: str = "dh", largest_offset: float = 10.0) -> NearestTable:
    """The table of a convention, ``dh`` or ``mdh``, that comes nearest to the chain with offsets of ordinary size.

    Neighbours count as nearly parallel where both turn and are within :data:`NEARLY_PARALLEL` of it.
    largest_offset: as in :func:`modcal_core.robots.dh.to_dh` [m]. Raises NotRepresentable where even so a row exceeds
    it, BadTable for another convention.
    """
    if convention not in ("dh", "mdh"):
        raise BadTable(f"convention '{convention}'", "has no nearest table", "choose dh or mdh; cpc holds every arm")
    constants, pairs = _made_parallel(chain)
    snapped = replace(chain, origins=constants, axes=np.tile([0.0, 0.0, 1.0], (chain.n, 1)))
    table = (to_dh if convention == "dh" else to_mdh)(snapped, largest_offset)
    rng = np.random.default_rng(0)
    fitted, checked = chain.drawn(_FITTED, rng), chain.drawn(_CHECKED, rng)
    table = _fit(table, fitted, chain_forward(chain, fitted))
    off = _off(table, checked, chain_forward(chain, checked))
    distance, angle = np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1) / _LEVER
    return NearestTable(
        table=table,
        rms=float(np.sqrt(np.mean(distance**2))),
        largest=float(distance.max()),
        angle=float(angle.max()),
        parallel=tuple((chain.names[k - 1], chain.names[k]) for k in pairs),
    )


def _made_parallel(chain: Chain) -> tuple[Array, list[int]]:
    """The constants with joint axes along z, nearly parallel neighbours made parallel, and which: (n + 1, 4, 4)."""
    constants, pairs = np.array(chain.along_z), list[int]()
    for k in range(1, chain.n):
        z = constants[k][:3, 2]
        sine = float(np.hypot(z[0], z[1]))
        if not (chain.revolute[k - 1] and chain.revolute[k]) or sine > np.sin(NEARLY_PARALLEL):
            continue
        side = 1.0 if z[2] > 0.0 else -1.0
        turn = np.array([z[1], -z[0], 0.0]) * side  # z × (0, 0, side)
        if sine > 0.0:
            constants[k][:3, :3] = so3.exp(turn / sine * np.arcsin(sine)) @ constants[k][:3, :3]
        pairs.append(k)
    return constants, pairs


def _fit(table: Mapping[str, Any], q: Array, T: Array) -> dict[str, Any]:
    """The table whose numbers bring its poses nearest to T (N, 4, 4) at q (N, n): Gauss-Newton, shortest steps."""
    places = [(i, key) for i in range(len(table["joints"])) for key in DH]
    best, off = copy.deepcopy(dict(table)), _off(table, q, T)
    for _ in range(_ITERATIONS):
        steps = _STEP * np.eye(len(places) + 12)
        J = np.stack([(_off(_moved(best, places, s), q, T) - off).ravel() for s in steps], axis=1) / _STEP
        step: Array = np.asarray(np.linalg.lstsq(J, -off.ravel(), rcond=_WEAKEST)[0], float)
        tried = _moved(best, places, step)
        now = _off(tried, q, T)
        if not np.sum(now**2) < np.sum(off**2):
            break
        best, off = tried, now
        if np.abs(step).max() < 1e-9:
            break
    return best


def _moved(table: Mapping[str, Any], places: list[tuple[int, str]], step: Array) -> dict[str, Any]:
    """The table with its numbers at these places, and twists of its base and tool, changed by a step."""
    out = copy.deepcopy(dict(table))
    for (i, key), value in zip(places, step, strict=False):
        out["joints"][i][key] += float(value)
    for key, twist in (("base", step[-12:-6]), ("tool", step[-6:])):
        T = se3.transform(so3.from_rpy(out[key]["rpy"]), out[key]["xyz"]) @ se3.exp(twist)
        out[key] = {"xyz": [float(v) for v in T[:3, 3]], "rpy": [float(v) for v in so3.to_rpy(T[:3, :3])]}
    return out


def _off(table: Mapping[str, Any], q: Array, T: Array) -> Array:
    """How far the table's tip is off (N, 6): position [m], and rotation times the lever [m]."""
    found = chain_forward(from_table(table), q)
    turn = so3.log(np.swapaxes(T[:, :3, :3], 1, 2) @ found[:, :3, :3])
    return np.concatenate([found[:, :3, 3] - T[:, :3, 3], _LEVER * turn], axis=1)
