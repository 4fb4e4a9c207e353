"""What fixed points and the arm's drawing say of the scale, where known distances are left aside.

Where a ball rests in sockets the readings are joint positions alone. What a fit leaves of them is measured in the
lengths that it fits: an arm that is a tenth shorter leaves a tenth less, and least squares draw all lengths together
wherever nothing but the drawing holds them. That is no evidence. What is random are the joints, and in their density
the determinant of the map from joints to what is left undoes it: only what is left *in units of the joints' levers*
counts, which scale does not change. So the scale is told by how far an arm is expected to be from its drawing. It is
found from fits that hold it: with all known distances a little longer, and a little shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.distances import AnyDistance
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
    about, middle = 1.0, fit
    for _ in range(_ROUNDS):
        try:
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
    return ScaleEstimate(about - 1.0, about * std)


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
