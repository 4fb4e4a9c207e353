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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

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
_TRIED = np.geomspace(0.8, 1.25, 12).tolist()  # factors that are begun from, twice as far apart as steps are
_ROUNDS = 8  # iterations; where the distances are right the first ones are the last
_SETTLED = 0.1  # standard deviations of the scale, and as a share of that deviation
_GOOD = 1e-3  # m; of the order in which arms are off as they leave their maker
_ALONG = 0.5  # cosine with the first joint's axis, from which a length is rather the base's place along it
_ANYWHERE = 1.0  # m; farther than any fit has a base
_MIN_SHOWN = 4.0  # lengths of the arm that the readings tell, from which it is judged how far they are off
_MIN_OFF = 2e-4  # m; what drawings allow of lengths as an arm's links have (ISO 2768, medium: 0.2 to 0.5 mm)


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
    cost_of = partial(_cost_of, samples=samples, distances=distances)
    shown = _shown(fit)
    told = shown >= _MIN_SHOWN
    try:
        # from a good arm on: with lengths that are expected far off, wrong distances could be those of a bad one
        fit = _expecting(fit, _GOOD) if told else fit
        about = min(_TRIED, key=partial(cost_of, fit)) if told else 1.0
        for _ in range(_ROUNDS):
            found = _settled(partial(cost_of, fit), about)
            if found is None or not told:
                break
            middle = _held(fit, samples, distances, found[0])
            shown, before = _shown(middle), about
            fit, about = _expecting(fit, _off(middle, shown)), found[0]
            if abs(about - before) < _SETTLED * found[1]:
                break
    except NotEnoughData:
        return None
    if found is None:
        return None
    return ScaleEstimate(found[0] - 1.0, found[0] * found[1] * (_tail(shown) if told else 1.0))


def _settled(cost: Callable[[float], float], about: float) -> tuple[float, float] | None:
    """The factor that costs least, near another, and its deviation as a share of it; None where there is none."""
    for _ in range(_ROUNDS):
        low, here, high = (cost(about * (1.0 + step)) for step in (-_STEP, 0.0, _STEP))
        bent = high + low - 2.0 * here
        if bent <= 0.0:
            return None
        step, std = 0.5 * _STEP * (low - high) / bent, _STEP * float(np.sqrt(2.0 / bent))
        about *= 1.0 + float(np.clip(step, -_FARTHEST, _FARTHEST))
        if abs(step) < _SETTLED * std:
            break
    return about, std


def _cost_of(fit: Fit, factor: float, samples: Samples, distances: Sequence[AnyDistance]) -> float:
    """What speaks against a fit with all known distances times a factor."""
    return _cost(_held(fit, samples, distances, factor), fit.weights, samples)


def _lengths(fit: Fit) -> np.ndarray:
    """Which parameters are lengths of the arm, and not the base's place along the first joint's axis, (P,)."""
    chain = fit.model.serial
    axis = chain.joint_basis[1].T @ chain.origins[1, :3, :3].T @ chain.axes[0] if chain.n > 1 else np.zeros(3)
    of_base = [p.place == 1 and not p.turns and abs(float(axis[p.direction])) > _ALONG for p in fit.parameters]
    own = [p.of_arm and not p.turns and bool(np.isfinite(p.prior_std)) for p in fit.parameters]
    return np.array(own) & ~np.array(of_base)


def _shown(fit: Fit) -> float:
    """How many of the arm's lengths the readings tell, and not what was expected of them."""
    own = _lengths(fit)
    expected = np.array([p.prior_std for p in fit.parameters])[own]
    return float(np.sum(1.0 - np.minimum(fit.std[own] / expected, 1.0) ** 2))


def _off(fit: Fit, shown: float) -> float:
    """How far [m] the arm's lengths are from the drawing: the deviation under which the readings are likeliest.

    The squares of the values over how many of them the readings tell (MacKay 1992).
    """
    return max(float(np.sqrt(np.sum(fit.values[_lengths(fit)] ** 2) / max(shown, 1.0))), _MIN_OFF)


def _expecting(fit: Fit, off: float) -> Fit:
    """The fit with the arm's lengths expected to be so far from the drawing [m], and where its base is not at all."""
    own = _lengths(fit).tolist()
    parameters = [
        replace(p, prior_std=off if mine else _ANYWHERE) if p.of_arm and not p.turns else p
        for p, mine in zip(fit.parameters, own, strict=True)
    ]
    return replace(fit, parameters=tuple(parameters))


def _tail(shown: float) -> float:
    """By which a deviation that so many values tell is widened: a contradiction is then as rare as a normal one's."""
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
