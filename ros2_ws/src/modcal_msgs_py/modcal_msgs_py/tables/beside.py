"""What stands in a table beside joints and readings: speeds, efforts, commanded joints, temperatures, signals.

A unit comes from the label, or from what the numbers must be: speeds are slopes of the joints, efforts hold the arm
up. Where neither tells it, the columns are not used, and that is said.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.robots import Chain, Inertias, chain_gravity_wrench
from modcal_msgs_py.tables.candidates import JointColumns, Numbers, is_counter
from modcal_msgs_py.tables.fitted import ColumnChoice, Fitted, scales
from modcal_msgs_py.tables.labels import COMMANDED, EFFORT, OTHER, VELOCITY, angle_triples, matrices, quaternions
from modcal_msgs_py.tables.moments import RowTimes, stamps_of
from modcal_msgs_py.tables.readings import EFFORTS, UNITS
from modcal_msgs_py.tables.table import Faults, Sheet, Table

# --- Standard deviations that an instrument states of every reading: which columns, of what, in which unit

_FINEST = 1e-6  # m, rad; standard deviations of instruments are more
_STD = {"std", "stdev", "stddev", "sigma", "sd", "deviation", "u"}  # the last only where a coverage is stated
_ALONG, _ABOUT = ("x", "y", "z"), ("rx", "ry", "rz", "roll", "pitch", "yaw")
_TURNED = {"rot", "rotation", "angle", "orientation", "ori", "angular"}


def stated_deviations(numbers: Numbers, fitted: Fitted) -> tuple[dict[str, Any], set[int], list[str]]:
    """What a mapping states under ``std``, the columns that it takes, and what is to be said of them.

    By their labels, of positions and of orientations; empty where the table has none.
    """
    used: set[int] = set()
    said: list[str] = []
    if fitted.body.points:
        return {}, used, said
    groups: dict[tuple[str, str], dict[str, int]] = {}
    for k in range(numbers.values.shape[1]):
        label = numbers.labels[k]
        words = [w for w in label.words if not w.isdigit()]
        axis = next((w for w in words if w in _ALONG or w in _ABOUT), "")
        marked = bool((_STD if label.coverage else _STD - {"u"}) & set(words))
        short = re.fullmatch(rf"(?:s|sd|std|sigma{'|u' if label.coverage else ''})([xyz])", "".join(words))
        if k in fitted.columns or not (marked or short) or not _stated(numbers.values[:, k]):
            continue
        axis = short[1] if short is not None else axis
        turned = axis in _ABOUT or bool(_TURNED & set(words))
        groups.setdefault(("orientation" if turned else "position", label.coverage), {}).setdefault(axis, k)
    stated: dict[str, Any] = {}
    for (what, factor), found in groups.items():
        columns = _axes(found)
        coverage = float(factor or 1.0)
        if not columns or what in stated or (what == "orientation" and fitted.best.meaning.turning is None):
            continue
        if stated and coverage != float(stated.get("coverage", 1.0)):
            continue
        unit = _unit_of_std(numbers, fitted, columns, what, coverage)
        shown = ", ".join(numbers.shown(k) for k in columns)
        if unit is None:
            said.append(f"standard deviations {shown} are not used: no unit makes them plausible; state std")
            continue
        keys = [numbers.key(k) for k in columns]
        stated[what] = keys if len(keys) == 3 else keys[0]
        stated["unit" if what == "position" else "orientation_unit"] = unit
        if coverage > 1.0:
            stated["coverage"] = coverage
        of = f"{factor} standard deviations" if coverage > 1.0 else "standard deviations"
        each = "" if len(columns) == 3 else " along each axis"
        said.append(f"{shown} are {of} of the {what}{each}, in {unit}")
        used |= set(columns)
    return stated, used, said


def _stated(values: Array) -> bool:
    there = values[np.isfinite(values)]
    return len(there) > 0 and bool((there >= 0.0).all()) and bool((there > 0.0).any())


def _axes(found: Mapping[str, int]) -> list[int]:
    for names in (("x", "y", "z"), ("rx", "ry", "rz"), ("roll", "pitch", "yaw")):
        if set(names) <= set(found):
            return [found[name] for name in names]
    return [found[""]] if "" in found else []


def _unit_of_std(numbers: Numbers, fitted: Fitted, columns: Sequence[int], what: str, coverage: float) -> str | None:
    """The unit by the label; else that of the readings, or another one, with which the size is an instrument's."""
    label, typical = numbers.labels[columns[0]], float(np.nanmedian(numbers.values[:, list(columns)])) / coverage
    if what == "orientation":
        if label.unit in ("deg", "rad"):
            return label.unit
        if label.unit is not None or label.told:
            return None
        turning = fitted.best.meaning.turning
        assert turning is not None
        fits = [u for u in ("rad", "deg") if _FINEST < UNITS[u] * typical < max(fitted.best.match.typical_angle, 1e-3)]
        if turning.form in ("euler", "rotvec"):
            same = "deg" if turning.degrees else "rad"
            return same if same in fits else None
        return fits[0] if len(fits) == 1 else None
    if label.unit in ("mm", "m", "in", "cm"):
        return label.unit
    if label.unit is not None or label.told:
        return None
    most = max(fitted.best.match.typical, 1e-4)
    same = fitted.best.meaning.unit
    return next((u for u in (same, "mm", "m") if _FINEST < UNITS[u] * typical < most), None)


