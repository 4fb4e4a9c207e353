"""What stands in a table beside joints and readings: speeds, efforts, commanded joints, temperatures, signals.

A unit comes from the label, or from what the numbers must be: speeds are slopes of the joints, efforts hold the arm
up. Where neither tells it, the columns are not used, and that is said.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from modcal_core.geometry import Array
from modcal_core.hypotheses import LENGTHS
from modcal_core.robots import Inertias, Mechanism, gravity_wrench
from modcal_msgs_py.tables.columns import LabelledJoints, Numbers, is_counter
from modcal_msgs_py.tables.fits import FittedBody, JointChoice
from modcal_msgs_py.tables.labels import COMMANDED, EFFORT, MEASURED, OTHER, VELOCITY, Label, grouped, words
from modcal_msgs_py.tables.readings import EFFORTS, UNITS, positions

_SPEEDS = {name: "rad/s" for name in words("rad/s rad/sec rads")}
_SPEEDS |= {name: "deg/s" for name in words("deg/s °/s deg/sec dps degs")}
_TORQUES = {"nm": "N m", "n-m": "N m", "n.m": "N m", "n": "N", "nmm": "N mm", "knm": "kN m"}
_GAP = 0.25  # s between rows that are one motion, so that the slope of the joints is their speed
_MOVING, _MIN_MOVING = 0.02, 20  # rad/s, and values that move as fast or faster, to tell a unit
_SURE = 0.9  # correlation of speeds with slopes
_SLOPE = 1.25  # factor by which the scale of speeds may be off: filters of controllers and coarse stamps
_HOLDS = 0.8  # correlation of efforts with what gravity asks, from which their sign is told
_FOLLOWS = 0.1  # rad or m; commanded joints are this near
_WEIGHTS = ("kg", "n", "newton")  # units
_NOT_A_SIGNAL = words(
    "frame index id nr no number count sample row station sub residual rms error err std sigma stdev deviation "
    "uncertainty quality intensity confidence status valid time timestamp stamp date flag markers covariance"
)
_WARM = words("temperature temp temperatur")
_NOT_CELSIUS = ("k", "°f", "f")
_TOPIC = re.compile(r"[^A-Za-z0-9_]+")
_STD = words("std stdev stddev sigma sd deviation")
_SHORT = re.compile(r"\b(?:s|sd|std|sigma)[xyz]\b")
_TURNED = words("rot rotation angle orientation ori angular rx ry rz roll pitch yaw")
_FINEST = 1e-6  # m, rad; standard deviations of instruments are more


@dataclass(frozen=True)
class MeasuredArm:
    """The robot that is measured. inertias: of the chain's bodies, by which the sign of efforts is told. bystanders:
    other joints of the robot description, each with whether it turns. stated: its file, and base and tip where somebody
    named them, as a mapping states them.
    """

    chain: Mechanism
    inertias: Inertias | None = None
    bystanders: Mapping[str, bool] = field(default_factory=dict)
    stated: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Draft:
    """An entry of a mapping that grows: whoever finds out what columns are states them here, and says why. choice: the
    joints. used: columns that are stated or known to be something. stamps: of the rows [s], None where only their order
    is known.
    """

    numbers: Numbers
    arm: MeasuredArm
    choice: JointChoice
    entry: dict[str, Any]
    used: set[int]
    stamps: Array | None = None
    proved: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    @property
    def joints(self) -> dict[str, Any]:
        """What is stated of the joints."""
        return cast(dict[str, Any], self.entry["joints"])

    def by_joint(self, columns: Sequence[int]) -> dict[str, Any]:
        """Columns by joint, as a mapping states them; they are used from now on."""
        self.used |= set(columns)
        return dict(zip(self.arm.chain.own_names, self.numbers.keys(columns), strict=True))

    def name(self, what: str, name: str, column: int) -> None:
        """State a column by a name, such as that of a signal; it is used from now on."""
        known = self.entry.setdefault(what, {})
        known[name if name not in known else f"{name}_{column}"] = self.numbers.key(column)
        self.used.add(column)

    def shown(self, one: LabelledJoints) -> str:
        """The first and the last of a joint family's labels."""
        return f"{self.numbers.shown(one.columns[0])} … {self.numbers.shown(one.columns[-1])}"


