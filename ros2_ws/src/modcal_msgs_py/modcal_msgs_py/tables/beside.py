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
from modcal_core.robots import Inertias, Mechanism, gravity_wrench
from modcal_msgs_py.tables.columns import LabelledJoints, Numbers, is_counter
from modcal_msgs_py.tables.fits import Fitted, JointChoice
from modcal_msgs_py.tables.labels import COMMANDED, EFFORT, MEASURED, OTHER, VELOCITY, Label, grouped, words
from modcal_msgs_py.tables.readings import EFFORTS, UNITS

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


@dataclass(frozen=True)
class Surroundings:
    """A table of which joints, readings and times are known. taken: their columns. stamps: of the rows [s], None where
    only their order is known. bystanders: other joints of the robot description, each with whether it turns.
    """

    numbers: Numbers
    chain: Mechanism
    choice: JointChoice
    fitted: Fitted | None
    taken: set[int]
    stamps: Array | None
    inertias: Inertias | None
    bystanders: Mapping[str, bool] = field(default_factory=dict)

    def by_joint(self, columns: Sequence[int]) -> dict[str, Any]:
        """Columns by joint, as a mapping names them."""
        return dict(zip(self.chain.own_names, self.numbers.keys(columns), strict=True))

    @property
    def q(self) -> Array:
        """Joint positions (N, n) [rad, m]."""
        return self.choice.postures(self.chain, self.numbers.values)


def find_beside(around: Surroundings, labelled: Sequence[LabelledJoints]) -> OtherColumns:
    """What the columns are that are neither joints nor readings nor time. labelled: families of as many as joints."""
    out = OtherColumns()
    free = [j for j in labelled if not set(j.columns) & around.taken]
    q = around.q
    _commanded(out, around, [j for j in free if j.role == COMMANDED], q)
    _velocity(out, around, [j for j in free if j.role == VELOCITY], q)
    _effort(out, around, [j for j in free if j.role == EFFORT], q)
    _bystanders(out, around)
    if around.fitted is not None and not around.fitted.body.points:
        _deviations(out, around.numbers, around.fitted)
    _temperatures(out, around, [j for j in free if j.role == OTHER])
    _signals(out, around, [j for j in free if j.role in (OTHER, EFFORT)], {k for j in free for k in j.columns})
    return out


def _commanded(out: OtherColumns, around: Surroundings, some: Sequence[LabelledJoints], q: Array) -> None:
    """Labelled columns that are near the joints in one unit, and in no other."""
    choice, chain = around.choice, around.chain
    for one in some:
        units = {}
        for angle in ("rad", "deg"):
            values = JointChoice(one, angle, choice.length, choice.counted).postures(chain, around.numbers.values)
            gap = np.abs(values - q)
            if np.isfinite(gap).any() and bool((np.nanmedian(gap, axis=0) < _FOLLOWS).all()):
                units[angle] = float(np.nanmedian(gap))
        if not units:
            continue
        angle = min(units, key=lambda unit: units[unit])
        own = {"unit": angle} if angle != choice.angle and np.any(chain.revolute) else {}
        out.joints["commanded"] = {**own, "columns": around.by_joint(one.columns)}
        out.used |= set(one.columns)
        near = f"they are as near as {units[angle]:.2g} rad"
        out.said.append(f"columns labelled as commanded are the commanded joints in {angle}: {near}")
        return


def _velocity(out: OtherColumns, around: Surroundings, some: Sequence[LabelledJoints], q: Array) -> None:
    numbers = around.numbers
    if not some:
        return
    one = min(some, key=lambda j: "target" in numbers.labels[j.columns[0]].words)
    shown = f"{numbers.shown(one.columns[0])} … {numbers.shown(one.columns[-1])}"
    told = _SPEEDS.get(numbers.labels[one.columns[0]].told)
    slope = None if around.stamps is None else _slope(numbers.values[:, list(one.columns)], q, around.stamps)
    scales = {"rad/s": 1.0, "deg/s": 180.0 / np.pi}
    shows = next((u for u, s in scales.items() if slope is not None and s / _SLOPE < slope < s * _SLOPE), None)
    if not np.all(around.chain.revolute) or (told is None and slope is None):
        out.said.append(f"speeds {shown} are not used: joints slide, or nothing tells the unit; state velocity")
        return
    if slope is not None and shows is None:
        times = f"{slope:.3g} times" if slope else "no multiple of"
        out.questions.append(f"speeds {shown} are {times} the joints' slopes in rad/s: state velocity, or leave it out")
        return
    if slope is None:
        out.said.append(f"speeds {shown} are in {told}, as their labels say")
    else:
        if told not in (None, shows):
            out.questions.append(f"labels say that {shown} are in {told}; the joints' own motion says {shows}")
        out.proved.append(f"speeds {shown} in {shows}: they are {slope:.3g} times the slopes of the joints in rad/s")
    out.joints["velocity"] = {"unit": shows or told, "columns": around.by_joint(one.columns)}
    out.used |= set(one.columns)


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