_SPEEDS = {"rad/s": "rad/s", "rad/sec": "rad/s", "rads": "rad/s", "deg/s": "deg/s", "°/s": "deg/s", "deg/sec": "deg/s",
           "dps": "deg/s", "degs": "deg/s"}  # fmt: skip
_TORQUES = {"nm": "N m", "n-m": "N m", "n.m": "N m", "n": "N", "nmm": "N mm", "knm": "kN m"}
_PER_DEGREE = np.pi / 180.0
_GAP = 0.25  # s between rows that are one motion, so that the slope of the joints is their speed
_MOVING, _MIN_MOVING = 0.02, 20  # rad/s, and values that move as fast or faster, to tell a unit
_SURE = 0.9  # correlation of speeds with slopes
_SLOPE = 1.25  # factor by which the scale of speeds may be off: filters of controllers and coarse stamps
_HOLDS = 0.8  # correlation of efforts with what gravity asks, from which their sign is told
_FOLLOWS = 0.1  # rad or m; commanded joints are this near
_NOT_A_SIGNAL = {
    "frame", "index", "id", "nr", "no", "number", "count", "sample", "row", "station", "sub", "residual", "rms",
    "error", "err", "std", "sigma", "stdev", "deviation", "uncertainty", "quality", "intensity", "confidence", "status",
    "valid", "time", "timestamp", "stamp", "date", "flag", "markers", "covariance",
}  # fmt: skip
_KELVIN = {"k", "°f", "f"}
_TOPIC = re.compile(r"[^A-Za-z0-9_]+")


@dataclass
class OtherColumns:
    """What a mapping states beside joints and readings. joints: velocity, effort and commanded; std: of the reading.
    used: columns that these take. said, questions: for a person.
    """

    joints: dict[str, Any] = field(default_factory=dict)
    std: dict[str, Any] = field(default_factory=dict)
    temperature: dict[str, Any] = field(default_factory=dict)
    signals: dict[str, Any] = field(default_factory=dict)
    used: set[int] = field(default_factory=set)
    proved: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    questions: list[str] = field(default_factory=list)


def find_beside(
    numbers: Numbers,
    chain: Chain,
    inertias: Inertias | None,
    labelled: Sequence[JointColumns],
    choice: ColumnChoice,
    readings: Sequence[int],
    time: RowTimes,
    fitted: Fitted | None,
) -> OtherColumns:
    """What the columns that are neither joints nor readings nor time are."""
    out = OtherColumns()
    taken = {*choice.joints.columns, *readings, *time.columns}
    free = [j for j in labelled if not set(j.columns) & taken]
    q = scales(chain, choice.angle, choice.length) * numbers.values[:, list(choice.joints.columns)]
    _commanded(out, numbers, chain, [j for j in free if j.role == COMMANDED], choice, q)
    _velocity(out, numbers, chain, [j for j in free if j.role == VELOCITY], choice, q, _stamps(numbers, time))
    _effort(out, numbers, chain, [j for j in free if j.role == EFFORT], inertias, q)
    if fitted is not None:
        out.std, taken_by_std, said = stated_deviations(numbers, fitted)
        out.used |= taken_by_std
        out.said += said
    families = {k for j in free for k in j.columns}
    _temperatures(out, numbers, chain, [j for j in free if j.role == OTHER], taken)
    _signals(out, numbers, chain, [j for j in free if j.role in (OTHER, EFFORT)], taken, families)
    return out


def _by_joint(numbers: Numbers, chain: Chain, columns: Sequence[int]) -> dict[str, Any]:
    return {name: numbers.key(k) for name, k in zip(chain.names, columns, strict=True)}


def _stamps(numbers: Numbers, time: RowTimes) -> Array | None:
    """Stamps of the rows [s]; None where only their order is known."""
    if not time.columns:
        return None
    sniffed = numbers.sniffed
    sheet = Sheet(sniffed.path, sniffed.labels, sniffed.rows, list(range(len(sniffed.rows))), sniffed.form.decimal)
    return stamps_of(Table(sheet, Faults(sniffed.path.name)), time.stated, 0.0)[0]


