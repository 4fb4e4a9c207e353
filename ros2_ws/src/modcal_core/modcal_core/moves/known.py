"""A frozen calibration as a check uses it: the model beside the new samples, what it knows, and where it was made.

Its covariance says how well its parameters are known, not how well an arm of those parameters is the arm. Within the
ranges it was made from that has been tried; beyond, what it does not have may be as large as what it has corrected.

Where a frame stands that the calibration does not know (an instrument set up again under another name, a new socket) is
found from the readings of the check, and stays open while changes are looked for. That the base moved cannot be told
there; what the arm and the tool did can.

The repaired calibration is the frozen one with only what changed put in. The sizes of a change were fitted with the
frozen model's own uncertainty as a part of the noise, so they are the best that the new readings and the old
calibration give together. Where they stand they make up for a part of what the kept model errs by; the covariance of
the repaired model leaves that out, and is too wide rather than too narrow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    Model,
    ModelParameter,
    NoiseModel,
    Uncertainty,
    direction_names,
    exact_samples,
    refit_cell,
)
from modcal_core.effects import Effect
from modcal_core.errors import BadRecording, BadTable
from modcal_core.geometry import Array, combined
from modcal_core.hypotheses import HandEye, explain
from modcal_core.measurements import POSE, Samples
from modcal_core.measurements.kinds import KIND_NAMES, is_direct
from modcal_core.moves import rows
from modcal_core.moves.likelihood import FrozenKnowledge, parameter_rows
from modcal_core.moves.rows import BASE, FRAME, NOISE, STEP, TOOL, CellChange, GeometryMotion, put_in, towards
from modcal_core.moves.searching import FoundChanges
from modcal_core.moves.state import CheckState
from modcal_core.robots import joint_ranges

_POSTURES = 40  # at which a change is written as deviations of the calibration's own parameters
PATTERN = 0.25  # share of the variance that is taken to be common to neighbouring postures where no report says it
_MIN_PATTERN = 0.1  # the same where a report saw none: of 160 stations it sees no less than some ten per cent
_MAX = 0.5  # of the stations, beyond which what they say together is of places where nothing was tried
_MARGIN = 0.02  # of a range, as where samples outside are counted
_MIN = 8  # stations, of which most must agree before others are said to be wrong
# no other metre, links or scatter
_CHANGES = (BASE, FRAME, TOOL, rows.ZERO, rows.GEAR, rows.LOAD, rows.LINK, rows.PLAY)
_MOVED = {BASE: "the base (or the tracker)", TOOL: "the tool (or the target on it)"}


def pattern_of(predictable: float | None) -> float:
    """The share of the noise that neighbouring postures have in common, by the predictable share in the calibration's
    report; None where there is no report.
    """
    return PATTERN if predictable is None else float(np.clip(predictable, _MIN_PATTERN, 1.0))


def frozen(calibration: Calibration, applied: Model, pattern: float) -> FrozenKnowledge:
    """What the calibration knows of itself; nothing where it keeps no covariance.

    applied: its model with the effects that the samples allow. pattern: share of its noise that postures have in
    common.
    """
    own = calibration.uncertainty or Uncertainty((), np.zeros((0, 0)))
    kept = np.ones(len(own.parameters), bool)
    effects = []
    for effect in calibration.calibrated.effects if calibration.uncertainty else ():
        count = len(effect.values)
        applies = any(effect is e or (effect.key == e.key and len(e.values) == count) for e in applied.effects)
        effects += [effect] * applies
        kept = np.r_[kept, np.full(count, applies)]
    covariance = own.covariance[np.ix_(kept, kept)]
    return FrozenKnowledge(calibration.noise, own.parameters, covariance, tuple(effects), pattern)


def in_known_frames(samples: Samples, calibration: Calibration) -> Samples:
    """The samples with the calibration's frames, by their numbers there."""
    number = np.array([calibration.frames.index(name) for name in samples.frames])
    return replace(samples, frames=calibration.frames, frame=number[samples.frame])


def new_frames(calibration: Calibration, samples: Samples) -> tuple[str, ...]:
    """Frames of the samples that the calibration does not know. Raises BadTable where readings do not place one."""
    new = tuple(name for name in samples.frames if name not in calibration.frames)
    for name in new:
        if not is_direct(np.unique(samples.kind[samples.frame == samples.frames.index(name)]).tolist()):
            raise BadTable(
                f"frame '{name}' of the recording",
                f"the calibration knows only {', '.join(calibration.frames)}, and such readings do not place it",
                "give the frame its name of then, or calibrate again with this instrument",
            )
    return new


