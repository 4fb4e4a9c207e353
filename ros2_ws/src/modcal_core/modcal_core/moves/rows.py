"""The changes that a check looks for: each is a few columns of the linearised model, all zero while nothing changed.

A change is geometry (a frame, the tool, a joint's zero, a link's length), an effect with a size (a ratio, a curve that
grew, a load, the tracker's scale), a curve of one joint that may take any course, the noise of the readings, or single
readings that are wrong. Which of them explain the same stations equally well is decided on the stations, see
:mod:`modcal_core.moves.searching`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Deviations, Model, RowView, apply_deviations
from modcal_core.effects import ALL, AXIS, SHIFT, Drivers, Effect, both_signs, columns, one_motion
from modcal_core.effects.families import backlash, compliance, gear_harmonic, gear_ratio, scale, step
from modcal_core.geometry import Array, error_transform, error_values
from modcal_core.measurements import Samples
from modcal_core.moves.noise import varying
from modcal_core.robots import is_serial_arm

BASE, FRAME, TOOL, ZERO, LENGTH = "base", "frame", "tool", "joint_zero", "heat"
GEAR, LOAD, SCALE, NOISE, READING = "gear", "load", "tracker_scale", "tracker_noise", "reading"
LINK, PLAY, STEP, PAYLOAD = "link", "tool_play", "step", "payload"
# chance of each kind beside the others, shared among its members; the rare ones are looked for, not expected
CHANCES = dict.fromkeys((BASE, FRAME, TOOL, ZERO, LENGTH, GEAR, LOAD, SCALE, NOISE), 1.0)
CHANCES |= dict.fromkeys((READING, LINK, PLAY, STEP, PAYLOAD), 0.25)
_MEAN = 0.1  # share of its square that is one number at all stations: few stations see the mean of a wave as well
_WRIST = 3  # joints whose load turns a tool about
_PART, _FEWEST = 3, 8  # stations on either side of a step (a base has six numbers, of three points nine), and of all
MAX_CYCLES = 2  # a turn: eccentric gears and encoders; more waves than ten stations can tell apart are a curve
_GROWS = {
    "position": GEAR,
    "load": LOAD,
    "effort": LOAD,
    "payload": LOAD,
}  # what an effect of a joint is, by its driver


@dataclass(frozen=True)
class GeometryMotion:
    """One direction of geometry: a twist (6,) [m, rad] per unit at a place 0 … n, of one frame or of all (-1)."""

    place: int
    twist: tuple[float, ...]
    frame: int = -1


@dataclass(frozen=True)
class CellChange:
    """One change. kind: of :data:`CHANCES`. place: "base", "tool", "tracker", a joint, a frame, or a station's number.

    motions: of geometry, one for every size, or all of one size (together). effects: with their sizes zero, or one as
    it is where a known one grew (then replaces is its number). curve: index of the joint whose curve may take any
    course, else -1. sample: index of the reading that is wrong, else -1. names: others of the same thing. growing:
    whether it grows with time from nothing.
    """

    kind: str
    place: str
    motions: tuple[GeometryMotion, ...] = ()
    effects: tuple[Effect, ...] = ()
    replaces: int = -1
    curve: int = -1
    sample: int = -1
    together: bool = False
    names: tuple[str, ...] = ()
    growing: bool = False

    @property
    def effect(self) -> Effect:
        """The first of the effects."""
        return self.effects[0]

    @property
    def outside(self) -> bool:
        """Whether it is no change of the arm: it is put back, or measured otherwise."""
        return self.kind in (BASE, FRAME, TOOL, SCALE)

    @property
    def label(self) -> str:
        """What is named, for ``same_as``."""
        return {
            BASE: "base",
            FRAME: f"frame {self.place}",
            TOOL: "tool",
            ZERO: f"zero of {self.place}",
            LENGTH: f"length of the link before {self.place}" if self.place != "arm" else "length of all links",
            GEAR: f"gear of {self.place}",
            LOAD: f"load on {self.place}",
            SCALE: "scale of the tracker",
            NOISE: "noise of the tracker",
            READING: f"reading {self.place}",
            LINK: f"bend of the link before {self.place}",
            PLAY: "play of the tool",
            STEP: f"{self.place} during the recording",
            PAYLOAD: "load on all joints",
        }[self.kind]

    @property
    def key(self) -> tuple[str, str]:
        """What makes two hypotheses one thing to name: two shapes of one gear are one gear."""
        return self.kind, self.place

    @property
    def sizes(self) -> int:
        """How many sizes are fitted; of a free curve none."""
        if self.motions:
            return 1 if self.together else len(self.motions)
        return 1 if self.replaces >= 0 else sum(len(effect.amplitudes) for effect in self.effects)


def hypotheses(model: Model, samples: Samples) -> list[CellChange]:
    """All changes that these samples of this model can be asked about."""
    n = model.chain.tool_place
    eye = np.eye(6)
    several = len(model.frames) > 1
    names = () if several else one_motion(BASE)
    out = [CellChange(BASE, "base", tuple(GeometryMotion(0, _row(eye[d])) for d in range(6)), names=names)]
    if several:
        for f, name in enumerate(model.frames):
            out.append(CellChange(FRAME, name, tuple(GeometryMotion(0, _row(eye[d]), f) for d in range(6))))
    turns = 6 if samples.is_pose.any() else 3
    motions = tuple(GeometryMotion(n, _row(eye[d])) for d in range(turns))
    out.append(CellChange(TOOL, "tool", motions, names=one_motion(TOOL)))
    drivers = model.drivers(samples)
    out += _of_joints(model, samples, drivers)
    out += [CellChange(SCALE, "tracker", effects=(_unsized(effect),)) for effect in scale.candidates(drivers)]
    out.append(CellChange(NOISE, "tracker"))
    out += _of_the_tool(model, drivers, turns)
    out += steps(model, samples, turns)
    return out + [CellChange(READING, str(i + 1), sample=i) for i in range(len(samples))]


def _of_the_tool(model: Model, drivers: Drivers, turns: int) -> Iterator[CellChange]:
    """A tool or target that is loose: it rests on one side or the other, by the sign of a wrist joint's load."""
    chain = model.chain
    for name in chain.names[-_WRIST:] if is_serial_arm(chain) and chain.n > _WRIST else ():
        load = drivers.values(f"payload:{name}")
        if both_signs(load):
            direction = ALL if turns == 6 else SHIFT
            loose = backlash.of_tool(name, direction)
            yield CellChange(PLAY, "tool", effects=(_unsized(loose, turns),))