def _commanded(
    out: OtherColumns, numbers: Numbers, chain: Chain, some: Sequence[JointColumns], choice: ColumnChoice, q: Array
) -> None:
    """Labelled columns that are near the joints in one unit, and in no other."""
    for one in some:
        values = numbers.values[:, list(one.columns)]
        units = {}
        for angle in ("rad", "deg"):
            gap = np.abs(scales(chain, angle, choice.length) * values - q)
            if np.isfinite(gap).any() and bool((np.nanmedian(gap, axis=0) < _FOLLOWS).all()):
                units[angle] = float(np.nanmedian(gap))
        if not units:
            continue
        angle = min(units, key=lambda unit: units[unit])
        stated: dict[str, Any] = {"columns": _by_joint(numbers, chain, one.columns)}
        if angle != choice.angle and np.any(chain.revolute):
            stated = {"unit": angle, **stated}
        out.joints["commanded"] = stated
        out.used |= set(one.columns)
        near = f"they are as near as {units[angle]:.2g} rad"
        out.said.append(f"columns labelled as commanded are the commanded joints in {angle}: {near}")
        return


def _velocity(
    out: OtherColumns,
    numbers: Numbers,
    chain: Chain,
    some: Sequence[JointColumns],
    choice: ColumnChoice,
    q: Array,
    stamps: Array | None,
) -> None:
    if not some:
        return
    one = min(some, key=lambda j: "target" in numbers.labels[j.columns[0]].words)
    shown = f"{numbers.shown(one.columns[0])} … {numbers.shown(one.columns[-1])}"
    values = numbers.values[:, list(one.columns)]
    if not np.all(chain.revolute):
        out.said.append(f"speeds {shown} are not used: sliding joints stand among turning ones")
        return
    told = _SPEEDS.get(numbers.labels[one.columns[0]].told)
    slope = None if stamps is None else _slope(values, q, stamps)
    found = None
    if slope is not None:
        found = next((u for u, s in (("rad/s", 1.0), ("deg/s", 1.0 / _PER_DEGREE)) if _near(slope, s)), None)
        if found is None:
            times = (
                f"{slope:.3g} times the slopes of the joints in rad/s" if slope else "no multiple of the joints' slopes"
            )
            out.questions.append(f"speeds {shown} are {times}: state velocity, or leave it out")
            return
        if told is not None and told != found:
            out.questions.append(f"labels say that {shown} are in {told}; the joints' own motion says {found}")
        out.proved.append(f"speeds {shown} in {found}: they are {slope:.3g} times the slopes of the joints in rad/s")
    elif told is not None:
        found = told
        out.said.append(f"speeds {shown} are in {found}, as their labels say")
    if found is None:
        out.said.append(f"speeds {shown} are not used: neither labels nor the motion tell their unit; state velocity")
        return
    out.joints["velocity"] = {"unit": found, "columns": _by_joint(numbers, chain, one.columns)}
    out.used |= set(one.columns)


def _near(slope: float, scale: float) -> bool:
    return scale / _SLOPE < slope < scale * _SLOPE


def _slope(values: Array, q: Array, stamps: Array) -> float | None:
    """By how much speeds are larger than the slopes of the joints [rad/s]; None where nothing moves as one motion."""
    step = stamps[2:] - stamps[:-2]
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = (q[2:] - q[:-2]) / step[:, None]
    seen = values[1:-1]
    keep = (
        np.isfinite(slopes)
        & np.isfinite(seen)
        & ((step > 0.0) & (step < 2.0 * _GAP))[:, None]
        & (abs(slopes) > _MOVING)
    )
    if keep.sum() < _MIN_MOVING:
        return None
    a, b = slopes[keep], seen[keep]
    if float(a @ b) < _SURE * float(np.linalg.norm(a) * np.linalg.norm(b)):
        return 0.0
    return float(a @ b / (a @ a))


