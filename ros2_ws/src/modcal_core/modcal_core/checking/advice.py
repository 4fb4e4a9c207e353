"""What to do about a change, and where to measure next to identify it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modcal_core.calibration import Calibration, Model, NoiseModel
from modcal_core.checking.known import FrozenCalibration, tried_stations
from modcal_core.checking.outcome import Alike, Noticed, Recommendation
from modcal_core.geometry import Array
from modcal_core.measurements import POSE, Samples
from modcal_core.moves import (
    BASE,
    FALSE_ALARM,
    FRAME,
    GEAR,
    NOISE,
    SIZES,
    TOOL,
    ZERO,
    CellChange,
    ChangeJudge,
    CheckState,
    FittedChange,
    FoundChanges,
    FrozenKnowledge,
    log_priors,
)

STATIONS = 6  # that are proposed at a time
_SAME = 0.0025  # of the squares: what differs by less over all recorded postures is the same motion (as plan --decide)
_LISTED = 4  # changes that a sentence has room for
_SURE = 1.645  # standard deviations: 95 of 100
_SWEEP = 24  # stations that show a gear's curve: a wave of a turn or two, and some of any other
_UNSEEN_MM = 100.0  # RMS at the tool: a change that must be a decimetre is seen by eye, and not by these stations


def alike_everywhere(change: FittedChange, calibration: Calibration, model: Model, samples: Samples) -> Alike:
    """How far a change and all that explains it as well make the same motion at the recorded postures.

    They do where one contains the other: of its sizes none is refuted there, and a repair suits both.
    """
    if not change.same_as:
        return "poses"
    if not change.hypothesis.sizes or not len(calibration.postures):
        return ""
    state = state_at(calibration.postures, model, samples, calibration.noise, kind=POSE)
    weight, position = _weights(state), slice(3 * len(state.samples))
    own = weight[:, None] * state.columns(change.hypothesis)
    out: Alike = "poses"
    for rival in change.same_as:
        h = rival.candidate.hypothesis
        other = weight[:, None] * state.columns(h) if h.sizes else np.zeros((len(own), 0))
        if not h.sizes or not _contains(own[position], other[position], change.sizes):
            return ""
        if not _contains(own, other, change.sizes):
            out = "positions"
    return "" if out == "positions" and samples.is_pose.any() else out


def _contains(A: Array, B: Array, sizes: Array) -> bool:
    """Whether the motions B (n, l) are among A (n, k), or that of these sizes (k,) of A among B."""
    moved = A @ sizes
    return any(
        float(np.sum((y - X @ np.linalg.lstsq(X, y, rcond=1e-9)[0]) ** 2)) <= _SAME * max(float(np.sum(y**2)), 1e-300)
        for X, y in ((A, B), (B, moved))
    )


def telling_stations(change: FittedChange, calibration: Calibration, model: Model, samples: Samples) -> Array:
    """Recorded postures (k, n) at which a change and what explains it as well differ most, on top of the samples."""
    pool = calibration.postures
    if not len(pool):
        return np.empty((0, samples.q.shape[1]))
    if change.hypothesis.curve >= 0:
        return _along(pool, change.hypothesis.curve, samples.q)
    state = state_at(np.concatenate([samples.q, pool]), model, samples, calibration.noise)
    rows = np.arange(len(state.samples))
    weight = _weights(state)
    moved = weight * (state.columns(change.hypothesis) @ change.sizes)
    sample = np.concatenate([np.tile(rows, 3), np.tile(state.view.pose, 3)]).astype(int)
    rivals = [weight[:, None] * state.columns(j.candidate.hypothesis) for j in change.same_as]
    rivals = [A for A in rivals if A.shape[1]]
    chosen = list(range(len(samples)))
    for _ in range(min(STATIONS, len(pool))):
        inside = np.isin(sample, chosen)
        gap = np.bincount(sample, moved**2, len(rows))  # noise alone would leave the whole motion unexplained
        for A in rivals:
            fit = np.linalg.lstsq(A[inside], moved[inside], rcond=1e-9)[0]
            gap = np.minimum(gap, np.bincount(sample, (moved - A @ fit) ** 2, len(rows)))
        gap[chosen] = -1.0
        chosen.append(int(np.argmax(gap)))
    return np.asarray(state.samples.q[chosen[len(samples) :]])


def _along(pool: Array, joint: int, q: Array) -> Array:
    """Recorded postures that fill the gaps of one joint's positions."""
    have, out = list(q[:, joint]), []
    for _ in range(min(_SWEEP, len(pool))):
        far = np.min(np.abs(pool[:, joint, None] - np.array(have)), axis=1)
        out.append(int(np.argmax(far)))
        have.append(float(pool[out[-1], joint]))
    return np.asarray(pool[out])


def _weights(state: CheckState) -> Array:
    N, M = len(state.samples), len(state.view.pose)
    noise = state.known.noise
    position = 1.0 / np.maximum(np.broadcast_to(noise.of(state.samples), N), 1e-9)
    return np.r_[np.tile(position, 3), np.full(3 * M, 1.0 / max(noise.rotation, 1e-9))]


