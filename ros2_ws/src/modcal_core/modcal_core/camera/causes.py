"""Effects beyond geometry that corners show: gears, ratios, springs, backlash, looked for as with any other instrument.

The scan says which candidate explains most of what the fit leaves over, and how likely noise explains as much. It stays
where everything fitted again with it makes the images likelier by more than its price, and where a fit of most images
with it predicts the others better than one without.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.evidence import CameraScanner, WithModel
from modcal_core.camera.fit import CameraFit, fit_camera, missed_pixels
from modcal_core.camera.mounting import MIN_VIEWS
from modcal_core.diagnosis.choice import EffectChoice, choose
from modcal_core.diagnosis.search import SIGNIFICANT
from modcal_core.effects.effect import Effect
from modcal_core.effects.registry import candidates
from modcal_core.geometry.so3 import Array

_MAX = 6  # effects, for time
_REFUSED = 2  # choices that did not hold, before the search ends
_GAIN = 6.0  # of −2 log likelihood, the price of the amplitudes taken off: odds of 20 : 1
_PARTS = 4  # each of which is predicted from the others
_NOT_HERE = ("tracker", "base", "tool")  # lens and sheet have parameters; moves are looked for on their own


@dataclass(frozen=True)
class CameraCause:
    """An effect that was found. p_value: that noise would look as good. same_as: what explains it as well. before,
    after: what images have of their own, RMS a joint [rad, m], without it and with it. gain: of −2 log likelihood.
    """

    effect: Effect
    p_value: float
    same_as: tuple[str, ...]
    before: float
    after: float
    gain: float


def find_causes(
    fit: CameraFit, rng: np.random.Generator, arm: float | None = None, progress: Callable[[str], None] = lambda _: None
) -> tuple[CameraFit, tuple[CameraCause, ...], EffectChoice | None]:
    """(the fit with the effects that the images show, these, what is significant but could not be turned into one).

    arm: as in the fit.
    """
    drivers = fit.poses.drivers(fit.state.offset_s)
    looked_for = [e for e in candidates(drivers) if e.place not in _NOT_HERE and "time" not in e.driver]
    causes: list[CameraCause] = []
    refused: set[tuple[str, str, str, str]] = set()
    left: EffectChoice | None = None
    if not looked_for:
        return fit, (), None
    scanner = CameraScanner(looked_for, drivers)
    while len(causes) < _MAX and len(refused) < _REFUSED:
        asked = WithModel(fit, fit.poses.model.with_effects(_valued(fit)))
        if not scanner.enough(asked):  # type: ignore[arg-type]
            break
        evidence = scanner.evidence(asked, rng)  # type: ignore[arg-type]
        if evidence.p_value > SIGNIFICANT:
            break
        choice = choose(evidence, scanner, asked, refused)  # type: ignore[arg-type]
        if choice is None:
            break
        progress(choice.effect.label)
        started = choice.effect.started(scanner.amplitudes(asked, choice.effect))  # type: ignore[arg-type]
        better = _with(fit, started, arm)
        gain = fit.misfit - better.misfit
        if better.converged and gain > _GAIN and predicted(better, arm) < predicted(fit, arm):
            causes.append(
                CameraCause(started, choice.p_value, choice.same_as, fit.sizes.joint, better.sizes.joint, gain)
            )
            fit, left = better, None
        else:
            refused.add(choice.effect.key)
            left = left or choice
    return fit, _final(fit, causes), left


def _valued(fit: CameraFit) -> tuple[Effect, ...]:
    """The effects of a fit with their fitted values and standard deviations."""
    out, first = [], len(fit.poses.parameters)
    std = np.sqrt(np.diag(fit.covariance))
    for effect in fit.poses.model.effects:
        last = first + len(effect.values)
        out.append(effect.with_values(fit.state.values[first:last], std[first:last]))
        first = last
    return tuple(out)


def _final(fit: CameraFit, causes: list[CameraCause]) -> tuple[CameraCause, ...]:
    return tuple(
        CameraCause(effect, c.p_value, c.same_as, c.before, c.after, c.gain)
        for effect, c in zip(_valued(fit), causes, strict=True)
    )


def _with(fit: CameraFit, effect: Effect, arm: float | None) -> CameraFit:
    """Everything fitted again, with one more effect."""
    poses = fit.poses.with_effects((*_valued(fit), effect))
    state = fit.state
    values = np.insert(state.values, fit.poses.of_model, effect.values)
    begin = state.with_values(values)
    return fit_camera(fit.table, poses, state.lens, fit.prior, fit.sizes, arm, begin=begin)


def predicted(fit: CameraFit, arm: float | None = None) -> float:
    """Mean square of the residuals [px²] of every fourth image, and so on, predicted from fits of the others.

    Each image counts by no more than a few times the median, so that none rules alone. NaN for too few images.
    """
    N = fit.table.views
    if N - -(-N // _PARTS) < MIN_VIEWS:
        return float("nan")
    square = np.empty(N)
    for part in range(_PARTS):
        held = np.arange(N) % _PARTS == part
        there = fit_camera(
            fit.table.select(~held),
            fit.poses.select(~held),
            fit.state.lens,
            fit.prior,
            fit.sizes,
            arm,
            fixed_sizes=True,
            begin=fit.state,
        )
        square[held] = _of_images(there, fit, held)
    return float(np.minimum(square, 25.0 * np.median(square)).mean())


def _of_images(there: CameraFit, fit: CameraFit, held: np.ndarray) -> Array:
    table, poses = fit.table.select(held), fit.poses.select(held)
    gap = missed_pixels(table, poses, there.state)
    total = np.bincount(table.view, table.weight * (gap**2).sum(1), table.views)
    return np.asarray(total / np.maximum(np.bincount(table.view, table.weight, table.views), 1.0))