def find_beside(draft: Draft, labelled: Sequence[LabelledJoints], fitted: FittedBody | None) -> None:
    """State the columns that are neither joints nor readings nor time. labelled: families of as many as joints."""
    free = [j for j in labelled if not set(j.columns) & draft.used]
    _commanded(draft, [j for j in free if j.role == COMMANDED])
    _velocity(draft, [j for j in free if j.role == VELOCITY])
    _effort(draft, [j for j in free if j.role == EFFORT])
    _bystanders(draft)
    if fitted is not None and not fitted.body.points:
        _deviations(draft, fitted)
    _temperatures(draft, [j for j in free if j.role == OTHER])
    _signals(draft, [j for j in free if j.role in (OTHER, EFFORT)], {k for j in free for k in j.columns})


def _commanded(draft: Draft, some: Sequence[LabelledJoints]) -> None:
    """Labelled columns that are near the joints in one unit, and in no other."""
    joints, chain, numbers = draft.joints, draft.arm.chain, draft.numbers
    for one in some:
        gaps, parts = dict[str, float](), dict[str, dict[str, Any]]()
        columns = dict(zip(chain.own_names, numbers.keys(one.columns), strict=True))
        units = {"units": joints["units"]} if "units" in joints else {}
        for unit in ("rad", "deg") if np.any(chain.revolute) else (joints["unit"],):
            parts[unit] = {**({"unit": unit} if unit != joints["unit"] else {}), **units, "columns": columns}
            told = positions(numbers.table, joints, chain.own_names, parts[unit])
            gap = np.abs(told - draft.choice.q[:, chain.own])
            if np.isfinite(gap).any() and bool((np.nanmedian(gap, axis=0) < _FOLLOWS).all()):
                gaps[unit] = float(np.nanmedian(gap))
        if gaps:
            unit = min(gaps, key=lambda name: gaps[name])
            joints["commanded"] = parts[unit]
            draft.used |= set(one.columns)
            said = f"columns labelled as commanded are the commanded joints in {unit}"
            draft.said.append(f"{said}: they are as near as {gaps[unit]:.2g} rad")
            return


def _velocity(draft: Draft, some: Sequence[LabelledJoints]) -> None:
    numbers = draft.numbers
    if not some:
        return
    one = min(some, key=lambda j: "target" in numbers.labels[j.columns[0]].words)
    shown, told = draft.shown(one), _SPEEDS.get(numbers.labels[one.columns[0]].told)
    slope = None if draft.stamps is None else _slope(numbers.values[:, list(one.columns)], draft.choice.q, draft.stamps)
    scales = {"rad/s": 1.0, "deg/s": 180.0 / np.pi}
    shows = next((u for u, s in scales.items() if slope is not None and s / _SLOPE < slope < s * _SLOPE), None)
    if not np.all(draft.arm.chain.revolute) or (told is None and slope is None):
        draft.said.append(f"speeds {shown} are not used: joints slide, or nothing tells the unit; state velocity")
        return
    if slope is None:
        draft.said.append(f"speeds {shown} are in {told}, as their labels say")
    elif shows is None:
        times = f"{slope:.3g} times" if slope else "no multiple of"
        draft.asked.append(f"speeds {shown} are {times} the joints' slopes in rad/s: state velocity, or leave it out")
        return
    else:
        if told not in (None, shows):
            draft.asked.append(f"labels say that {shown} are in {told}; the joints' own motion says {shows}")
        draft.proved.append(f"speeds {shown} in {shows}: they are {slope:.3g} times the slopes of the joints in rad/s")
    draft.joints["velocity"] = {"unit": shows or told, "columns": draft.by_joint(one.columns)}


def _slope(values: Array, q: Array, stamps: Array) -> float | None:
    """By how much speeds are larger than the slopes of the joints [rad/s]; None if nothing moves as one motion."""
    step = stamps[2:] - stamps[:-2]
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = (q[2:] - q[:-2]) / step[:, None]
    seen = values[1:-1]
    one_motion = ((step > 0.0) & (step < 2.0 * _GAP))[:, None]
    keep = np.isfinite(slopes) & np.isfinite(seen) & one_motion & (abs(slopes) > _MOVING)
    if keep.sum() < _MIN_MOVING:
        return None
    a, b = slopes[keep], seen[keep]
    sure = float(a @ b) >= _SURE * float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b / (a @ a)) if sure else 0.0


