"""What changed, in words and numbers for people, of a check and of a stream alike, and what it may as well be.

And what to do about it, where to measure next to identify it, and what such stations would have shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from modcal_core.calibration import Calibration, Model, NoiseModel, exact_samples
from modcal_core.geometry import Array
from modcal_core.measurements import POSE, Samples, spread_rows
from modcal_core.moves.likelihood import SIZES, FrozenKnowledge
from modcal_core.moves.rows import BASE, COMPLIANCE, FRAME, GEAR, KINDS, NOISE, PAYLOAD, SCALE, TOOL, ZERO, log_priors
from modcal_core.moves.searching import FALSE_ALARM, FittedChange, FoundChanges
from modcal_core.moves.state import CheckState

# how alike two changes are at every recorded posture: not, in the positions that are read, or in poses
Alike = Literal["", "positions", "poses"]
UNTRIED = "the calibration, beyond the joint ranges that it was made from"
# RMS, rad: six degrees, some teeth of a gear at an arm's joint. Angles that differ by more, by another amount at every
# station, are another joint's or no angles of the arm, and a model with them repaired would be nobody's
OF_A_GEAR = 0.1
_95 = 1.959964  # standard deviations
_LISTED = 3  # others that a sentence has room for; check.json and the page have them all
_WHY = {
    "poses": "the same motion at every posture, so the repaired poses are the same",
    "positions": "the same positions at every posture, so these are repaired, but not the same orientations, which "
    "poses would tell",
    "": "these stations cannot tell",
}


@dataclass(frozen=True)
class SizeFound:
    """One size of a change, with its 95 % interval, in the unit that people read."""

    name: str
    value: float
    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        return f"{self.value:+.3g} {self.unit} ({self.low:.3g} … {self.high:.3g})"


@dataclass(frozen=True)
class NamedChange:
    """One change. kind, place: as in :mod:`modcal_core.moves.rows`. label: for people. sizes: of it.

    moved_mm: how far it moves the tool over these stations, RMS, with its 95 % interval. turned_deg: how far it turns
    it, RMS; None where no orientation is read. probability: of this one among all that were looked for. same_as: other
    names of it, and others that explain the readings as well. alike: how far these make the same motion at every
    recorded posture, so that no such station can tell them apart. repairable: whether the sizes are enough to correct
    the model.
    """

    kind: str
    place: str
    label: str
    sentence: str
    sizes: tuple[SizeFound, ...]
    moved_mm: tuple[float, float, float]
    turned_deg: float | None
    probability: float
    same_as: tuple[str, ...]
    alike: Alike
    repairable: bool

    @property
    def likely(self) -> bool:
        """Whether angles are off by no more than a gear can be; a curve of any course may take up anything."""
        return all(s.name != "rms_over_stations" or s.value < 1e3 * OF_A_GEAR for s in self.sizes)


def named(
    change: FittedChange, columns: Array, positions: int, alike: Alike = "", untried_mm: float = 0.0
) -> NamedChange:
    """The change for people.

    columns: motions of the readings per unit of each size (n, k), whose first ``positions`` rows are positions,
    component by component; of a curve the motion of each station's angle (n, S). untried_mm: what the calibration
    corrects where most stations stand beyond its ranges, so that as much may be missing there.
    """
    h, noise = change.hypothesis, change.hypothesis.kind == NOISE
    sizes = _sizes(change)
    moved = (0.0, 0.0, 0.0) if noise else _moved(change, columns[:positions])
    turned = None
    if not noise and len(columns) > positions:
        turned = float(np.degrees(np.sqrt(3.0 * np.mean((columns[positions:] @ change.sizes) ** 2))))
    rivals = tuple(dict.fromkeys(j.hypothesis.label for j in change.same_as))
    # scatter and a curve of any course look like any error; a move that leaves noise is a move
    if (noise or h.free) and moved[0] < untried_mm:
        rivals, alike = (UNTRIED, *rivals), ""
    said = _sentence(change, sizes)
    if not noise:
        turn = "" if turned is None else f" and {turned:.3f}°"
        said += f", {moved[0]:.3f} mm ({moved[1]:.3f} … {moved[2]:.3f}){turn} RMS at the tool"
    if rivals:
        more = len(rivals) - _LISTED
        others = " or ".join(rivals[:_LISTED]) + (f" or one of {more} other changes" if more > 0 else "")
        said += f". It may as well be {others}: {_WHY[alike]}"
    same, repairable = (*h.names, *rivals), noise or bool(h.sizes)
    of = (sizes, moved, turned, change.probability, same, alike, repairable)
    return NamedChange(h.kind, h.place, h.label, f"{said}.", *of)


def _sizes(change: FittedChange) -> tuple[SizeFound, ...]:
    h, values, names = change.hypothesis, change.sizes, KINDS[change.hypothesis.kind].sizes
    std = np.sqrt(np.maximum(np.diag(change.covariance), 0.0))
    if h.kind == NOISE:
        factors = zip(("position", "orientation"), change.judged.noise, strict=True)
        return tuple(SizeFound(what, factor, factor, factor, "times") for what, factor in factors if factor > 1.0)
    if h.free:
        names, values = (("rms_over_stations", 1e3, "mrad"),), np.array([np.sqrt(np.mean(values**2))])
        std = np.array([np.sqrt(np.mean(std**2) / len(std))])
    elif h.replaces >= 0:
        names = (("growth", 100.0, "%"),)
    elif h.kind == PAYLOAD:
        names = tuple((f"compliance of {e.place}", *COMPLIANCE[1:]) for e in h.effects)
    elif h.kind == GEAR and len(values) > 1:  # a wave, and one of twice its cycles
        pairs = values.reshape(-1, 2)
        values = np.linalg.norm(pairs, axis=1)
        ways = pairs / np.maximum(values, 1e-300)[:, None]
        parts = (change.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(pairs)))
        std = np.array([float(np.sqrt(max(way @ C @ way, 0.0))) for way, C in zip(ways, parts, strict=True)])
        names = (("amplitude", 1e3, "mrad"), ("amplitude_2", 1e3, "mrad"))
    elif len(h.motions) == 1 < len(names):  # of one size, along one twist
        way = np.array(h.motions[0].twist)
        values, std = values[0] * way, std[0] * np.abs(way)
    elif h.kind == ZERO and h.motions[0].twist[5] == 0.0:  # of a joint that slides
        names = (("zero", 1e3, "mm"),)
    return tuple(
        SizeFound(name, factor * v, factor * (v - _95 * d), factor * (v + _95 * d), unit)
        for (name, factor, unit), v, d in zip(names, values.tolist(), std.tolist(), strict=False)
    )


def _moved(change: FittedChange, columns: Array) -> tuple[float, float, float]:
    """RMS of the tool's motion [mm] and its 95 % interval."""
    count = max(columns.shape[0] // 3, 1)
    moved = columns @ change.sizes
    rms = float(np.sqrt(np.sum(moved**2) / count))
    gradient = columns.T @ moved / (count * max(rms, 1e-300))
    std = float(np.sqrt(max(float(gradient @ change.covariance @ gradient), 0.0)))
    return 1e3 * rms, max(1e3 * (rms - _95 * std), 0.0), 1e3 * (rms + _95 * std)


def _sentence(change: FittedChange, sizes: tuple[SizeFound, ...]) -> str:
    """What changed and by how much, without what that makes at the tool."""
    h, size = change.hypothesis, str(sizes[0]) if sizes else ""
    if h.replaces >= 0:
        what = f"The curve of {h.place}'s gear" if h.kind == GEAR else f"The deflection of {h.place} under load"
        return f"{what} has grown by {size}"
    if h.free:
        return f"The gear of {h.place} has changed: its curve differs by {sizes[0].value:.3g} mrad RMS"
    if h.kind == GEAR:
        cycles = h.effect.shape.settings.get("cycles", 0.0)
        size = f"{size} at {cycles:.4g} a turn" if cycles else f"its ratio by {size}"
    shift, turn = (float(np.linalg.norm([s.value for s in sizes if s.unit == unit])) for unit in ("mm", "mrad"))
    moved = f"{', more and more' if h.growing else ''}: {shift:.3f} mm and {turn:.3f} mrad"
    factors = " and ".join(f"{s.value:.1f} times in {s.name}" for s in sizes)
    return h.worded(KINDS[h.kind].said, size=size, moved=moved, factors=factors)


Action = Literal["nothing", "use_repaired", "refit_base", "add_stations", "calibrate_again", "check_instrument"]
_ASKED = 10  # stations of the calibration's own that are proposed: as many as a check is to have
STATIONS = 6  # that are proposed at a time
_SAME = 0.0025  # of the squares: what differs by less over all recorded postures is the same motion (as plan --decide)
_TOLD_APART = 4  # changes that a sentence has room for
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
    judge, state = found.opened.judge, found.plain
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
        tried = calibration.postures[spread_rows(len(calibration.postures), _ASKED)]
        return Recommendation("add_stations", said, tried)
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
        stations = telling_stations(change, calibration, found.plain.model, found.samples)
        every = [h.label, *dict.fromkeys(j.hypothesis.label for j in change.same_as)]
        rivals = " and ".join(every if len(every) <= _TOLD_APART else (*every[:_TOLD_APART], "others"))
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
    return CheckState(model, exact, FrozenKnowledge(noise))
