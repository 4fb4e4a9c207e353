"""The repaired calibration: the frozen one with only what changed put in, and what is then known of it.

The sizes of a change were fitted with the frozen model's own uncertainty as a part of the noise, so they are the best
that the new readings and the old calibration give together. Where they stand they make up for a part of what the kept
model errs by; the covariance of the repaired model leaves that out, and is too wide rather than too narrow.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import Calibration, Model, NoiseModel, Uncertainty, exact_samples
from modcal_core.effects import Effect
from modcal_core.geometry import Array
from modcal_core.moves import (
    BASE,
    FRAME,
    NOISE,
    TOOL,
    CellChange,
    CheckState,
    FoundChanges,
    FrozenKnowledge,
    put_in,
)
from modcal_core.robots import joint_ranges

_POSTURES = 40  # at which a change is written as deviations of the calibration's own parameters


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
        geometric = put_in(own, out.geometric, change.sizes) if h.motions else out.geometric
        # the nominal arm is seen from where it stands now: what the tool and the frames moved by is none of its errors
        nominal = put_in(own, out.nominal, change.sizes) if h.kind in (BASE, FRAME, TOOL) else out.nominal
        before, added = range(len(out.calibrated.effects)), len(calibrated.effects) - len(out.calibrated.effects)
        out = replace(
            out,
            calibrated=calibrated,
            geometric=geometric,
            nominal=nominal,
            rivals=(*(out.rivals_of(i) for i in before), *[()] * added),
            typical=(*(out.typical_of(i) for i in before), *[None] * added),
        )
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
    model: Model = now.calibrated.with_effects(())
    rng = np.random.default_rng(0)
    low, high = joint_ranges(model.chain)
    inside = np.maximum(low, now.seen[0]), np.minimum(high, now.seen[1])
    F = len(model.frames)
    q = rng.uniform(*inside, (_POSTURES * F, model.chain.n))
    kinds = np.full(len(q), "pose", dtype="U16")
    samples = exact_samples(replace(model, instruments=()), q, np.arange(len(q)) % F, kinds)
    state = CheckState(replace(model, instruments=()), samples, FrozenKnowledge((), np.zeros((0, 0)), (), now.noise))
    usable = [i for i, p in enumerate(known.parameters) if p.instrument < 0]
    J = state.parameter_rows(tuple(known.parameters[i] for i in usable))
    scale = np.maximum(np.linalg.norm(J, axis=1), 1e-300)
    solved = np.linalg.lstsq((J / scale[:, None]).T, state.columns(h), rcond=1e-9)[0] / scale[:, None]
    B[np.array(usable)] = solved
    return B