def noticed(judge: ChangeJudge, state: CheckState, asked: Sequence[CellChange]) -> tuple[Noticed, ...]:
    """The smallest base, tool, zero and scale of those asked for that 95 of 100 such checks notice, RMS at the tool
    [mm], and which of them no check of these stations notices.
    """
    prior = log_priors(asked)
    N, n = len(state.samples), len(state.null.residual)
    member = judge.null.reference if judge.null.widest < 0 else judge.null.widest
    worst: dict[str, float] = {}
    unseen: dict[str, list[str]] = {}
    for h, p in zip(asked, prior, strict=True):
        if h.kind in (NOISE, GEAR) or not h.sizes or h.kind not in (BASE, FRAME, TOOL, ZERO, "tracker_scale"):
            continue
        A = state.columns(h)
        need = _needed(A.shape[1], n, float(p), judge.null.weight)
        whitened = np.linalg.norm(judge.whitened(A, member), axis=0)
        moved = np.sqrt(np.sum(A[: 3 * N] ** 2, axis=0) / N)
        seen = whitened > 0.0
        if seen.any():
            name = {BASE: "base", FRAME: "frame", TOOL: "tool", ZERO: "joint zero"}.get(h.kind, "tracker scale")
            mm = float(np.max(1e3 * moved[seen] * need / whitened[seen]))
            if mm > _UNSEEN_MM:
                unseen.setdefault(name, []).append(h.label)
            else:
                worst[name] = max(worst.get(name, 0.0), mm)
    names = dict.fromkeys((*worst, *unseen))
    return tuple(Noticed(name, worst.get(name, np.inf), tuple(unseen.get(name, ()))) for name in names)


def _needed(k: int, n: int, log_prior: float, weight: float) -> float:
    """The length, in standard deviations, of a change of k sizes that is noticed in 95 of 100 cases."""
    limit = -np.log(FALSE_ALARM) / weight - log_prior
    for gain in np.geomspace(1.0, 1e4, 400):
        g = SIZES**2 * n / k
        low = max(gain - 2.0 * _SURE * np.sqrt(gain), 0.0)
        logs = -0.5 * k * np.log1p(g) + 0.5 * low * g / (1.0 + g)
        if float(np.log(np.mean(np.exp(np.minimum(logs, 600.0))))) > limit:
            return float(np.sqrt(gain))
    return np.inf


def advise(
    found: FoundChanges, calibration: Calibration, frozen: FrozenCalibration, alike: Sequence[Alike], untried: bool
) -> Recommendation:
    """What to do. untried: whether what was found may be the calibration itself, where it was not made."""
    changes = found.changes
    if untried and len(calibration.postures):
        said = "Measure these stations, which lie in the joint ranges that were calibrated, and check with them alone."
        return Recommendation("add_stations", said, tried_stations(calibration))
    if found.more:
        return Recommendation(
            "calibrate_again",
            "Calibrate again: what is left after the changes above is no noise. Check first that robot, tool and "
            "instrument are those of the calibration.",
        )
    if not changes and any(len(c.hypothesis.motions) == 6 for c in found.given):
        return Recommendation("refit_base", "Use the repaired model, which knows where the instrument stands now.")
    if not changes:
        return Recommendation("nothing", "Nothing needs to be done.")
    curve = next((c for c in changes if c.hypothesis.curve >= 0), None)
    if curve is not None:
        stations = telling_stations(curve, calibration, frozen.model, found.samples)
        said = (
            f"Measure these {len(stations)} stations as well, which cover the range of {curve.hypothesis.place}, and "
            "check again with all of them; if the curve then has no simple form, calibrate again."
        )
        return Recommendation("add_stations", said, stations)
    for change, same in zip(changes, alike, strict=True):
        if change.same_as and not same and change.hypothesis.kind != NOISE:
            stations = telling_stations(change, calibration, frozen.model, found.samples)
            every = [change.judged.label, *dict.fromkeys(j.label for j in change.same_as)]
            rivals = " and ".join(every if len(every) <= _LISTED else (*every[:_LISTED], "others"))
            said = f"Measure these {len(stations)} stations as well and check again with all: they tell {rivals} apart."
            return Recommendation("add_stations", said, stations)
    kinds = {c.hypothesis.kind for c in changes}
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
    like = samples.select(np.zeros(len(q), int))
    if kind is not None:
        like = replace(like, kind=np.full(len(q), kind, dtype=like.kind.dtype))
    unknown = np.full(q.shape, np.nan)
    poses = replace(like, q=q, station=np.arange(len(q)), velocity=np.zeros_like(q), effort=unknown)
    poses = replace(poses, acceleration=np.zeros_like(q), approach=np.zeros_like(q), following=unknown)
    T = model.predict_samples(poses)
    poses = replace(poses, reading=T[:, :3, 3], R=np.where(poses.is_pose[:, None, None], T[:, :3, :3], np.eye(3)))
    return CheckState(model, poses, FrozenKnowledge((), np.zeros((0, 0)), (), noise))
