"""The repaired calibration: the frozen one with only what changed put in, and what is then known of it.

The sizes of a change were fitted with the frozen model's own uncertainty as a part of the noise, so they are the best
that the new readings and the old calibration give together. Their errors correlate with those of the kept model:
``c = G r`` with ``r = J_c c + J_θ θ + ε``, so cov(θ, c) = −Σ J_θᵀ Gᵀ.
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


def repaired(calibration: Calibration, found: FoundChanges, index: np.ndarray) -> Calibration | None:
    """The calibration with what was found put in; None where a change has no size that a model could take.

    index: rows of the calibration's covariance that the samples have, as of ``FrozenCalibration``.
    """
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
    return replace(out, uncertainty=_known_then(out, sized, found, index))


def _number(effect: Effect, calibration: Calibration) -> int:
    """Which effect of a calibration this is; two curves of one gear differ in their values only."""
    effects = calibration.calibrated.effects
    return next(i for i, e in enumerate(effects) if e.key == effect.key and np.array_equal(e.values, effect.values))


def _known_then(
    now: Calibration, changes: list[CellChange], found: FoundChanges, index: np.ndarray
) -> Uncertainty | None:
    """The covariance of the repaired model: what was known, what is not known of the sizes, and how they go along."""
    known = now.uncertainty
    if known is None or not changes:
        return known
    K = len(known.parameters) + sum(len(e.values) for e in now.calibrated.effects)
    covariance, cross = np.zeros((K, K)), np.zeros((K, found.sizes.covariance.shape[0]))
    old = len(known.covariance)
    covariance[:old, :old] = known.covariance
    cross[index] = found.sizes.cross
    B = np.concatenate([_as_deviations(h, now, known, K) for h in changes], axis=1)
    together = np.block([[covariance, cross], [cross.T, found.sizes.covariance]])
    moved = np.concatenate([np.eye(K), B], axis=1)
    covariance = moved @ nearest_covariance(together) @ moved.T
    return Uncertainty(known.parameters, 0.5 * (covariance + covariance.T))


def nearest_covariance(C: Array) -> Array:
    """The nearest covariance in units of its own deviations: of changes as large as another tool the cross terms are of
    another posture of its lever than the sizes' own covariance, so that some direction may come out below nothing.
    """
    scale = np.sqrt(np.maximum(np.diag(C), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)  # what is known exactly stays so
    values, vectors = np.linalg.eigh(C / np.outer(unit, unit))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(scale, scale))


def _as_deviations(h: CellChange, now: Calibration, known: Uncertainty, K: int) -> Array:
    """The sizes' unit vectors as deviations of the parameters and effect values of a calibration, (K, k)."""
    P = len(known.parameters)
    B = np.zeros((K, h.sizes))
    if not h.motions:
        first = P
        for i, effect in enumerate(now.calibrated.effects):
            if h.replaces == i:
                B[first : first + len(effect.amplitudes), 0] = h.effect.amplitudes
            at = 0
            for added in h.effects if h.replaces < 0 else ():
                k = len(added.amplitudes)
                if (effect.key, effect.shape) == (added.key, added.shape):
                    B[first : first + k, at : at + k] = np.eye(k)
                at += k
            first += len(effect.values)
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