def steps(model: Model, samples: Samples, turns: int) -> Iterator[CellChange]:
    """Base or tool that moved between two stations of the recording, of which either part has a few."""
    times = np.unique(samples.stamps)
    if not is_serial_arm(model.chain) or len(samples.frames) > 1 or samples.sockets or len(times) < _FEWEST:
        return
    for at in 0.5 * (times[_PART - 1 : -_PART] + times[_PART : len(times) - _PART + 1]):
        for place, direction, count in ((BASE, ALL, 6), (TOOL, ALL if turns == 6 else SHIFT, turns)):
            since = step.seen_within(place, direction, float(at))
            yield CellChange(STEP, place, effects=(_unsized(since, count),))


def _of_joints(model: Model, samples: Samples, drivers: Drivers) -> Iterator[CellChange]:
    chain = model.chain
    lengths: list[GeometryMotion] = []
    loads: list[Effect] = []
    ratios = {effect.place: effect for effect in gear_ratio.candidates(drivers)}
    for j, name in enumerate(chain.names):
        k = chain.first_place + j
        yield CellChange(ZERO, name, (GeometryMotion(k, _row(np.eye(6)[5 if chain.revolute[j] else 2])),))
        along = chain.length_direction(k) if k > 0 and is_serial_arm(chain) else np.zeros(3)
        if k > 0 and is_serial_arm(chain):
            yield CellChange(LINK, name, tuple(GeometryMotion(k, _row(np.eye(6)[d])) for d in range(6)))
        if along.any():
            lengths.append(GeometryMotion(k, (*(float(x) for x in along), 0.0, 0.0, 0.0)))
            yield CellChange(LENGTH, name, (lengths[-1],))
        if name in ratios:
            yield CellChange(GEAR, name, effects=(_unsized(ratios[name]),))
            if chain.revolute[j]:
                yield from (
                    CellChange(GEAR, name, effects=(_unsized(e),)) for e in gear_harmonic.whole(name, MAX_CYCLES)
                )
            if samples.stations > 3:
                yield CellChange(GEAR, name, curve=j)
        if is_serial_arm(chain):
            sag = compliance.of_joint(name, 0.0)
            weighed = model.arm is not None and model.arm.weighed
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


def _row(twist: Array) -> tuple[float, ...]:
    return tuple(float(x) for x in twist)


def _unsized(effect: Effect, directions: int = 1) -> Effect:
    """The effect with all sizes zero."""
    size = effect.shape.size * directions
    return replace(effect, values=np.zeros(size), std=np.zeros(size))


