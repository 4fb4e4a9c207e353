"""Priors of a fit as wide as links are off, by the readings' own evidence, where readings leave directions open.

Positions in the frame of a tracker, lengths and known distances show the scale, and need no more than the wide priors
of :mod:`~modcal_core.calibration.parameters`. Contacts, gauges, bearings and sockets leave directions to what arms are
like: errors of joints let an arm shrink that only touches planes, as far as its prior lets it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    Fit,
    Model,
    ModelParameter,
    enough_for_effects,
    fit_geometry,
    identify,
    linearise,
    model_at,
)
from modcal_core.claim.evidence import draw, widths_of_links
from modcal_core.claim.neighbourhood import ANGLE_RAD, LENGTH_M, arms_near, shows_base
from modcal_core.measurements import RANGE, RAY, Samples
from modcal_core.measurements.kinds import dimensions
from modcal_core.robots import Mechanism

USUAL_WIDTH = 1.0  # what fits begin with, and the narrowest
_STEPS, _DRAWS = 3, 480
_FREEDOM = 4.0  # of the law of readings some of which are wrong
_ENOUGH = 1.25  # equations for each parameter; of fewer, less than a fifth is left to tell a fit from noise
_WIDER = 1.2  # from which arms are fitted again with priors as wide


def held(parameters: Sequence[ModelParameter], widths: Mapping[int, float] | None = None) -> tuple[ModelParameter, ...]:
    """The parameters with those of the arm held to errors of these widths by place, in usual errors of links.

    widths: None, or of a place that is not there: the usual one. What counts as observed stays as it was.
    """

    def size(p: ModelParameter) -> float:
        usual = LENGTH_M if p.unit == "m" else ANGLE_RAD
        return min(max((widths or {}).get(p.place, USUAL_WIDTH), USUAL_WIDTH) * usual, p.expected)

    return tuple(replace(p, prior_std=size(p), seen_std=p.expected) if p.of_arm else p for p in parameters)


def fit_held(start: Model, samples: Samples, parameters: Sequence[ModelParameter], cell: Cell) -> Fit:
    """The fit of the whole geometry, as of :func:`fit_geometry`, of an arm that is as far off as the readings tell.

    start: the nominal arm, with base and tool where it has them.
    """
    if _shows_scale(samples, cell) and enough_for_effects(samples, len(parameters), len(cell.distances), _ENOUGH):
        return fit_geometry(start, samples, parameters, cell)
    fit = fit_geometry(start, samples, held(parameters), cell)
    widths = widths_of_links(arms_near(fit.model, start.chain, samples, cell, functions=False))
    if max(widths.values(), default=0.0) > _WIDER:
        fit = fit_geometry(start, samples, held(parameters, widths), cell)
    if fit.weights.all() or fit.start.effects:
        return fit
    # a link far off makes all readings in one socket look wrong, from where the nominal arm has them
    near = identify(fit.start, samples, fit.parameters, cell.distances, reject=False)
    other = identify(fit.start, samples, fit.parameters, cell.distances, begin=near.values)
    return min(fit, other, key=lambda each: _unlikely(each, samples))


def _unlikely(fit: Fit, samples: Samples) -> float:
    """How unlikely the samples are by this fit, in nats, by Student's law: some of them may be wrong."""
    left = linearise(fit.model, (), np.zeros(0), samples, jacobian=False).residual[: 3 * len(samples)]
    noise, many = fit.noise.of(samples), dimensions(samples)
    square = (left.reshape(3, -1) ** 2).sum(axis=0) / noise**2
    return float(np.sum(many * np.log(noise) + 0.5 * (_FREEDOM + many) * np.log1p(square / _FREEDOM)))


def settled(calibration: Calibration, samples: Samples, cell: Cell) -> Calibration:
    """The calibration in the middle of what its readings and the usual size of errors leave possible.

    A fit has the fewest values that say the same to the instrument, each held by itself. Where readings do not show the
    scale that is a narrower law than that of all errors of an arm, and another middle.
    """
    if _shows_scale(samples, cell):
        return calibration
    nominal, geometric = calibration.nominal.chain, calibration.geometric
    moved, values = _settled(calibration.calibrated, nominal, samples, cell)
    alone = moved if geometric is calibration.calibrated else _settled(geometric, nominal, samples, cell)[0]
    own = {name: value for name, value, *_ in calibration.parameters}
    table = tuple((name, value + own.get(name, 0.0) * (not arm), std, unit) for name, value, std, unit, arm in values)
    return replace(calibration, calibrated=moved, geometric=alone, parameters=table)


def _settled(
    model: Model, nominal: Mechanism, samples: Samples, cell: Cell
) -> tuple[Model, tuple[tuple[str, float, float, str, bool], ...]]:
    """The model, and of every value of its geometry name, size, deviation, unit and whether it is of the arm: those of
    the arm from the nominal one, others from where they were.
    """
    std, moved = np.concatenate([np.zeros(0), *(effect.std for effect in model.effects)]), 0.0
    for _ in range(_STEPS):
        about = arms_near(model, nominal, samples, cell, functions=False)
        drawn = draw(about, _DRAWS, np.random.default_rng(0)).values
        step = drawn.mean(axis=0)
        moved = moved + step
        model = model_at(about.model, about.parameters, about.values + step, std)
    value, spread = np.where(about.place >= 0, about.shipped + step, moved), drawn.std(axis=0)
    each = zip(about.parameters, value.tolist(), spread.tolist(), strict=False)
    return model, tuple((p.name, x, s, p.unit, p.of_arm) for p, x, s in each)


def _shows_scale(samples: Samples, cell: Cell) -> bool:
    placed = any(shows_base(samples, frame) for frame in range(len(samples.frames)))
    return bool(placed or cell.distances or {RANGE, RAY} & set(samples.kinds))