def _effort(draft: Draft, some: Sequence[LabelledJoints]) -> None:
    for one in some:
        label, shown = draft.numbers.labels[one.columns[0]], draft.shown(one)
        unit = _TORQUES.get(label.told)
        if label.told and unit is None:
            continue  # per cent of something: a signal
        values = EFFORTS[unit or "N m"] * draft.numbers.values[:, list(one.columns)]
        holds = _holds(draft.arm, draft.choice.q, values)
        if unit is None and not abs(holds) > _HOLDS:
            draft.said.append(f"efforts {shown} are not used: no unit is told, and they do not hold this arm up")
            continue
        stated: dict[str, Any] = {"columns": draft.by_joint(one.columns)}
        if unit not in (None, "N m", "N"):
            stated["unit"] = unit
        told = unit or "N m, which no label says"
        if holds < -_HOLDS:
            stated["of_load"] = True
            draft.proved.append(f"efforts {shown} are of the load on the actuators: gravity's own torques, in {told}")
        elif holds > _HOLDS:
            draft.proved.append(f"efforts {shown} are of the actuators, they hold the arm up; in {told}")
        else:
            draft.said.append(f"efforts {shown} are of the actuators, in {told}; their sign does not show")
        draft.joints["effort"] = stated
        return


def _holds(arm: MeasuredArm, q: Array, effort: Array) -> float:
    """Correlation of efforts (N, n) with what holds the bodies up against gravity; 0 where these are not known."""
    chain, inertias = arm.chain, arm.inertias
    rows = np.isfinite(q).all(axis=1) & np.isfinite(effort).all(axis=1)
    if inertias is None or not inertias.known or rows.sum() < _MIN_MOVING:
        return 0.0
    turning = np.asarray(chain.revolute, bool)
    wrench = gravity_wrench(chain, inertias, q[rows])
    asked = -np.where(turning[:, None], wrench[:, 5], wrench[:, 2]).T
    a, b = (x - x.mean(axis=0) for x in (asked[:, chain.own], effort[rows]))
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.sum(a * b)) / size if size > 0.0 else 0.0


def _bystanders(draft: Draft) -> None:
    """Other joints of the robot description, by their names; turning ones in the arm's unit where no label says it."""
    joints, arms = draft.joints, draft.joints["unit"]
    for name, turns in draft.arm.bystanders.items():
        own, free = Label.of(name).words, draft.numbers.free(draft.used)
        columns = [k for k, label in free.items() if label.words == own and label.role == MEASURED]
        unit = draft.numbers.labels[columns[0]].unit if len(columns) == 1 else None
        unit = unit or ((arms if arms in ("rad", "deg") else "rad") if turns else None)
        if len(columns) != 1 or unit not in (("rad", "deg") if turns else LENGTHS):
            continue
        joints["columns"] = {**joints["columns"], name: draft.numbers.key(columns[0])}
        if unit != arms:
            joints["units"] = {**joints.get("units", {}), name: unit}
        draft.used.add(columns[0])
        draft.said.append(f"{draft.numbers.shown(columns[0])} is the joint {name}, which is not of this arm, in {unit}")


def _deviations(draft: Draft, fitted: FittedBody) -> None:
    """Standard deviations that an instrument states of every reading: which columns, of what, in which unit."""
    numbers, std = draft.numbers, dict[str, Any]()
    labels = {k: label for k, label in numbers.labels.items() if k not in fitted.columns and _is_std(label)}
    labels = {k: label for k, label in labels.items() if _positive(numbers.values[:, k])}
    for columns in grouped(labels, "deviation"):
        label = labels[columns[0]]
        what = "orientation" if _TURNED & set(label.words) else "position"
        coverage = float(label.coverage or 1.0)
        if what in std or set(columns) & draft.used or len(columns) not in (1, 3):
            continue
        if (what == "orientation" and "pose" not in fitted.best.stated) or (
            std and coverage != std.get("coverage", 1.0)
        ):
            continue
        unit = _unit_of_std(fitted, label, float(np.nanmedian(numbers.values[:, list(columns)])) / coverage, what)
        shown = numbers.shown(*columns)
        if unit is None:
            draft.said.append(f"standard deviations {shown} are not used: no unit makes them plausible; state std")
            continue
        keys = numbers.keys(columns)
        std |= {what: keys if len(keys) == 3 else keys[0]}
        std |= {"unit" if what == "position" else "orientation_unit": unit}
        std |= {"coverage": coverage} if coverage > 1.0 else {}
        of = f"{label.coverage} standard deviations" if coverage > 1.0 else "standard deviations"
        axes = "" if len(columns) == 3 else " along each axis"
        draft.said.append(f"{shown} are {of} of the {what}{axes}, in {unit}")
        draft.used |= set(columns)
    if std:
        (key,) = fitted.best.stated
        draft.entry[key] = {**draft.entry[key], "std": std}