def _effort(out: OtherColumns, around: Surroundings, some: Sequence[LabelledJoints], q: Array) -> None:
    for one in some:
        label = around.numbers.labels[one.columns[0]]
        shown = f"{around.numbers.shown(one.columns[0])} … {around.numbers.shown(one.columns[-1])}"
        unit = _TORQUES.get(label.told)
        if label.told and unit is None:
            continue  # per cent of something: a signal
        values = EFFORTS[unit or "N m"] * around.numbers.values[:, list(one.columns)]
        holds = _holds(around.chain, around.inertias, q, values)
        if unit is None and not abs(holds) > _HOLDS:
            out.said.append(f"efforts {shown} are not used: no unit is told, and they do not hold this arm up")
            continue
        stated: dict[str, Any] = {"columns": around.by_joint(one.columns)}
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


def _holds(chain: Mechanism, inertias: Inertias | None, q: Array, effort: Array) -> float:
    """Correlation of efforts (N, n) with what holds the bodies up against gravity; 0 where these are not known."""
    rows = np.isfinite(q).all(axis=1) & np.isfinite(effort).all(axis=1)
    if inertias is None or not inertias.known or rows.sum() < _MIN_MOVING:
        return 0.0
    turning = np.asarray(chain.revolute, bool)
    wrench = gravity_wrench(chain, inertias, q[rows])
    asked = -np.where(turning[:, None], wrench[:, 5], wrench[:, 2]).T
    a, b = (x - x.mean(axis=0) for x in (asked[:, chain.own], effort[rows]))
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.sum(a * b)) / size if size > 0.0 else 0.0


def _bystanders(out: OtherColumns, around: Surroundings) -> None:
    """Other joints of the robot description, by their names; turning ones in the arm's unit where no label says it."""
    for name, turns in around.bystanders.items():
        own, free = Label.of(name).words, around.numbers.free(around.taken | out.used)
        columns = [k for k, label in free.items() if label.words == own and label.role == MEASURED]
        unit = around.numbers.labels[columns[0]].unit if len(columns) == 1 else None
        unit = unit or (around.choice.angle if turns else None)
        if len(columns) != 1 or unit not in (("rad", "deg") if turns else ("m", "cm", "mm", "in")):
            continue
        out.joints.setdefault("columns", {})[name] = around.numbers.key(columns[0])
        if unit != around.choice.units(around.chain):
            out.joints.setdefault("units", {})[name] = unit
        out.used.add(columns[0])
        out.said.append(f"{around.numbers.shown(columns[0])} is the joint {name}, which is not of this arm, in {unit}")


def _deviations(out: OtherColumns, numbers: Numbers, fitted: Fitted) -> None:
    """Standard deviations that an instrument states of every reading: which columns, of what, in which unit."""
    labels = {k: label for k, label in numbers.labels.items() if k not in fitted.columns and _is_std(label)}
    labels = {k: label for k, label in labels.items() if _positive(numbers.values[:, k])}
    for columns in grouped(labels, "deviation"):
        label = labels[columns[0]]
        what = "orientation" if _TURNED & set(label.words) else "position"
        coverage = float(label.coverage or 1.0)
        if what in out.std or set(columns) & out.used or len(columns) not in (1, 3):
            continue
        if (what == "orientation" and fitted.best.meaning.turning is None) or (
            out.std and coverage != float(out.std.get("coverage", 1.0))
        ):
            continue
        unit = _unit_of_std(fitted, label, float(np.nanmedian(numbers.values[:, list(columns)])) / coverage, what)
        shown = numbers.shown(*columns)
        if unit is None:
            out.said.append(f"standard deviations {shown} are not used: no unit makes them plausible; state std")
            continue
        keys = numbers.keys(columns)
        out.std |= {what: keys if len(keys) == 3 else keys[0]}
        out.std |= {"unit" if what == "position" else "orientation_unit": unit}
        out.std |= {"coverage": coverage} if coverage > 1.0 else {}
        of = f"{label.coverage} standard deviations" if coverage > 1.0 else "standard deviations"
        axes = "" if len(columns) == 3 else " along each axis"
        out.said.append(f"{shown} are {of} of the {what}{axes}, in {unit}")
        out.used |= set(columns)


