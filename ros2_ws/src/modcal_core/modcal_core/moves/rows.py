"""The catalogue of what may have changed: each row is a few columns of the linearised model, zero while nothing has.

A row is geometry (a frame, the tool, a joint's zero, a link), an effect with a size (a ratio, a curve that grew, a
load, the tracker's scale), a curve of one joint that may take any course, the noise of the readings, or single readings
that are wrong.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from modcal_core.calibration import Deviations, Model, RowView, apply_deviations
from modcal_core.effects import (
    ALL,
    AXIS,
    SHIFT,
    Drivers,
    Effect,
    Shape,
    both_signs,
    carried_signals,
    columns,
    one_motion,
)
from modcal_core.effects.families import backlash, compliance, drift, gear_harmonic, gear_ratio, scale, step
from modcal_core.geometry import Array, error_transform, error_values
from modcal_core.measurements import Samples
from modcal_core.robots import is_serial_arm

BASE, FRAME, TOOL, ZERO, LENGTH = "base", "frame", "tool", "joint_zero", "heat"
GEAR, LOAD, SCALE, NOISE, READING = "gear", "load", "tracker_scale", "tracker_noise", "reading"
LINK, PLAY, STEP, DRIFT, PAYLOAD = "link", "tool_play", "step", "drift", "payload"
LIMIT, CARRIED = "limit", "carried"
# Of signals that an arm gives at its work, without an instrument
FRICTION, SLACK, LATENCY, SERVO, OFFSET = "friction", "play", "latency", "servo", "following_offset"
EFFORT, MASS, CAMERA, TAG = "effort", "carried_mass", "camera", "tag"


Quantity = tuple[str, float, str]  # name, factor and unit of a size


@dataclass(frozen=True)
class ChangeKind:
    """What holds of all rows of a kind. label, said: its name and its sentence, with the row's fields; {size}: of its
    first size, {moved}: of a shift and a turn. sizes: that people read. chance: beside other kinds, shared among its
    members; rare ones are looked for, not expected. outside: it is put back or measured otherwise, and no change of the
    arm. grows: whether it only gets larger.
    """

    label: str
    said: str
    sizes: tuple[Quantity, ...] = ()
    chance: float = 1.0
    outside: bool = False
    grows: bool = False


_RARE = 0.25  # chance of what hardly ever changes in a cell, beside 1 for what is moved now and then
COMPLIANCE = ("compliance", 1e6, "urad/(N m)")
_SIX = (*((n, 1e3, "mm") for n in ("x", "y", "z")), *((n, 1e3, "mrad") for n in ("rx", "ry", "rz")))
KINDS = {
    BASE: ChangeKind("{place}", "The {who} has moved{moved}", _SIX, outside=True),
    FRAME: ChangeKind("frame {place}", "Frame {place} has moved{moved}", _SIX, outside=True),
    TOOL: ChangeKind("{place}", "The {who} has moved{moved}", _SIX, outside=True),
    ZERO: ChangeKind("zero of {place}", "The zero of {place} has changed by {size}", (("zero", 1e3, "mrad"),)),
    LENGTH: ChangeKind(
        "length of {link}", "The length of {link} has grown by {size}, as heat does", (("growth", 1e3, "mm"),)
    ),
    GEAR: ChangeKind("gear of {place}", "The gear or encoder of {place} has changed: {size}", (("ratio", 1e6, "ppm"),)),
    LOAD: ChangeKind("load on {place}", "{place} deflects differently under load: {size}", (COMPLIANCE,)),
    PAYLOAD: ChangeKind(
        "load on all joints", "All joints deflect differently under load, as under another payload", (), _RARE
    ),
    SCALE: ChangeKind(
        "scale of the tracker", "The tracker's readings are longer by {size}", (("scale", 1e6, "ppm"),), outside=True
    ),
    NOISE: ChangeKind(
        "noise of the tracker", "The readings scatter more than when the calibration was made: {factors}"
    ),
    READING: ChangeKind("reading {place}", "", (), _RARE),
    LIMIT: ChangeKind("{place} at its limit", "", (), _RARE),
    LINK: ChangeKind("bend of {link}", "The link before {place} is bent{moved}", _SIX, _RARE),
    PLAY: ChangeKind(
        "play of the tool",
        "The tool or the target is loose and stands off to either side by its weight{moved}",
        _SIX,
        _RARE,
    ),
    STEP: ChangeKind(
        "{place} during the recording", "The {place} moved between two stations of the recording{moved}", _SIX, _RARE
    ),
    DRIFT: ChangeKind("drift of {place}", "The {place} drifts{moved}"),
    FRICTION: ChangeKind(
        "friction of {place}", "The friction of {place} has changed by {size}", (("friction", 100.0, "%"),)
    ),
    SLACK: ChangeKind("play of {place}", "{place} has more play: {size}", (("play", 1e3, "mrad"),), _RARE, grows=True),
    LATENCY: ChangeKind(
        "latency of {place}", "Commands to {place} are followed later by {size}", (("delay", 1e3, "ms"),)
    ),
    SERVO: ChangeKind("servo of {place}", "The servo of {place} yields differently under load: {size}", (COMPLIANCE,)),
    OFFSET: ChangeKind(
        "offset of {place}", "{place} stands beside its command by {size} more", (("offset", 1e3, "mrad"),)
    ),
    EFFORT: ChangeKind(
        "efforts of {place}",
        "{place} reports other efforts: {size}",
        (("gain", 100.0, "%"), ("offset", 1.0, "N m")),
        1.0,
        True,
    ),
    MASS: ChangeKind("payload", "What the arm carries has changed by {size}", (("mass", 1.0, "kg"),), outside=True),
    CAMERA: ChangeKind("camera", "The camera on the hand has moved{moved}", _SIX),
    TAG: ChangeKind("tag", "The tag, or the base of the arm, has moved{moved}", _SIX, outside=True),
    CARRIED: ChangeKind(
        "{place} under load", "The {who} moves with the load that is recorded, by each unit of it{moved}", _SIX, _RARE
    ),
}
_WRIST = 3  # joints whose load turns a tool about
_PART, _FEWEST = 3, 8  # stations on either side of a step (a base has six numbers, of three points nine), and of all
_CYCLES = 2  # a turn: eccentric gears and encoders; more waves than ten stations can tell apart are a curve
_GROWS = {"position": GEAR, "load": LOAD, "effort": LOAD, "payload": LOAD}  # an effect of a joint, by its driver
Twist = tuple[float, ...]


@dataclass(frozen=True)
class GeometryMotion:
    """One direction of geometry: a twist (6,) [m, rad] per unit at a place 0 … n, of one frame or of all (-1)."""

    place: int
    twist: Twist
    frame: int = -1


def towards(place: int, directions: Iterable[int], frame: int = -1) -> tuple[GeometryMotion, ...]:
    """Single directions (0 … 5) of a place."""
    return tuple(GeometryMotion(place, tuple(map(float, np.eye(6)[d])), frame) for d in directions)


@dataclass(frozen=True)
class CellChange:
    """One row. kind: of :data:`KINDS`. place: "base", "tool", "tracker", a joint, a frame, or a station's number.

    motions: of geometry, one for every size, or all of one size (together). effects: with their sizes zero, or one as
    it is where a known one grew (then replaces is its number). curve: index of the joint whose curve may take any
    course, else -1. wrong: indices of samples that are wrong. names: others of the same thing. growing: whether it
    grows with time from nothing.
    """

    kind: str
    place: str
    motions: tuple[GeometryMotion, ...] = ()
    effects: tuple[Effect, ...] = ()
    replaces: int = -1
    curve: int = -1
    wrong: tuple[int, ...] = ()
    together: bool = False
    names: tuple[str, ...] = ()
    growing: bool = False

    @property
    def effect(self) -> Effect:
        """The first of the effects."""
        return self.effects[0]

    @property
    def free(self) -> bool:
        """Whether it is a curve that may take any course."""
        return self.curve >= 0

    @property
    def outside(self) -> bool:
        """Whether it is no change of the arm."""
        return KINDS[self.kind].outside

    @property
    def label(self) -> str:
        """What is named, for ``same_as``."""
        return self.worded(KINDS[self.kind].label)

    def worded(self, text: str, **more: str) -> str:
        """A text with the row's own words put in."""
        link = "all links" if self.place == "arm" else f"the link before {self.place}"
        return text.format(place=self.place, link=link, who=" or the ".join((self.place, *self.names)), **more)

    @property
    def key(self) -> tuple[str, str]:
        """What makes two rows one thing to name: two shapes of one gear are one gear."""
        return self.kind, self.place

    @property
    def sizes(self) -> int:
        """How many sizes are fitted; of a free curve none."""
        if self.motions:
            return 1 if self.together else len(self.motions)
        return 1 if self.replaces >= 0 else sum(len(effect.amplitudes) for effect in self.effects)