def hypothesis_columns(hypothesis: CellChange, model: Model, view: RowView, drivers: Drivers) -> Array:
    """What readings move by per unit of each size, (3 N + 3 M, k); of a free curve see :func:`curve_root`.

    model: with the change put in so far, so that these are the derivatives there.
    """
    rows = view.position.size + view.rotation.size
    if hypothesis.growing:
        t = view.samples.stamps
        course = (t - t.min()) / max(float(np.ptp(t)), 1e-9)
        whole = hypothesis_columns(replace(hypothesis, growing=False), model, view, drivers)
        return whole * np.concatenate([np.tile(course, 3), np.tile(course[view.pose], 3)])[:, None]
    if hypothesis.sample >= 0:
        N, i = len(view.samples), hypothesis.sample
        index = [i, N + i, 2 * N + i]
        at = np.flatnonzero(view.pose == i)
        M = len(view.pose)
        index += [3 * N + int(a) + d * M for a in at for d in range(3)]
        out = np.zeros((rows, len(index)))
        out[index, np.arange(len(index))] = 1.0
        return out
    if hypothesis.motions:
        out = np.empty((len(hypothesis.motions), rows))
        for row, motion in zip(out, hypothesis.motions, strict=True):
            view.column(motion.place, np.array(motion.twist), out=row)
            if motion.frame >= 0:
                view.only_frame((motion.frame,), row)
        return out.sum(axis=0)[:, None] if hypothesis.together else out.T
    if hypothesis.replaces >= 0:  # the whole effect, by the share that it grew
        moved = np.zeros(rows)
        for amplitude, terms in zip(hypothesis.effect.amplitudes, columns(hypothesis.effect, drivers), strict=True):
            moved += amplitude * view.moved_by(terms)
        return moved[:, None]
    return np.stack([view.moved_by(terms) for e in hypothesis.effects for terms in columns(e, drivers)], axis=1)


def curve_root(joint: int, model: Model, samples: Samples) -> Array:
    """A root (S, r) of the covariance of one joint's curve at the S stations: random sums of its columns are curves of
    the joint's position, half smooth, half of any course.

    A curve that hardly varies is a joint's zero, which is plainer.
    """
    first = np.unique(samples.station, return_index=True)[1]
    course = varying(samples.q[first, joint], bool(model.chain.revolute[joint]))
    values, vectors = np.linalg.eigh((1.0 - _MEAN) * course + _MEAN)
    kept = values > 1e-9
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def put_in(hypothesis: CellChange, model: Model, step: Array) -> Model:
    """The model with these sizes (k,) of a change put in, on top of what it has of it already.

    An effect that a change adds stands last in the model.
    """
    if hypothesis.motions:
        frames, places = np.zeros((len(model.frames), 6)), np.zeros((model.chain.tool_place, 6))
        sizes = np.broadcast_to(step, len(hypothesis.motions)) if hypothesis.together else step
        for motion, size in zip(hypothesis.motions, sizes, strict=True):
            if motion.place:
                places[motion.place - 1] += size * np.array(motion.twist)
            else:
                frames[motion.frame if motion.frame >= 0 else slice(None)] += size * np.array(motion.twist)
        own = tuple(np.zeros(len(i.constants)) for i in model.instruments)
        return apply_deviations(model, Deviations(frames, places, np.zeros((len(places), 6)), own))
    effects = list(model.effects)
    if hypothesis.replaces >= 0:
        grown = effects[hypothesis.replaces]
        linear = len(grown.amplitudes)
        now = grown.amplitudes + step[0] * hypothesis.effect.amplitudes
        effects[hypothesis.replaces] = grown.with_values(np.r_[now, grown.values[linear:]], grown.std)
        return model.with_effects(tuple(effects))
    ends = np.cumsum([len(added.amplitudes) for added in hypothesis.effects])[:-1]
    for added, part in zip(hypothesis.effects, np.split(step, ends), strict=True):
        at = next((i for i, e in enumerate(effects) if e.key == added.key and e.shape == added.shape), -1)
        if at < 0:
            effects.append(added.started(part))
        else:
            e = effects[at]
            effects[at] = e.with_values(np.r_[e.amplitudes + part, e.values[len(part) :]], e.std)
    return model.with_effects(tuple(effects))


def composed(hypothesis: CellChange, total: Array, step: Array) -> Array:
    """The sizes of a change after one more step: of a shift and a turn together they do not simply add."""
    if len(hypothesis.motions) != 6 or hypothesis.together:
        return total + step
    return np.asarray(error_values(error_transform(total) @ error_transform(step)))