def _is_std(label: Label) -> bool:
    words = set(label.words)
    return bool(_STD & words or _SHORT.search(label.name) or (label.coverage and re.search(r"\bu[xyz]?\b", label.name)))


def _positive(values: Array) -> bool:
    there = values[np.isfinite(values)]
    return len(there) > 0 and bool((there >= 0.0).all()) and bool((there > 0.0).any())


def _unit_of_std(fitted: FittedBody, label: Label, typical: float, what: str) -> str | None:
    """The unit by the label; else that of the readings, or another one, with which the size is an instrument's."""
    fit, (reading,) = fitted.judged, fitted.best.stated.values()
    units = ("rad", "deg") if what == "orientation" else (reading["unit"], "mm", "m")
    if label.unit is not None or label.told:
        return label.unit if label.unit in (*units, "cm", "in") else None
    most = max(fit.typical_angle, 1e-3) if what == "orientation" else max(fit.typical, 1e-4)
    fits = [unit for unit in units if _FINEST < UNITS[unit] * typical < most]
    if what == "orientation":
        angles: Mapping[str, Any] = next((reading[form] for form in ("euler", "rotvec") if form in reading), {})
        fits = [unit for unit in fits if unit == angles.get("unit", unit)]
    return fits[0] if fits and (what == "position" or len(fits) == 1) else None


def _temperatures(draft: Draft, families: Sequence[LabelledJoints]) -> None:
    """Temperatures in °C; a family of as many as there are joints is theirs."""
    numbers = draft.numbers
    for one in families:
        if all(_is_warm(numbers, k) for k in one.columns) and set(one.columns) & set(numbers.usable):
            draft.entry.setdefault("temperature", {}).update(draft.by_joint(one.columns))
    for k in numbers.usable:
        if k not in draft.used and _is_warm(numbers, k):
            name = "_".join(w for w in numbers.labels[k].words if w not in ("c", "degc")) or f"column_{k}"
            draft.name("temperature", name, k)
    if "temperature" in draft.entry:
        draft.said.append(f"temperatures {', '.join(draft.entry['temperature'])} are in °C")


def _is_warm(numbers: Numbers, k: int) -> bool:
    return bool(_WARM & set(numbers.labels[k].words)) and numbers.labels[k].told not in _NOT_CELSIUS


def _signals(draft: Draft, families: Sequence[LabelledJoints], of_joints: set[int]) -> None:
    """Take every other labelled column that changes and is neither a counter nor a reading's own error as a signal."""
    numbers, labels = draft.numbers, draft.numbers.labels
    for one in families:
        words = [w for w in labels[one.columns[0]].words if not w.isdigit() and w not in ("j", "joint", "axis")]
        if set(one.columns) & draft.used or _NOT_A_SIGNAL & set(words):
            continue
        for name, k in zip(draft.arm.chain.own_names, one.columns, strict=True):
            if k in numbers.usable:
                draft.name("signals", f"{_topic(words) or 'joint_signal'}/{_topic([name])}", k)
    barred = {k for kind in ("angles", "quaternion", "matrix") for group in grouped(labels, kind) for k in group}
    barred |= {k for k, label in labels.items() if label.axis("position") is not None and label.told not in _TORQUES}
    for k in numbers.usable:
        label, values = labels[k], numbers.values[:, k][np.isfinite(numbers.values[:, k])]
        if k in draft.used | of_joints | barred or _NOT_A_SIGNAL & set(label.words):
            continue
        if is_counter(values) and bool((values == np.round(values)).all()):
            continue
        if name := _topic(label.words):
            weight = "_" + label.told if label.told in _WEIGHTS else ""  # by which what is carried is known
            draft.name("signals", name + ("" if name.endswith(weight) else weight), k)
    if "signals" in draft.entry:
        names = ", ".join(draft.entry["signals"])
        draft.said.append(f"{names} are signals that an error may depend on; remove what is none")


def _topic(words: Sequence[str]) -> str:
    name = _TOPIC.sub("_", "_".join(words)).strip("_")
    return name if name[:1].isalpha() else f"signal_{name}" if name else ""