def with_new_frames(calibration: Calibration, applied: Model, samples: Samples, new: tuple[str, ...]) -> Calibration:
    """The calibration with these frames where its arm and tool put them. Raises NotEnoughData for too few readings.

    applied: its model with the effects that these samples allow. Its covariance has the new frames' six numbers, taken
    for exact: what is not known of them is in the sizes of what is given.
    """
    numbers, first = [samples.frames.index(name) for name in new], len(calibration.frames)
    part = samples.select(np.flatnonzero(np.isin(samples.frame, numbers)))
    part = replace(part, frames=new, frame=np.array([numbers.index(f) for f in part.frame.tolist()], dtype=int))

    def added(model: Model, by: Model) -> Model:
        poses = refit_cell(by, part, Cell(), base=True, tool=False).model.T_frame_base
        leaders = (*model.leaders, *range(first, first + len(new))) if model.leaders else ()
        T_frame_base = np.concatenate([model.T_frame_base, poses])
        return replace(model, frames=(*model.frames, *new), T_frame_base=T_frame_base, leaders=leaders)

    known = calibration.uncertainty
    if known is not None:
        words = direction_names(calibration.nominal.chain.joint_basis[0])
        more = [
            ModelParameter(f"frame {name}/{words[d]}", 0, d, first + i)
            for i, name in enumerate(new)
            for d in _directions(samples, name)
        ]
        at = [len(known.parameters)] * len(more)
        known = Uncertainty((*known.parameters, *more), np.insert(np.insert(known.covariance, at, 0.0, 0), at, 0.0, 1))
    nominal, geometric = (added(model, model) for model in (calibration.nominal, calibration.geometric))
    calibrated = added(calibration.calibrated, applied)
    return replace(calibration, nominal=nominal, calibrated=calibrated, geometric=geometric, uncertainty=known)


def newly_placed(samples: Samples, new: tuple[str, ...]) -> tuple[CellChange, ...]:
    """What is given of these frames: each stands elsewhere than at its first guess."""

    def motions(name: str) -> tuple[GeometryMotion, ...]:
        return towards(0, _directions(samples, name), samples.frames.index(name))

    return tuple(CellChange(FRAME, name, motions(name)) for name in new)


def _directions(samples: Samples, name: str) -> range:
    """A socket shows one point, which has no orientation."""
    return range(3) if samples.is_same_point(samples.frames.index(name)) else range(6)


@dataclass(frozen=True)
class BeyondRanges:
    """outside: how many of the stations stand beyond the ranges, of how many. corrected: RMS [m] at the tool by which
    the calibration differs from the nominal arm at these stations.
    """

    outside: int
    of: int
    corrected: float

    @property
    def mostly(self) -> bool:
        """Whether most of them do."""
        return self.outside > _MAX * self.of

    @property
    def untried_mm(self) -> float:
        """RMS [mm] that the model may lack where most stations stand beyond the ranges; else 0."""
        return 1e3 * self.corrected if self.mostly else 0.0


def beyond_ranges(calibration: Calibration, model: Model, samples: Samples) -> BeyondRanges:
    """How many of these stations stand where the calibration was not made. model: the frozen one, for these samples."""
    low, high = calibration.seen
    margin = _MARGIN * (high - low)
    first = np.unique(samples.station, return_index=True)[1]
    q = samples.q[first]
    out = ((q < low - margin) | (q > high + margin)).any(axis=1)
    nominal = calibration.nominal.predict(q, samples.frame[first])[:, :3, 3]
    moved = model.predict_samples(samples.select(first))[:, :3, 3] - nominal
    return BeyondRanges(int(out.sum()), len(first), float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))))


def spread_out(samples: Samples, most: int) -> Samples:
    """The samples at no more than so many stations, one of each stretch of the recording; all, where there are fewer.

    Distances between postures are those of their joint positions [rad, m].
    """
    stations, first = np.unique(samples.station, return_index=True)
    if len(stations) <= most:
        return samples
    q, taken = samples.q[first], list[int]()
    nearest = np.linalg.norm(q - q.mean(axis=0), axis=1)
    for stretch in np.array_split(np.arange(len(stations)), most):
        at = int(stretch[np.argmax(nearest[stretch])])
        away = np.linalg.norm(q - q[at], axis=1)
        nearest = np.minimum(nearest, away) if taken else away
        taken.append(at)
    return samples.select(np.flatnonzero(np.isin(samples.station, stations[taken])))