def hypotheses(model: Model, samples: Samples) -> list[CellChange]:
    """All changes that these samples of this model can be asked about."""
    seen, turns = np.unique(samples.frame), 6 if samples.is_pose.any() else 3
    several = len(seen) > 1
    out = [CellChange(BASE, "base", towards(0, range(6)), names=() if several else one_motion(BASE))]
    out += [CellChange(FRAME, model.frames[f], towards(0, range(6), int(f))) for f in (seen if several else ())]
    out.append(CellChange(TOOL, "tool", towards(model.chain.tool_place, range(turns)), names=one_motion(TOOL)))
    drivers = model.drivers(samples)
    out += _of_joints(model, samples, drivers)
    out += [CellChange(SCALE, "tracker", effects=(_unsized(effect),)) for effect in scale.candidates(drivers)]
    out.append(CellChange(NOISE, "tracker"))
    out += _play(model, drivers, turns)
    out += _carried(model, drivers, turns)
    out += _at_limits(model, samples)
    times = np.unique(samples.stamps)
    if is_serial_arm(model.chain) and not several and not samples.sockets and len(times) >= _FEWEST:
        out += steps(0.5 * (times[_PART - 1 : -_PART] + times[_PART : len(times) - _PART + 1]), turns)
    return out + [CellChange(READING, str(i + 1), wrong=(i,)) for i in range(len(samples))]