def _is_std(label: Label) -> bool:
    words = set(label.words)
    return bool(_STD & words or _SHORT.search(label.name) or (label.coverage and re.search(r"\bu[xyz]?\b", label.name)))


def _positive(values: Array) -> bool:
    there = values[np.isfinite(values)]
    return len(there) > 0 and bool((there >= 0.0).all()) and bool((there > 0.0).any())


def _unit_of_std(fitted: Fitted, label: Label, typical: float, what: str) -> str | None:
    """The unit by the label; else that of the readings, or another one, with which the size is an instrument's."""
    turning, match = fitted.best.meaning.turning, fitted.best.match
    units = ("rad", "deg") if what == "orientation" else (fitted.best.meaning.unit, "mm", "m")
    if label.unit is not None or label.told:
        return label.unit if label.unit in (*units, "cm", "in") else None
    most = max(match.typical_angle, 1e-3) if what == "orientation" else max(match.typical, 1e-4)
    fits = [unit for unit in units if _FINEST < UNITS[unit] * typical < most]
    if what == "orientation" and turning is not None and turning.form in ("euler", "rotvec"):
        fits = [unit for unit in fits if unit == ("deg" if turning.degrees else "rad")]
    return fits[0] if fits and (what == "position" or len(fits) == 1) else None


def _temperatures(out: OtherColumns, around: Surroundings, families: Sequence[LabelledJoints]) -> None:
    """Temperatures in °C; a family of as many as there are joints is theirs."""
    numbers = around.numbers
    for one in families:
        if all(_is_warm(numbers, k) for k in one.columns) and set(one.columns) & set(numbers.usable):
            out.temperature |= around.by_joint(one.columns)
            out.used |= set(one.columns)
    for k in numbers.usable:
        if k not in around.taken | out.used and _is_warm(numbers, k):
            name = "_".join(w for w in numbers.labels[k].words if w not in ("c", "degc")) or f"column_{k}"
            out.temperature[name if name not in out.temperature else f"{name}_{k}"] = numbers.key(k)
            out.used.add(k)
    if out.temperature:
        out.said.append(f"temperatures {', '.join(out.temperature)} are in °C")


def _is_warm(numbers: Numbers, k: int) -> bool:
    return bool(_WARM & set(numbers.labels[k].words)) and numbers.labels[k].told not in _NOT_CELSIUS


def _signals(out: OtherColumns, around: Surroundings, families: Sequence[LabelledJoints], of_joints: set[int]) -> None:
    """Take every other labelled column that changes and is neither a counter nor a reading's own error as a signal."""
    numbers, labels = around.numbers, around.numbers.labels
    for one in families:
        words = [w for w in labels[one.columns[0]].words if not w.isdigit() and w not in ("j", "joint", "axis")]
        if set(one.columns) & (out.used | around.taken) or _NOT_A_SIGNAL & set(words):
            continue
        for name, k in zip(around.chain.own_names, one.columns, strict=True):
            if k in numbers.usable:
                out.signals[f"{_topic(words) or 'joint_signal'}/{_topic([name])}"] = numbers.key(k)
                out.used.add(k)
    barred = {k for kind in ("angles", "quaternion", "matrix") for group in grouped(labels, kind) for k in group}
    barred |= {k for k, label in labels.items() if label.axis("position") is not None and label.told not in _TORQUES}
    for k in numbers.usable:
        label, values = labels[k], numbers.values[:, k][np.isfinite(numbers.values[:, k])]
        if k in around.taken | out.used | of_joints | barred or _NOT_A_SIGNAL & set(label.words):
            continue
        if is_counter(values) and bool((values == np.round(values)).all()):
            continue
        if name := _topic(label.words):
            weight = "_" + label.told if label.told in _WEIGHTS else ""  # by which what is carried is known
            name += "" if name.endswith(weight) else weight
            out.signals[name if name not in out.signals else f"{name}_{k}"] = numbers.key(k)
            out.used.add(k)
    if out.signals:
        out.said.append(f"{', '.join(out.signals)} are signals that an error may depend on; remove what is none")


def _topic(words: Sequence[str]) -> str:
    name = _TOPIC.sub("_", "_".join(words)).strip("_")
    return name if name[:1].isalpha() else f"signal_{name}" if name else ""
