"""What is shipped: the model fitted once more, to every accepted sample, and what is known of it.

Both models are fitted to the inner postures, as far as curves depend on their joints, and judged on the outer fifth.
They are linear in small deviations, so leaving out is a step in closed form: with A the curvature of the whole fit,
prior included, and J, r the weighted derivatives and residuals of what is left out, it moves the values by
−(A − JJᵀ)⁻¹Jr. Where the full model then hardly knows itself, it is doubted for that, and not judged.

Geometry misses by far where a curve is large, and a fit begins from geometry. Where a recording has few stations, all
of them may then be rejected before the curve could bend to them, and what is left of it there is nobody's: it misses
them for ever, and they stay rejected. A wrong reading is one that its neighbours contradict; three that have no other
neighbours are to be fitted first and judged then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import UNSURE, uncertainty
from modcal_core.calibration.data_split import consecutive
from modcal_core.calibration.distances import AnyDistance, distance_rows
from modcal_core.calibration.fit import FITTED, Fit, identify, identify_moved
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.model import Model, curved_joints
from modcal_core.calibration.noise import errors, outlying, row_weights, typical_scatter
from modcal_core.calibration.parameters import ModelParameter, least_change
from modcal_core.calibration.prediction import driver_ranges, signals_of, typical_sizes
from modcal_core.calibration.store import Calibration, parameter_table
from modcal_core.calibration.structure import ParameterChoice
from modcal_core.effects import STEPS, Effect, claimed, is_move, prior_stds
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, marks_of, spread_rows
from modcal_core.robots import Inertias, Mechanism

# --- When exactly something happened: the moment of a step, sharpened by samples that the search for it did not use

_AROUND = 12  # stations on either side of a step that are tried


def sharpened(model: Model, samples: Samples) -> Model:
    """The model with the moment of every step, and of every load that came, put between the stations that fit best."""
    effects = model.effects
    for i, effect in enumerate(effects):
        for end in ("since", "at") if effect.shape.kind in (*STEPS, "since") else ():
            if end in effect.shape.settings:
                effects = (*effects[:i], _sharpened(model, effects, i, samples, end), *effects[i + 1 :])
    return model if effects is model.effects else model.with_effects(effects)


def _sharpened(model: Model, effects: tuple[Effect, ...], i: int, samples: Samples, end: str) -> Effect:
    stamps = np.unique(samples.stamps)
    here = int(np.searchsorted(stamps, effects[i].shape.settings[end]))
    gaps = [k for k in range(here - _AROUND, here + _AROUND + 1) if 0 < k < len(stamps)]
    near = samples.select(
        (samples.stamps >= stamps[max(gaps[0] - 1, 0)]) & (samples.stamps <= stamps[min(gaps[-1], len(stamps) - 1)])
    )
    lever = model.chain.reach()  # what a turn is worth, where it moves nothing
    best, least = effects[i], np.inf
    for k in sorted(gaps, key=lambda k: abs(k - here)):
        shape = effects[i].shape.with_settings({end: float(0.5 * (stamps[k - 1] + stamps[k]))})
        moved = replace(effects[i], shape=shape)
        e = errors(model.with_effects((*effects[:i], moved, *effects[i + 1 :])), near)
        cost = float(np.sum(e.position_norm**2)) + lever**2 * float(np.sum(e.rotation_norm**2))
        if cost < least * (1.0 - 1e-9):
            best, least = moved, cost
    return best


# --- Whether geometry alone is the better model outside what was seen

_OUTER = 0.2  # share of the postures, as much as is held out of a usual recording
_MIN_JUDGED = 12  # samples; fewer say nothing
_MAX = 1500  # samples, for time
_DRAWN_IN = 25.0  # of the median square, so that no wrong reading decides


def geometry_is_better(
    full: Model,
    alone: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    fit: Fit,
    distances: Sequence[AnyDistance] = (),
) -> bool:
    """Whether, of two models fitted to the inner postures, geometry alone misses the outer ones by less.

    full, alone: fitted to all samples. fit: of the full one. False where no curves are, or readings do not say.
    """
    curved = curved_joints(full.effects, full.chain.names)
    if not curved.any():
        return False
    rows = spread_rows(len(samples), _MAX)
    few = samples.select(rows)
    q = few.q[:, curved]
    away = np.abs(q - 0.5 * (q.max(axis=0) + q.min(axis=0))) / np.maximum(np.ptp(q, axis=0), 1e-12)
    outer = away.max(axis=1)
    outside = outer > np.quantile(outer, 1.0 - _OUTER)
    weight = row_weights(fit.weights[rows], fit.noise, few)
    (geometry, _, left), (curves, variance, _) = (
        _left_out(model, few, parameters, weight, distances, outside) for model in (alone, full)
    )
    sure = variance < UNSURE * left
    if sure.sum() < _MIN_JUDGED:
        return False
    limit = _DRAWN_IN * float(np.median(curves[sure]))
    return bool(np.minimum(geometry[sure], limit).mean() < np.minimum(curves[sure], limit).mean())


def _left_out(
    model: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    weight: Array,
    distances: Sequence[AnyDistance],
    out: np.ndarray,
) -> tuple[Array, Array, float]:
    """Squared residuals of the positions of some samples (N,) once these are left out of the fit, the variances that
    the values' uncertainty then gives their predictions, and the mean square of all residuals as they were.
    """
    drivers, P, N = model.drivers(samples), len(parameters), len(samples)
    values = np.concatenate([np.zeros(P), *(e.values for e in model.effects)])
    prior = np.concatenate([[p.prior_std for p in parameters], *(prior_stds(e, drivers) for e in model.effects)])
    at = linearise(model, parameters, values, samples, drivers=drivers)
    J, residual = at.J * np.sqrt(weight), at.residual * np.sqrt(weight)
    A = J @ J.T + np.diag(prior**-2.0)
    if distances:
        rows = distance_rows(model, parameters, values, distances)
        A += (rows.J / rows.std**2) @ rows.J.T
    which = np.concatenate([np.tile(out, 3), np.tile(out[samples.is_pose], 3)])
    B = A - J[:, which] @ J[:, which].T
    scale = 1.0 / np.sqrt(np.maximum(np.diag(B), 1e-300))
    C = np.linalg.pinv(B * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
    step = -C @ (J[:, which] @ residual[which])
    at_out = np.flatnonzero(np.tile(out, 3))
    missed = (residual[at_out] - step @ J[:, at_out]).reshape(3, -1)
    variance = np.einsum("kr,kr->r", J[:, at_out], C @ J[:, at_out]).reshape(3, -1)
    usual = float(np.mean(np.sum(residual[: 3 * N].reshape(3, -1) ** 2, axis=0)))
    return np.sum(missed**2, axis=0), variance.sum(axis=0), usual


_OFTEN, _PLACED = 12, 3  # readings of a frame: enough to judge it by, and the fewest that place it
_MAX_KEPT = 200  # postures that a calibration remembers


def finalise(
    samples: Samples,
    chain: Mechanism,
    choice: ParameterChoice,
    cell: Cell,
    inertias: Inertias | None = None,
    scored: Fit | None = None,
    wrong: np.ndarray | None = None,
    regimes: Model | None = None,
    geometry: Fit | None = None,
    whole: Fit | None = None,
) -> Calibration:
    """The calibration fitted to every accepted sample, written with the least change to the nominal arm.

    scored: the fit whose effects it has, and which it begins from. wrong: True for samples to be left out, (N,), and no
    others are; by default the fit decides. regimes: a model to begin from where base or tool moved. geometry: the fit
    of geometry alone, from whose start all fits here begin; None: from the nominal arm's. whole: the fit to just these
    samples from scored, where there is one already.
    """
    decided = wrong is not None
    watched = float(samples.stamps.min()), float(samples.stamps.max())
    if wrong is not None and wrong.any():
        _require_each_frame(samples, ~wrong)
        samples = samples.select(~wrong)
    nominal = fit_cell(chain, samples, cell, inertias, regimes)
    begun = nominal.model if geometry is None else geometry.start
    if geometry is None or any(is_move(effect) for effect in begun.effects):
        fit = identify_moved(begun, samples, choice.parameters, cell.distances, reject=not decided)
    else:
        fit = identify(begun, samples, choice.parameters, cell.distances, begin=geometry.values, reject=not decided)
    last, fits = fit, [nominal, fit]
    geometric = least_change(fit.model, chain)
    if scored is None or not scored.model.effects:
        tidy = geometric
    else:
        start = begun.with_effects(sharpened(scored.model, samples).effects)
        fitted = partial(identify, samples=samples, parameters=choice.parameters, distances=cell.distances)
        if whole is not None and whole.start.chain is start.chain:
            fit = whole  # of these samples, from there
        else:
            fit = fitted(start, tolerance=FITTED, begin=scored.values, reject=not decided)
        # places moved by what was passed through the joints: effects settle where they are now
        tidy = least_change(fit.model, chain)
        settled = fitted(tidy, tolerance=10.0 * FITTED, reject=not decided)
        tidy, last = least_change(settled.model, chain), settled
        fits.append(settled)  # which goes on from where the fit before it ended
    made = _calibration((nominal.model, tidy, geometric), samples, choice.parameters, last, cell.distances)
    return replace(
        made,
        parameters=parameter_table(fit),
        kind=str(samples.kind[0]),
        postures=samples.q[spread_rows(len(samples), _MAX_KEPT)],
        noise=fit.noise,
        watched=watched,
        scatter=typical_scatter(samples),
        converged=all(each.converged for each in fits),
        clock=samples.clock,
        typical=typical_sizes(tidy, samples),
        marks=marks_of(samples),
    )


def as_used(full: Fit, alone: Fit, samples: Samples, at: Samples, distances: Sequence[AnyDistance]) -> Model:
    """The full one of two models fitted to samples, as a calibration made of these would use it at others.

    alone: geometry alone, which speaks outside of what was seen where it knows more there.
    """
    curved = curved_joints(full.model.effects, full.model.chain.names)
    low, high = samples.q.min(axis=0), samples.q.max(axis=0)
    if not ((at.q < low) | (at.q > high))[:, curved].any() and not signals_of(full.model.effects):
        return full.model
    made = _calibration((alone.model, full.model, alone.model), samples, full.parameters, full, distances)
    beyond = made.fallback(full.model, alone.model)
    return replace(full.model, fallback=None if beyond is None else replace(beyond, model=alone.model))


def _calibration(
    models: tuple[Model, Model, Model],
    samples: Samples,
    parameters: Sequence[ModelParameter],
    fit: Fit,
    distances: Sequence[AnyDistance],
) -> Calibration:
    """A calibration by these models (nominal, full, geometry alone), and how far the samples carry it. fit: the full
    one's.
    """
    _, full, alone = models
    left = errors(alone, samples).position_norm  # not finite where readings show no positions
    return Calibration(
        *models,
        np.stack([samples.q.min(axis=0), samples.q.max(axis=0)]),
        noise=fit.noise,
        uncertainty=uncertainty(full, samples, parameters, fit, distances),
        left_alone=float(np.sqrt(np.mean(left**2))) if np.isfinite(left).all() else 0.0,
        geometry_outside=geometry_is_better(full, alone, samples, parameters, fit, distances),
        ranges=driver_ranges(full, samples),
    )


def _require_each_frame(samples: Samples, kept: np.ndarray) -> None:
    """Raises BadRecording where hardly a reading of an instrument that read often agrees with the arm."""
    for f, name in enumerate(samples.frames):
        rows = samples.frame == f
        left, of = int(np.sum(rows & kept)), int(rows.sum())
        if of >= _OFTEN and left < _PLACED:
            raise BadRecording(
                f"frame '{name}'",
                f"{of - left} of its {of} readings agree with no place of the instrument and no target on the arm that "
                "the others show",
                "see whether its axes are left-handed, its units and its quaternions, and what it looks at; or leave "
                "its topic out with --ignore",
            )


# --- Rejected samples that no other sample speaks against: a learned curve is known there from rejected ones alone

_LOST = 0.5  # of a function's squares, less of which is left to samples that count: the others then decide it
_NEIGHBOURS = 3  # rejected stations at one place are no chance (as in runs); one alone may be a wrong reading
_SAID = 0.2  # the same, of all samples, from which a place is said: where they were half of those that are fitted
_THERE = 0.1  # of a function's largest square, from which a station says something of it


@dataclass(frozen=True)
class ReadmittedPlace:
    """Where stations were taken in again. joint: whose curve they show. low, high: of its position [rad or m] at these.
    stations: how many, of so many between.
    """

    joint: str
    low: float
    high: float
    stations: int
    of: int


@dataclass(frozen=True)
class Readmitted:
    """Stations that were taken in again. stations: how many. unscored: how many of them the score rejects still, since
    the fit that is scored has no others there. places: what they show.
    """

    stations: int = 0
    unscored: int = 0
    places: tuple[ReadmittedPlace, ...] = ()


def uncontradicted(model: Model, samples: Samples, rejected: np.ndarray) -> np.ndarray:
    """True for rejected samples that stand where curves of the model are known from rejected ones, (N,)."""
    out = np.zeros(len(samples), bool)
    for _, _, there in _alone(model, samples, rejected, 1.0 - _LOST):
        if len(np.unique(samples.station[there])) >= _NEIGHBOURS:
            out |= there
    return out


def right_after_all(
    scored: Fit,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    distances: Sequence[AnyDistance],
    wrong: np.ndarray,
) -> tuple[np.ndarray, Fit | None]:
    """True for samples that the scored fit had no others beside of, and that a fit to all of them explains, (N,).

    What was held out from it may be all that there is of a place. wrong: True for what it rejects, (N,). Also that fit,
    where it is to just those samples that are right after all and those that are not wrong.
    """
    alone = uncontradicted(scored.model, samples, wrong)
    if not alone.any():
        return alone, None
    start = scored.start.with_effects(sharpened(scored.model, samples).effects)
    some = samples.select(~wrong | alone)
    fit = identify(start, some, parameters, distances, tolerance=FITTED, begin=scored.values, reject=False)
    right = np.asarray(alone & ~outlying(fit.model, scored.noise, samples))
    return right, fit if np.array_equal(right, alone) else None


def readmitted(model: Model, samples: Samples, again: np.ndarray, wrong: np.ndarray) -> Readmitted:
    """What was taken in again (True, (N,)), and where they say much of the model's curves. wrong: True for what the
    score rejects, (N,).
    """
    places = []
    for joint, x, there in _alone(model, samples, again, _SAID):
        low, high = float(x[there].min()), float(x[there].max())
        count = len(np.unique(samples.station[there]))
        places.append(
            ReadmittedPlace(joint, low, high, count, len(np.unique(samples.station[(x >= low) & (x <= high)])))
        )
    return Readmitted(
        len(np.unique(samples.station[again])), len(np.unique(samples.station[again & wrong])), tuple(places)
    )


def _alone(
    model: Model, samples: Samples, some: np.ndarray, share: float
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Stretches of curves of which some samples (True, (N,)) say this share of all, or more: the joint, its positions,
    and True for these samples there, (N,) each.
    """
    curves = [effect for effect in model.effects if effect.shape.kind == "spline" and claimed(effect)]
    if not some.any() or not curves:
        return
    drivers = model.drivers(samples)
    for effect in curves:
        x = drivers.values(effect.driver, effect.lag)
        square = effect.shape.basis(x) ** 2
        whole = square.sum(axis=1)
        lost = square[:, ~some].sum(axis=1) < (1.0 - share) * whole
        for first, last in consecutive(lost & (whole > 0.0)):
            part = square[first:last]
            there = some & (part > _THERE * part.max()).any(axis=0)
            if there.any():
                yield effect.place, x, there