def _effort(
    out: OtherColumns, numbers: Numbers, chain: Chain, some: Sequence[JointColumns], inertias: Inertias | None, q: Array
) -> None:
    for one in some:
        label = numbers.labels[one.columns[0]]
        shown = f"{numbers.shown(one.columns[0])} … {numbers.shown(one.columns[-1])}"
        unit = _TORQUES.get(label.told)
        if label.told and unit is None:
            continue  # per cent of something: a signal
        values = EFFORTS[unit or "N m"] * numbers.values[:, list(one.columns)]
        holds = _holds(chain, inertias, q, values)
        if unit is None and not abs(holds) > _HOLDS:
            out.said.append(f"efforts {shown} are not used: no unit is told, and they do not hold this arm up")
            continue
        stated: dict[str, Any] = {"columns": _by_joint(numbers, chain, one.columns)}
        if unit not in (None, "N m", "N"):
            stated["unit"] = unit
        told = unit or "N m, which no label says"
        if holds < -_HOLDS:
            stated["of_load"] = True
            out.proved.append(f"efforts {shown} are of the load on the actuators: gravity's own torques, in {told}")
        elif holds > _HOLDS:
            out.proved.append(f"efforts {shown} are of the actuators, they hold the arm up; in {told}")
        else:
            out.said.append(f"efforts {shown} are of the actuators on the joints, in {told}; their sign does not show")
        out.joints["effort"] = stated
        out.used |= set(one.columns)
        return


def _holds(chain: Chain, inertias: Inertias | None, q: Array, effort: Array) -> float:
    """Correlation of efforts (N, n) with what holds the bodies up against gravity; 0 where these are not known."""
    rows = np.isfinite(q).all(axis=1) & np.isfinite(effort).all(axis=1)
    if inertias is None or not inertias.known or rows.sum() < _MIN_MOVING:
        return 0.0
    turning = np.asarray(chain.revolute, bool)
    wrench = chain_gravity_wrench(chain, inertias, q[rows])
    asked = -np.where(turning[:, None], wrench[:, 5], wrench[:, 2]).T
    a, b = (x - x.mean(axis=0) for x in (asked, effort[rows]))
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.sum(a * b)) / size if size > 0.0 else 0.0


def _temperatures(
    out: OtherColumns, numbers: Numbers, chain: Chain, families: Sequence[JointColumns], taken: set[int]
) -> None:
    """Temperatures in °C; a family of as many as there are joints is theirs."""
    for one in families:
        if all(_is_warm(numbers, k) for k in one.columns) and any(k in numbers.usable() for k in one.columns):
            out.temperature |= _by_joint(numbers, chain, one.columns)
            out.used |= set(one.columns)
    for k in numbers.usable():
        if k not in taken | out.used and _is_warm(numbers, k):
            words = [w for w in numbers.labels[k].words if w not in ("c", "degc")]
            name = "_".join(words) or f"column_{k}"
            out.temperature[name if name not in out.temperature else f"{name}_{k}"] = numbers.key(k)
            out.used.add(k)
    if out.temperature:
        out.said.append(f"temperatures {', '.join(out.temperature)} are in °C")


def _is_warm(numbers: Numbers, k: int) -> bool:
    label = numbers.labels[k]
    return bool({"temperature", "temp", "temperatur"} & set(label.words)) and label.told not in _KELVIN


def _signals(
    out: OtherColumns,
    numbers: Numbers,
    chain: Chain,
    families: Sequence[JointColumns],
    taken: set[int],
    of_joints: set[int],
) -> None:
    """Take every other labelled column that changes and is neither a counter nor a reading's own error as a signal."""
    for one in families:
        if set(one.columns) & (out.used | taken):
            continue
        words = [w for w in numbers.labels[one.columns[0]].words if not w.isdigit() and w not in ("j", "joint", "axis")]
        if _NOT_A_SIGNAL & set(words):
            continue
        stem = _topic(words) or "joint_signal"
        for name, k in zip(chain.names, one.columns, strict=True):
            if k in numbers.usable():
                out.signals[f"{stem}/{_topic([name])}"] = numbers.key(k)
                out.used.add(k)
    labels = dict(numbers.labels)
    coordinates = {k for t in (*angle_triples(labels), *quaternions(labels), *matrices(labels)) for k in t}
    coordinates |= {k for k, label in labels.items() if label.axis is not None and label.told not in _TORQUES}
    for k in numbers.usable():
        label = numbers.labels[k]
        if k in taken | out.used | of_joints | coordinates or not label.words or _NOT_A_SIGNAL & set(label.words):
            continue
        if is_counter(numbers.values[:, k]) and _whole(numbers.values[:, k]):
            continue
        name = _topic(label.words)
        if name:
            out.signals[name if name not in out.signals else f"{name}_{k}"] = numbers.key(k)
            out.used.add(k)
    if out.signals:
        out.said.append(f"{', '.join(out.signals)} are signals that an error may depend on; remove what is none")


def _topic(words: Sequence[str]) -> str:
    name = _TOPIC.sub("_", "_".join(words)).strip("_")
    return name if name[:1].isalpha() else f"signal_{name}" if name else ""


def _whole(values: Array) -> bool:
    values = values[np.isfinite(values)]
    return bool((values == np.round(values)).all())
