"""Identification: the parameters that make the model meet the samples, with their uncertainty.

Damped Gauss–Newton steps on the minimal parameters (:mod:`modcal_core.geometry.descent`). The columns are scaled to
unit length, so the normal equations solved by Cholesky lose nothing that matters; a prior on the arm's own directions,
as wide as robots are wrong, holds what the data does not show. Weights and the size of the noise are found again at
every step (see :mod:`modcal_core.calibration.noise`). Many samples are begun with a few of them, so that all are gone
through but two or three times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy

from modcal_core.calibration.data_split import distinct
from modcal_core.calibration.distances import AnyDistance, distance_cost, distance_rows
from modcal_core.calibration.equations import System
from modcal_core.calibration.linearisation import Linearised, model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import (
    REJECT_Z,
    Groups,
    NoiseModel,
    has_shared_noise,
    row_weights,
    shared_noise,
    weigh,
)
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects import Drivers, Effect, is_move, prior_stds
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, Descent, descend
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import dimensions

# --- The curvature of a fit's cost, factored: steps and the covariance come from one factor

_RIDGES = (0.0, 1e-12, 1e-10, 1e-8)  # of the scaled curvature, where it is singular to rounding


def inverse_of_triangle(lower: Array) -> Array:
    """The inverse of a lower triangle (P, P), zeros above its diagonal. What lower has there is not read."""
    return np.tril(scipy.linalg.lapack.dtrtri(lower, lower=1)[0])


@dataclass(frozen=True)
class Curvature:
    """JᵀWJ with the prior, (P, P), at unit diagonal: ``diag(scale) H diag(scale) = L Lᵀ``, damped as a step asks.

    lower: L, (P, P); None where it is singular to rounding, and steps are the least that serve. scaled: what it is of.
    """

    scale: Array
    scaled: Array
    lower: Array | None

    @classmethod
    def of(cls, H: Array, damping: float = 0.0) -> Curvature:
        """Factor of H (P, P), with damping added to its scaled diagonal."""
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        scaled = H * scale
        scaled *= scale[:, None]
        for ridge in _RIDGES:
            damped = scaled.T.copy(order="F")
            damped.flat[:: len(H) + 1] += damping + ridge
            lower, singular = scipy.linalg.lapack.dpotrf(damped, lower=1, clean=0, overwrite_a=1)
            if not singular:
                return cls(scale, scaled, lower)
        return cls(scale, scaled, None)

    def solve(self, g: Array) -> Array:
        """``H⁻¹ g``, damped, of g (P,)."""
        right = self.scale * g
        if self.lower is None:
            return np.asarray(self.scale * np.linalg.lstsq(self.scaled, right, rcond=1e-12)[0], dtype=float)
        return np.asarray(self.scale * scipy.linalg.lapack.dpotrs(self.lower, right, lower=1)[0])

    def inverse(self) -> Array:
        """``H⁻¹``, (P, P)."""
        if self.lower is None:
            inverse = np.linalg.lstsq(self.scaled, np.eye(len(self.scaled)), rcond=1e-12)[0]
            return np.asarray(inverse * np.outer(self.scale, self.scale), dtype=float)
        half = inverse_of_triangle(self.lower) * self.scale
        return half.T @ half

    def variances(self) -> Array:
        """The diagonal of ``H⁻¹``, (P,)."""
        if self.lower is None:
            return np.diag(self.inverse())
        half = inverse_of_triangle(self.lower)
        return np.asarray(np.einsum("ij,ij->j", half, half) * self.scale**2)


MAX_ITERATIONS = 300  # a fit that needs more says that it did not converge
CONVERGED = 1e-5  # standard deviations that a fit is away from its end, far below anything a report shows
FITTED = 1e-2  # the same for models with effects, some of which have many values
_SHRINKING = 0.3  # of the last step, at least, that is expected of the next: robust weights settle no faster
# A sample at the limit of rejection may go in and out for ever, each time by what the others then say of it: what is
# rejected for the third time stays so
_THIRD = 3
_ROUGHLY = 1.0  # standard deviations to which a beginning is fitted
# A large fit begins with a few of its samples, so many at most, one in so many, and so many for each parameter at least
_FEW, _MANY, _EACH = 500, 8, 4
_EQUATIONS_WITH_EFFECTS = 1.5  # a third of them is left, which effects may take up
EQUATIONS_PER_PARAMETER = 1.0  # fewer leave the rest to what arms are like


@dataclass(frozen=True)
class Fit:
    """A fitted model and what is known of it.

    model: with the parameters put in. start: the model the parameters are relative to. parameters, values (P,),
    covariance (P, P): of the geometry [m, rad]; the model's effects carry their own. noise: what the model does not
    explain, per axis. weights: (N,) in [0, 1], of the samples it was fitted to; 0 is rejected. information: JᵀWJ of the
    data alone, (P, P). iterations: steps taken. converged: whether they ended because the next would have been too
    short to matter, not because there were too many. frozen: whether the effects are those of another
    recording, and only the parameters were fitted to this one.
    """

    model: Model
    start: Model
    parameters: tuple[ModelParameter, ...]
    values: Array
    covariance: Array
    noise: NoiseModel
    weights: Array
    information: Array
    iterations: int
    converged: bool = True
    frozen: bool = False

    @property
    def std(self) -> Array:
        """Standard deviations of the values, (P,)."""
        return np.sqrt(np.diag(self.covariance))

    def value(self, name: str) -> float:
        """The value of the named parameter [m or rad]."""
        return float(self.values[self._index(name)])

    def deviation(self, name: str) -> float:
        """The standard deviation of the named parameter [m or rad]."""
        return float(self.std[self._index(name)])

    def _index(self, name: str) -> int:
        for i, parameter in enumerate(self.parameters):
            if parameter.name == name:
                return i
        raise KeyError(f"no parameter '{name}'; there are {', '.join(p.name for p in self.parameters)}")


def identify(
    start: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    distances: Sequence[AnyDistance] = (),
    robust: bool = True,
    keep_effects: bool = False,
    tolerance: float = CONVERGED,
    begin: Array | None = None,
    reject: bool = True,
    most: int | None = None,
    spread: bool = True,
) -> Fit:
    """The fit of these parameters, and of the model's effects with them, about this model, to the samples.

    keep_effects: leave the effects as they are. tolerance: standard deviations within which no value moves any more.
    begin: values of the parameters to begin from; zero by default. reject: give samples far outside no weight at all;
    otherwise, where wrong ones have been left out already, they only count less. most: iterations, where fewer than
    usual are enough. spread: find how well values are known; otherwise covariance and standard deviations are NaN.

    Raises NotEnoughData when the readings are too few for the parameters.
    """
    require_enough(samples, len(parameters), len(distances))
    P = len(parameters)
    fitted = () if keep_effects else start.effects
    limit = None if not robust else REJECT_Z if reject else np.inf
    problem = _Problem(start, samples, tuple(parameters), tuple(distances), fitted, limit)
    values = np.zeros(P) if begin is None else begin
    few = min(_FEW, len(samples) // _MANY)
    if begin is None and not start.effects and few >= _EACH * P:
        some = replace(problem, samples=samples.select(slice(None, None, len(samples) // few)))
        values = _Cost(some, _ROUGHLY).least(values, MAX_ITERATIONS).place.values
    cost = _Cost(problem, tolerance)
    found = cost.least(np.concatenate([values, *(e.values for e in fitted)]), most or MAX_ITERATIONS)
    weights, noise = cost.weigh(found.place)
    H_data, H = cost.curvature(found.place) if spread else (cost.H_data, cost.H)
    covariance = Curvature.of(H).inverse() if spread else np.full_like(H, np.nan)
    # robust weights may oscillate without moving any value that matters, and the minimum may be a valley along which
    # the readings do not determine the values
    converged = found.converged or cost.length <= FITTED
    values = found.place.values
    model = model_at(start, parameters, values, np.sqrt(np.diag(covariance)[P:]))
    return Fit(
        model, start, problem.parameters, values[:P], covariance[:P, :P], noise, weights, H_data[:P, :P],
        found.steps, converged,
    )  # fmt: skip


@dataclass(frozen=True)
class _Problem:
    """What is fitted to what. fitted: effects, all of the model's or none. limit: standard score beyond which a sample
    is rejected; None for least squares.
    """

    start: Model
    samples: Samples
    parameters: tuple[ModelParameter, ...]
    distances: tuple[AnyDistance, ...]
    fitted: tuple[Effect, ...]
    limit: float | None


@dataclass(frozen=True)
class _Place:
    """Values of parameters and effects, and what is left of the samples there."""

    values: Array
    left: Linearised


class _Cost:
    """What a fit makes least: squares of residuals, of known distances and of priors, by weights found at every place.

    length: of the last step, in standard deviations. H, H_data: curvature with and without priors, where a step began.
    """

    def __init__(self, problem: _Problem, tolerance: float) -> None:
        """tolerance: standard deviations from the end, where steps may end."""
        around = problem.start.drivers(problem.samples)
        self.problem, self._tolerance = problem, tolerance
        self._centre, self._prior = priors(problem.fitted, problem.parameters, around)
        self._equations = System(problem.start, problem.parameters, problem.samples, around)
        self._groups = Groups.of(problem.samples, bool(problem.start.instruments))
        held = [np.full(len(e.values), e.held is not None) for e in problem.fitted]
        self._held = np.concatenate([np.zeros(len(problem.parameters), bool), *held])
        # numbers that the samples have to tell: of what is held, first none, then what the prior does not tell
        self._told = float((~self._held).sum())
        self._out = np.zeros(len(problem.samples), bool)
        self._times = np.zeros(len(problem.samples))  # that each sample was rejected
        self._tried = False
        self.length = self._last = np.inf
        self.H = self.H_data = np.diag(self._prior**-2.0)

    def least(self, values: Array, most: int) -> Descent[_Place]:
        """Where the cost is least, from these values downhill."""
        return descend(self._at(values), self._look, self._step, self._ended, most)

    def weigh(self, here: _Place) -> tuple[Array, NoiseModel]:
        """Weights of the samples, (N,), and the noise, found at a place."""
        barred = self._out & (self._times >= _THIRD)
        weights, noise = weigh(here.left, self._groups, self._told, self.problem.limit, barred)
        self._row_weight = row_weights(weights, noise, self.problem.samples)
        return weights, noise

    def curvature(self, here: _Place) -> tuple[Array, Array]:
        """(JᵀWJ, the same with the prior), (P, P), at a place; of independent samples."""
        if self.length > FITTED:
            self._linearise(here)
        if has_shared_noise(self.problem.samples):
            self.H_data = self.H_data / shared_noise(self.problem.samples, here.left, self._row_weight)
        return self.H_data, self.H_data + np.diag(self._prior**-2.0)

    def _at(self, values: Array) -> _Place:
        return _Place(values, self._equations.residuals(values))

    def _look(self, here: _Place) -> float:
        out = self.weigh(here)[0] == 0.0
        self._times += out & ~self._out
        self._out = out
        self._linearise(here)
        self._last, self._tried = self.length, False
        return self._of(here)

    def _linearise(self, here: _Place) -> None:
        """Gradient and curvature."""
        problem = self.problem
        H, g = self._equations.normal_equations(here.values, self._row_weight)
        if problem.distances:
            rows = distance_rows(problem.start, problem.parameters, here.values, problem.distances)
            H = H + (rows.J / rows.std**2) @ rows.J.T
            g = g + (rows.J / rows.std**2) @ rows.residual
        self.H_data, self.H = H, H + np.diag(self._prior**-2.0)
        self._g = g - (here.values - self._centre) * self._prior**-2.0

    def _step(self, here: _Place, damping: float) -> tuple[_Place, float]:
        curvature = Curvature.of(self.H, damping)
        if self._held.any() and not self._tried:
            told = curvature.variances()[self._held] / self._prior[self._held] ** 2
            self._told = len(here.values) - float(np.sum(told))
        step = curvature.solve(self._g)
        self.length, self._tried = float(np.sqrt(max(float(step @ self.H @ step), 0.0))), True
        there = self._at(here.values + step)
        return there, self._of(there)

    def _of(self, here: _Place) -> float:
        """The cost of a place by the weights that are found."""
        problem, N = self.problem, here.left.position.shape[1]
        turned = self._row_weight[3 * N : 3 * N + here.left.rotation.shape[1]]
        cost = float(self._row_weight[:N] @ here.left.square_position + turned @ here.left.square_rotation)
        if problem.distances:
            cost += distance_cost(problem.start, problem.parameters, here.values, problem.distances)
        return cost + float(np.sum(((here.values - self._centre) / self._prior) ** 2))

    def _ended(self, here: _Place, gain: float, cost: float) -> bool:
        """Whether all following steps together are too short to matter, if they become shorter as the last did."""
        self.length = float(np.sqrt(max(self.length**2, gain)))  # where the cost is no parabola, more is left
        rate = max(self.length / self._last, _SHRINKING) if self._last < np.inf else 1.0
        return self.length <= self._tolerance or (rate < 1.0 and self.length * rate <= self._tolerance * (1.0 - rate))


def priors(effects: Sequence[Effect], parameters: Sequence[ModelParameter], around: Drivers) -> tuple[Array, Array]:
    """Where each value is expected and how far from there: geometry at zero, effects at nothing, settings as found."""
    centre, prior = [np.zeros(len(parameters))], [np.array([p.prior_std for p in parameters])]
    for effect in effects:
        linear = len(effect.amplitudes)
        centre.append(np.r_[np.zeros(linear), effect.values[linear:]])
        prior.append(prior_stds(effect, around))
    return np.concatenate(centre), np.concatenate(prior)


def require_enough(samples: Samples, parameters: int, known: int = 0, share: float = 1.0) -> None:
    """Raises NotEnoughData unless a share of these samples gives equations enough for so many parameters.

    known: equations that come on top, such as known distances. A posture that is read again and again gives its own
    once.
    """
    equations, postures = _equations(samples)
    each, need = equations / max(postures, 1), EQUATIONS_PER_PARAMETER * parameters - known
    equations = each * np.floor(share * postures + 0.5)  # as samples are split
    if equations < need:
        again = postures < samples.stations
        least = int(np.ceil((np.ceil(need / max(each, 1e-9)) - 0.5) / share))
        they = "they" if share == 1.0 else f"the {share:.0%} of them that fit"
        said = f"{they} give {equations:.0f} equations, at least {int(np.ceil(need))} are needed"
        remedy = f"record at least {least} {'different postures' if again else 'stations'}, or fix parameters"
        of_them = f" in {postures} postures" if again else ""
        raise NotEnoughData(f"{samples.stations} stations{of_them} for {parameters} parameters", said, remedy)


def enough_for_effects(
    samples: Samples, parameters: int, known: int = 0, each: float = _EQUATIONS_WITH_EFFECTS
) -> bool:
    """Whether samples tell effects from noise beside so many parameters, or give so many equations for each of them.

    known: as of :func:`require_enough`.
    """
    return _equations(samples)[0] >= each * parameters - known


def _equations(samples: Samples) -> tuple[float, int]:
    """How many equations samples give, and in how many postures."""
    rows, postures = np.arange(len(samples)), samples.stations
    if not samples.moving.any():
        posture = distinct(samples.q)
        kind = np.unique(samples.kind, return_inverse=True)[1]
        rows = np.unique(np.stack([posture, samples.frame, kind]), axis=1, return_index=True)[1]
        if len(rows) < len(samples):
            postures = min(postures, len(np.unique(posture)))
    return float(dimensions(samples)[rows].sum()), postures


# --- Moves of base and tool during a recording, and fits that begin about where they are

What = Literal["base", "tool", "both"]
WHATS: tuple[What, ...] = ("base", "tool", "both")


@dataclass(frozen=True)
class Move:
    """Base, tool or both moved at a time [s] between two stations."""

    at: float
    what: What


def identify_moved(
    start: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    distances: Sequence[AnyDistance] = (),
    tolerance: float = CONVERGED,
    reject: bool = True,
    most: int | None = None,
) -> Fit:
    """The fit of a model whose base or tool moved; as :func:`identify` where nothing did.

    A move is known as well as the arm that it was estimated with. Its stations may then lie far outside what the fitted
    arm leaves, and must not be rejected before the move itself has been fitted.
    """
    if not any(is_move(effect) for effect in start.effects):
        return identify(start, samples, parameters, distances, tolerance=tolerance, reject=reject, most=most)
    known = samples, parameters, distances
    first = identify(start, *known, tolerance=_ROUGHLY, reject=False, most=most)
    start = start.with_effects(first.model.effects)
    return identify(start, *known, tolerance=tolerance, begin=first.values, reject=reject, most=most)