def require_accounted(found: FoundChanges, samples: Samples, doubt: BadRecording | None, model: Model) -> None:
    """Raises BadRecording unless what was found explains the readings, as an arm's with one base and one tool.

    A curve that may take any course has a number for every station, so that only one of them counts. Where nothing
    else is wrong with the recording it is the doubt. samples: all that were looked at. model: frozen.
    """
    named = [c.hypothesis for c in found.changes]
    step = next((h.effect for h in named if h.kind == STEP), None)
    if step is not None and not found.more:
        kept = found.samples.select(np.argsort(found.samples.stamps, kind="stable"))
        k = int(np.searchsorted(kept.stamps, step.shape.settings["at"]))
        between = f"stations {kept.station[k - 1] + 1} and {kept.station[k] + 1} of this recording"
        raise BadRecording(
            f"{_MOVED[step.place]} moved between {between}",
            "the stations before and those after agree in themselves, and no change before all of them explains both",
            "fix it, and check again with stations that were all taken afterwards",
        )
    explained = not found.more and sum(h.free for h in named) < 2 and all(h.kind in _CHANGES for h in named)
    if explained and (doubt is None or named):
        return
    case = HandEye.of(samples, model.with_effects(()).chain)
    if case is not None and len(case) >= _MIN and np.ptp(case.q, axis=0).all():  # of joints that stand it is said
        answer = explain(replace(case, station=case.station + 1))  # as people count them
        if answer.said and (doubt is not None or all(h.touches == "rows" for h in answer.said)):
            seen = "" if doubt is None else f"{doubt.limit}; "
            why = f"{answer.stations} of {len(case)} stations are concerned, and agree with the arm once that is undone"
            raise BadRecording(answer.what, seen + why, f"{answer.remedy}, and check again")
    if doubt is not None:
        raise doubt


def repaired(calibration: Calibration, found: FoundChanges) -> Calibration | None:
    """The calibration with what was found put in; None where a change has no size that a model could take."""
    changes = (*found.given, *found.changes)
    if not changes or any(not c.hypothesis.sizes and c.hypothesis.kind != NOISE for c in changes):
        return None
    out = calibration
    sized = []
    for change in changes:
        h = change.hypothesis
        if h.kind == NOISE:
            position, rotation = change.judged.noise
            others = {k: position * v for k, v in out.noise.others.items()}
            out = replace(out, noise=NoiseModel(position * out.noise.position, rotation * out.noise.rotation, others))
            continue
        own = replace(h, replaces=_number(h.effect, calibration)) if h.replaces >= 0 else h
        sized.append(own)
        calibrated = put_in(own, out.calibrated, change.sizes)
        # the nominal arm is seen from where it stands now: what the tool and the frames moved by is none of its errors
        plain = {"geometric": bool(h.motions), "nominal": h.kind in (BASE, FRAME, TOOL)}
        moved: dict[str, Any] = {
            what: put_in(own, getattr(out, what), change.sizes) for what, moves in plain.items() if moves
        }
        before, added = range(len(out.calibrated.effects)), len(calibrated.effects) - len(out.calibrated.effects)
        rivals = (*(out.rivals_of(i) for i in before), *[()] * added)
        typical = (*(out.typical_of(i) for i in before), *[None] * added)
        out = replace(out, calibrated=calibrated, rivals=rivals, typical=typical, **moved)
    return replace(out, uncertainty=_known_then(out, sized, found))


def _number(effect: Effect, calibration: Calibration) -> int:
    """Which effect of a calibration this is; two curves of one gear differ in their values only."""
    effects = calibration.calibrated.effects
    return next(i for i, e in enumerate(effects) if e.key == effect.key and np.array_equal(e.values, effect.values))


def _known_then(now: Calibration, changes: list[CellChange], found: FoundChanges) -> Uncertainty | None:
    """The covariance of the repaired model: of what was known, and of the sizes."""
    known = now.uncertainty
    if known is None or not changes:
        return known
    K, old = len(known.parameters) + sum(len(e.values) for e in now.calibrated.effects), len(known.covariance)
    B = np.concatenate([_as_deviations(h, now, known, K) for h in changes], axis=1)
    covariance = B @ found.covariance @ B.T
    covariance[:old, :old] += known.covariance
    return Uncertainty(known.parameters, 0.5 * (covariance + covariance.T))


def _as_deviations(h: CellChange, now: Calibration, known: Uncertainty, K: int) -> Array:
    """The sizes' unit vectors as deviations of the parameters and effect values of a calibration, (K, k)."""
    B = np.zeros((K, h.sizes))
    if not h.motions:
        plain, *moved = (
            np.concatenate([e.values for e in put_in(h, now.calibrated, by).effects])
            for by in np.eye(h.sizes + 1, h.sizes, -1)
        )
        B[len(known.parameters) :] = np.stack(moved, axis=1) - plain[:, None]
        return B
    model, F = replace(now.calibrated.with_effects(()), instruments=()), len(now.frames)
    low, high = joint_ranges(model.chain)
    inside = np.maximum(low, now.seen[0]), np.minimum(high, now.seen[1])
    q = np.random.default_rng(0).uniform(*inside, (_POSTURES * F, model.chain.n))
    samples = exact_samples(model, q, np.arange(len(q)) % F, np.full(len(q), POSE, dtype=KIND_NAMES))
    state = CheckState(model, samples, FrozenKnowledge(now.noise))
    usable = [i for i, p in enumerate(known.parameters) if p.instrument < 0]
    J = parameter_rows(model, state.view, state.drivers, [known.parameters[i] for i in usable])
    B[np.array(usable)] = combined(J.T, state.columns(h))
    return B
