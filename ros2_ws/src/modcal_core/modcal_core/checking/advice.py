"""What to do about a change, where to measure next to identify it, and what such stations would have shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from modcal_core.calibration import Calibration, Model, NoiseModel, exact_samples
from modcal_core.checking.known import tried_stations
from modcal_core.geometry import Array
from modcal_core.measurements import POSE, Samples
from modcal_core.moves import (
    BASE,
    FALSE_ALARM,
    FRAME,
    NOISE,
    SCALE,
    SIZES,
    TOOL,
    ZERO,
    Alike,
    CheckState,
    FittedChange,
    FoundChanges,
    FrozenKnowledge,
    log_priors,
)

Action = Literal["nothing", "use_repaired", "refit_base", "add_stations", "calibrate_again", "check_instrument"]
STATIONS = 6  # that are proposed at a time
_SAME = 0.0025  # of the squares: what differs by less over all recorded postures is the same motion (as plan --decide)
_LISTED = 4  # changes that a sentence has room for
_SURE = 1.645  # standard deviations: 95 of 100
_SWEEP = 24  # stations that show a gear's curve: a wave of a turn or two, and some of any other
_UNSEEN_MM = 100.0  # RMS at the tool: a change that must be a decimetre is seen by eye, and not by these stations


@dataclass(frozen=True)
class Noticed:
    """The smallest change of a kind that these stations show in 95 of 100 cases: RMS at the tool [mm], inf for none.

    unseen: changes of this kind that they do not show, such as the zero of a joint that turns as the base does.
    """

    label: str
    mm: float
    unseen: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recommendation:
    """action, and what it means here. stations: to be measured next (k, n); empty where none are needed."""

    action: Action
    sentence: str
    stations: Array = field(default_factory=lambda: np.empty((0, 0)))


def alike_everywhere(change: FittedChange, calibration: Calibration, model: Model, samples: Samples) -> Alike:
    """How far a change and all that explains it as well make the same motion at the recorded postures.

    They do where one contains the other: of its sizes none is refuted there, and a repair suits both.
    """
    if not change.same_as:
        return "poses"
    rivals = [rival.hypothesis for rival in change.same_as]
    if not change.hypothesis.sizes or not len(calibration.postures) or not all(h.sizes for h in rivals):
        return ""
    state = state_at(calibration.postures, model, samples, calibration.noise, kind=POSE)
    position = slice(3 * len(state.samples))
    own, *others = (state.weights[:, None] * state.columns(h) for h in (change.hypothesis, *rivals))
    if all(_contains(own, other, change.sizes) for other in others):
        return "poses"
    alike = all(_contains(own[position], other[position], change.sizes) for other in others)
    return "positions" if alike and not samples.is_pose.any() else ""


def _contains(A: Array, B: Array, sizes: Array) -> bool:
    """Whether the motions B (n, l) are among A (n, k), or that of these sizes (k,) of A among B."""
    return any(
        float(np.sum((y - X @ np.linalg.lstsq(X, y, rcond=1e-9)[0]) ** 2)) <= _SAME * max(float(np.sum(y**2)), 1e-300)
        for X, y in ((A, B), (B, A @ sizes))
    )


def telling_stations(change: FittedChange, calibration: Calibration, model: Model, samples: Samples) -> Array:
    """Recorded postures (k, n) at which a change and what explains it as well differ most, on top of the samples; of a
    curve those that fill the gaps of its joint's positions.
    """
    pool, joint = calibration.postures, change.hypothesis.curve
    if joint >= 0:
        have, chosen = list(samples.q[:, joint]), []
        for _ in range(min(_SWEEP, len(pool))):
            far = np.min(np.abs(pool[:, joint, None] - np.array(have)), axis=1)
            chosen.append(int(np.argmax(far)))
            have.append(pool[chosen[-1], joint])
        return np.asarray(pool[chosen])
    if not len(pool):
        return pool
    state = state_at(np.concatenate([samples.q, pool]), model, samples, calibration.noise)
    moved = state.weights * (state.columns(change.hypothesis) @ change.sizes)
    rivals = [state.weights[:, None] * state.columns(j.hypothesis) for j in change.same_as if j.hypothesis.sizes]
    chosen = list(range(len(samples)))
    for _ in range(min(STATIONS, len(pool))):
        inside = np.isin(state.row_samples, chosen)
        rest = [moved] + [moved - A @ np.linalg.lstsq(A[inside], moved[inside], rcond=1e-9)[0] for A in rivals]
        # beside noise alone the whole motion would be left
        gap = np.min([np.bincount(state.row_samples, r**2, len(state.samples)) for r in rest], axis=0)
        gap[chosen] = -1.0
        chosen.append(int(np.argmax(gap)))
    return np.asarray(state.samples.q[chosen[len(samples) :]])


def noticed(found: FoundChanges) -> tuple[Noticed, ...]:
    """The smallest base, tool, zero and scale of those asked for that 95 of 100 such checks notice, RMS at the tool
    [mm], and which of them no check of these stations notices.
    """
    judge, state = found.stages[1].judge, found.stages[0]
    N, null = len(state.samples), judge.null
    member = null.reference if null.widest < 0 else null.widest
    worst: dict[str, float] = {}
    unseen: dict[str, tuple[str, ...]] = {}
    for h, log_prior in zip(found.asked, log_priors(found.asked), strict=True):
        if h.kind not in (BASE, FRAME, TOOL, ZERO, SCALE):
            continue
        A, name = state.columns(h), h.kind.replace("_", " ")
        whitened = np.linalg.norm(judge.whitened(A, member), axis=0)
        moved = np.sqrt(np.sum(A[: 3 * N] ** 2, axis=0) / N)
        if (seen := whitened > 0.0).any():
            need = _needed(A.shape[1], len(A), float(log_prior), null.weight)
            mm = float(np.max(1e3 * moved[seen] * need / whitened[seen]))
            if mm > _UNSEEN_MM:
                unseen[name] = (*unseen.get(name, ()), h.label)
            else:
                worst[name] = max(worst.get(name, 0.0), mm)
    return tuple(Noticed(name, worst.get(name, np.inf), unseen.get(name, ())) for name in {**worst, **unseen})


def _needed(k: int, n: int, log_prior: float, weight: float) -> float:
    """The length, in standard deviations, of a change of k sizes that is noticed in 95 of 100 cases."""
    gain = np.geomspace(1.0, 1e4, 400)
    g = SIZES[:, None] ** 2 * n / k
    low = np.maximum(gain - 2.0 * _SURE * np.sqrt(gain), 0.0)
    logs = np.logaddexp.reduce(-0.5 * k * np.log1p(g) + 0.5 * low * g / (1.0 + g)) - np.log(len(SIZES))
    enough = gain[logs > -np.log(FALSE_ALARM) / weight - log_prior]
    return float(np.sqrt(enough[0])) if len(enough) else np.inf


def advise(found: FoundChanges, calibration: Calibration, alike: Sequence[Alike], untried: bool) -> Recommendation:
    """What to do. untried: whether what was found may be the calibration itself, where it was not made."""
    kinds = {c.hypothesis.kind for c in found.changes}
    if untried and len(calibration.postures):
        said = "Measure these stations, which lie in the joint ranges that were calibrated, and check with them alone."
        return Recommendation("add_stations", said, tried_stations(calibration))
    if found.more:
        return Recommendation(
            "calibrate_again",
            "Calibrate again: what is left after the changes above is no noise. Check first that robot, tool and "
            "instrument are those of the calibration.",
        )
    if not kinds and any(len(c.hypothesis.motions) == 6 for c in found.given):
        return Recommendation("refit_base", "Use the repaired model, which knows where the instrument stands now.")
    if not kinds:
        return Recommendation("nothing", "Nothing needs to be done.")
    for change, same in sorted(zip(found.changes, alike, strict=True), key=lambda pair: not pair[0].hypothesis.free):
        h = change.hypothesis
        if not h.free and (not change.same_as or same or h.kind == NOISE):
            continue
        stations = telling_stations(change, calibration, found.model, found.samples)
        every = [h.label, *dict.fromkeys(j.hypothesis.label for j in change.same_as)]
        rivals = " and ".join(every if len(every) <= _LISTED else (*every[:_LISTED], "others"))
        said = f"Measure these {len(stations)} stations as well and check again with all: they tell {rivals} apart."
        if h.free:
            said = (
                f"Measure these {len(stations)} stations as well, which cover the range of {h.place}, and check again "
                "with all of them; if the curve then has no simple form, calibrate again."
            )
        return Recommendation("add_stations", said, stations)
    if kinds == {NOISE}:
        return Recommendation(
            "check_instrument",
            "Look at the instrument (line of sight, a loose target, its warm-up) and check again; the model may stay.",
        )
    if kinds <= {BASE, FRAME}:
        return Recommendation(
            "refit_base", "Use the repaired model: it differs in the base only, nothing else need be measured."
        )
    return Recommendation("use_repaired", "Use the repaired model: it differs in what is named above only.")


def state_at(q: Array, model: Model, samples: Samples, noise: NoiseModel, kind: str | None = None) -> CheckState:
    """The model at other postures (k, n), with exact readings as the first of the samples is, or of this kind."""
    kinds = np.full(len(q), samples.kind[0] if kind is None else kind)
    exact = exact_samples(model.with_effects(()), q, np.full(len(q), samples.frame[0]), kinds)
    exact = replace(exact, signals=samples.signals, stamps=np.full(len(q), samples.stamps[0]))
    return CheckState(model, exact, FrozenKnowledge((), np.zeros((0, 0)), (), noise))