def _play(model: Model, drivers: Drivers, turns: int) -> Iterator[CellChange]:
    """A tool or target that is loose: it rests on one side or the other, by the sign of a wrist joint's load."""
    chain = model.chain
    for name in chain.names[-_WRIST:] if is_serial_arm(chain) and chain.n > _WRIST else ():
        if both_signs(drivers.values(f"payload:{name}")):
            loose = backlash.of_tool(name, ALL if turns == 6 else SHIFT)
            yield CellChange(PLAY, "tool", effects=(_unsized(loose, turns),))


def _carried(model: Model, drivers: Drivers, turns: int) -> Iterator[CellChange]:
    """What only shows under a load that a recorded number tells: joints that deflect, base or tool that shift."""
    for signal in carried_signals(drivers):
        for name in model.chain.names if is_serial_arm(model.chain) else ():
            sag = replace(compliance.of_joint(name, 0.0), driver=f"payload:{name},{signal}", shape=Shape("product"))
            yield CellChange(LOAD, name, effects=(_unsized(sag),))
        for place, count in ((BASE, 6), (TOOL, turns)):
            gives = drift.drifting(place, ALL if count == 6 else SHIFT, Shape("linear"))
            of = (_unsized(replace(gives, driver=signal), count),)
            yield CellChange(CARRIED, place, effects=of, names=one_motion(place))


def _at_limits(model: Model, samples: Samples) -> Iterator[CellChange]:
    """Joints that stop, and coordinates that are clipped, at the same end of their range at several samples."""
    every = np.concatenate([samples.q, samples.reading], axis=1).T
    for name, values in zip((*model.chain.names, *"xyz"), every, strict=True):
        for end in (values.min(), values.max()):
            if 1 < len(rows := np.flatnonzero(values == end)) <= len(samples) // 2:
                yield CellChange(LIMIT, name, wrong=tuple(rows.tolist()))


def steps(times: Array, turns: int) -> Iterator[CellChange]:
    """Base or tool that moved between two stations of the recording, at these times [s]."""
    for at in times:
        for place, count in ((BASE, 6), (TOOL, turns)):
            since = step.seen_within(place, ALL if count == 6 else SHIFT, float(at))
            yield CellChange(STEP, place, effects=(_unsized(since, count),))


def _of_joints(model: Model, samples: Samples, drivers: Drivers) -> Iterator[CellChange]:
    chain, serial = model.chain, is_serial_arm(model.chain)
    lengths: list[GeometryMotion] = []
    loads: list[Effect] = []
    ratios = {effect.place: effect for effect in gear_ratio.candidates(drivers)}
    weighed = model.arm is not None and model.arm.weighed
    for j, name in enumerate(chain.names):
        k = chain.first_place + j
        yield CellChange(ZERO, name, towards(k, [5 if chain.revolute[j] else 2]))
        if k > 0 and serial:
            yield CellChange(LINK, name, towards(k, range(6)))
            if (along := chain.length_direction(k)).any():
                lengths.append(GeometryMotion(k, (*map(float, along), 0.0, 0.0, 0.0)))
                yield CellChange(LENGTH, name, (lengths[-1],))
        if name in ratios:
            waves = gear_harmonic.whole(name, _CYCLES) if chain.revolute[j] else ()
            yield from (CellChange(GEAR, name, effects=(_unsized(e),)) for e in (ratios[name], *waves))
            if samples.stations > 3:
                yield CellChange(GEAR, name, curve=j)
        if serial:
            sag = compliance.of_joint(name, 0.0)
            loads.append(_unsized(sag if weighed else replace(sag, driver=f"payload:{name}")))
            yield CellChange(LOAD, name, effects=(loads[-1],))
    if len(loads) > 1:
        yield CellChange(PAYLOAD, "arm", effects=tuple(loads))
    if len(lengths) > 1:
        yield CellChange(LENGTH, "arm", tuple(lengths), together=True)
    for i, effect in enumerate(model.effects):
        driver = effect.driver.partition(":")[0]
        if effect.direction == AXIS and effect.place in chain.names and driver in _GROWS:
            yield CellChange(_GROWS[driver], effect.place, effects=(effect,), replaces=i)


