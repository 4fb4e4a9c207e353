"""What fixed points and the arm's drawing say of the scale, where known distances are left aside.

Where a ball rests in sockets the readings are joint positions alone. What a fit leaves of them is measured in the
lengths that it fits: an arm that is a tenth shorter leaves a tenth less, and least squares draw all lengths together
wherever nothing but the drawing holds them. That is no evidence. What is random are the joints, and in their density
the determinant of the map from joints to what is left undoes it: only what is left *in units of the joints' levers*
counts, which scale does not change. So the scale is told by how far an arm is expected to be from its drawing. How far
this one is, its lengths tell together: an arm whose lengths are within half a millimetre of the drawing is not 2 % too
long in all of them. The scale is found from fits that hold it: with all known distances a little longer, and a little
shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from modcal_core.calibration.distances import CONTRADICTED, AnyDistance
from modcal_core.calibration.identify import Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.score import errors
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import is_serial_arm, tool_frames

_STEP = 0.02  # of all distances; of the order in which an arm's drawing tells its scale
_FARTHEST = 0.1  # of all distances, in one round: beyond, a parabola through the three is no guide
_ROUNDS = 5  # iterations; where the distances are right the first one is the last
_SETTLED = 0.5  # standard deviations of the scale
_LEAST_SHOWN = 4.0  # lengths of the arm that the readings tell, from which it is judged how far they are off
_LEAST_OFF = 2e-4  # m; what drawings allow of lengths as an arm's links have (ISO 2768, medium: 0.2 to 0.5 mm)


@dataclass(frozen=True)
class ScaleEstimate:
    """By which share of itself every known distance would be longer for all the readings say, and its deviation."""

    longer: float
    std: float


def scale_without_distances(fit: Fit, samples: Samples, distances: Sequence[AnyDistance]) -> ScaleEstimate | None:
    """What the readings and the arm's drawing say of the scale; None where not all readings are of fixed points.

    fit: of these samples with the known distances. Another kind of reading tells the scale by itself.
    """
    fixed = all(samples.is_same_point(f) for f in range(len(samples.frames)))
    if not fixed or not distances or not is_serial_arm(fit.model.chain):
        return None
    about, middle, shown = 1.0, fit, 0.0
    for _ in range(_ROUNDS):
        try:
            fit, shown = _as_far_off(fit, middle)
            middle = _held(fit, samples, distances, about)
            shorter, longer = (_held(fit, samples, distances, about * (1.0 + step)) for step in (-_STEP, _STEP))
        except NotEnoughData:
            return None
        low, cost, high = (_cost(each, fit.weights, samples) for each in (shorter, middle, longer))
        bent = high + low - 2.0 * cost
        if bent <= 0.0:
            return None
        step, std = 0.5 * _STEP * (low - high) / bent, _STEP * float(np.sqrt(2.0 / bent))
        about *= 1.0 + float(np.clip(step, -_FARTHEST, _FARTHEST))
        if abs(step) < _SETTLED * std:
            break
        middle = _held(fit, samples, distances, about)
    return ScaleEstimate(about - 1.0, about * std * (_tail(shown) if shown else 1.0))


def _as_far_off(fit: Fit, at: Fit) -> tuple[Fit, float]:
    """The fit with the arm's lengths expected as far from the drawing as those of another fit are, and how many lengths
    the readings tell of that one; as it is, and 0, where they tell few.

    The expected deviation is that under which the readings are likeliest (MacKay 1992): the squares of the values over
    how many of them are told by the readings, and not by what was expected.
    """
    own = np.array([p.of_arm and not p.turns and np.isfinite(p.prior_std) for p in at.parameters])
    expected = np.array([p.prior_std for p in at.parameters])[own]
    shown = float(np.sum(1.0 - np.minimum(at.std[own] / expected, 1.0) ** 2))
    if shown < _LEAST_SHOWN:
        return fit, 0.0
    off = np.maximum(expected * np.sqrt(np.sum((at.values[own] / expected) ** 2) / shown), _LEAST_OFF)
    each = iter(off.tolist())
    parameters = tuple(
        replace(p, prior_std=next(each)) if mine else p for p, mine in zip(fit.parameters, own.tolist(), strict=True)
    )
    return replace(fit, parameters=parameters), shown


def _tail(shown: float) -> float:
    """By which a deviation that so many values tell is widened, so that a contradiction is as rare as a normal one's."""
    beyond = float(scipy.special.ndtr(-CONTRADICTED))
    return -float(scipy.special.stdtrit(shown, beyond)) / CONTRADICTED


def _held(fit: Fit, samples: Samples, distances: Sequence[AnyDistance], factor: float) -> Fit:
    """The fit with all known distances times a factor, effects as they are."""
    start = fit.start.with_effects(fit.model.effects)
    known = [replace(d, distance=factor * d.distance) for d in distances]
    return identify(start, samples, fit.parameters, known, keep_effects=True, begin=fit.values)


def _cost(fit: Fit, weights: Array, samples: Samples) -> float:
    """What speaks against a fit: what it leaves in units of the joints' levers, and how far it is from the drawing."""
    square = weights @ errors(fit.model, samples).position_norm ** 2
    prior = np.array([p.prior_std for p in fit.parameters])
    left = 3.0 * float(weights.sum()) * np.log(square / _lever(fit.model, samples.q) ** 2)
    return float(left + np.sum((fit.values / prior) ** 2))


def _lever(model: Model, q: Array) -> float:
    """RMS motion of the tool per unit of a joint that turns, over postures q (N, n) [m]."""
    f = tool_frames(model.serial, model.T_tip_tool, q)
    levers = [so3.cross(f.axes[j, 2], f.p[-1] - f.p[j]) for j in np.flatnonzero(model.serial.revolute)]
    return float(np.sqrt(np.mean(np.square(levers))))