def _unsized(effect: Effect, directions: int = 1) -> Effect:
    """The effect with all sizes zero."""
    size = effect.shape.size * directions
    return replace(effect, values=np.zeros(size), std=np.zeros(size))


def log_priors(rows: Sequence[CellChange]) -> Array:
    """Log prior probability of each row, (H,): by its kind, divided among the kind's members."""
    return _log_priors(tuple(h.key for h in rows))


@lru_cache(maxsize=64)
def _log_priors(keys: tuple[tuple[str, str], ...]) -> Array:
    places = {kind: len({p for k, p in keys if k == kind}) for kind, _ in keys}
    total, variants = sum(KINDS[kind].chance for kind in places), Counter(keys)
    return np.array([np.log(KINDS[k].chance / total / places[k] / variants[k, p]) for k, p in keys])


def hypothesis_columns(h: CellChange, model: Model, view: RowView, drivers: Drivers) -> Array:
    """What readings move by per unit of each size, (3 N + 3 M, k); of a free curve see :func:`curve_root`.

    model: with the change put in so far, so that these are the derivatives there.
    """
    N, M = len(view.samples), len(view.pose)
    if h.growing:
        t = view.samples.stamps
        course = (t - t.min()) / max(float(np.ptp(t)), 1e-9)
        whole = hypothesis_columns(replace(h, growing=False), model, view, drivers)
        return whole * np.concatenate([np.tile(course, 3), np.tile(course[view.pose], 3)])[:, None]
    if h.wrong:
        own = np.concatenate([np.tile(np.arange(N), 3), np.tile(view.pose, 3)])[:, None] == h.wrong
        if h.place in model.chain.names:
            chain, j = model.chain, model.chain.names.index(h.place)
            return own * view.unit_column(chain.first_place + j, 5 if chain.revolute[j] else 2)[:, None]
        if h.kind == LIMIT:
            own[np.arange(len(own)) // N != "xyz".index(h.place)] = False
            return own.astype(float)
        return np.eye(3 * N + 3 * M)[:, own[:, 0]]
    if h.motions:
        out = np.empty((len(h.motions), 3 * N + 3 * M))
        for row, motion in zip(out, h.motions, strict=True):
            view.column(motion.place, np.array(motion.twist), out=row)
            if motion.frame >= 0:
                view.only_frame((motion.frame,), row)
        return out.sum(axis=0)[:, None] if h.together else out.T
    out = np.stack([view.moved_by(terms) for e in h.effects for terms in columns(e, drivers)], axis=1)
    return out if h.replaces < 0 else (out @ h.effect.amplitudes)[:, None]  # the whole effect, by the share it grew


def put_in(h: CellChange, model: Model, by: Array) -> Model:
    """The model with these sizes (k,) of a change put in, on top of what it has of it already.

    An effect that a change adds stands last in the model.
    """
    if h.motions:
        frames, places = np.zeros((len(model.frames), 6)), np.zeros((model.chain.tool_place, 6))
        for motion, size in zip(h.motions, np.broadcast_to(by, len(h.motions)), strict=True):
            if motion.place:
                places[motion.place - 1] += size * np.array(motion.twist)
            else:
                frames[motion.frame if motion.frame >= 0 else slice(None)] += size * np.array(motion.twist)
        own = tuple(np.zeros(len(i.constants)) for i in model.instruments)
        return apply_deviations(model, Deviations(frames, places, np.zeros((len(places), 6)), own))
    effects = list(model.effects)
    ends = np.cumsum([len(added.amplitudes) for added in h.effects])[:-1]
    for added, part in zip(
        h.effects, np.split(by, ends) if h.replaces < 0 else [by[0] * h.effect.amplitudes], strict=True
    ):
        at = h.replaces
        if at < 0:
            at = next((i for i, e in enumerate(effects) if e.key == added.key and e.shape == added.shape), -1)
        if at < 0:
            effects.append(added.started(part))
        else:
            e = effects[at]
            effects[at] = e.with_values(np.r_[e.amplitudes + part, e.values[len(part) :]], e.std)
    return model.with_effects(tuple(effects))


def composed(h: CellChange, total: Array, by: Array) -> Array:
    """The sizes of a change after one more step: of a shift and a turn together they do not simply add."""
    if len(h.motions) != 6 or h.together:
        return total + by
    return np.asarray(error_values(error_transform(total) @ error_transform(by)))
