"""Identification: the parameters that make the model meet the samples, with their uncertainty.

Gauss–Newton on the minimal parameters, damped when a step fails (Levenberg–Marquardt). The columns are scaled to unit
length, so the normal equations solved by Cholesky lose nothing that matters; a prior on the arm's own directions, as
wide as robots are wrong, holds what the data does not show. Weights and the size of the noise are found again at every
step (see :mod:`modcal_core.calibration.noise`). Many samples are begun with a few of them, so that all are gone through
but two or three times; and near the end only the gradient is computed again, which alone decides where that is. The end
is reached when the next step would be too short, going by how much shorter the last was than the one before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from modcal_core.calibration.data_split import distinct
from modcal_core.calibration.distances import AnyDistance, distance_cost, distance_rows
from modcal_core.calibration.equations import system_of
from modcal_core.calibration.linearisation import Linearised, model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import (
    REJECT_Z,
    Groups,
    NoiseModel,
    has_shared_noise,
    known_sigma,
    of_rows,
    shared_noise,
    weigh,
)
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects import Drivers, Effect, is_move, prior_stds
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array
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


MAX_ITERATIONS = 60  # a fit that needs more says that it did not converge
CONVERGED = 1e-5  # standard deviations: the last step of a fit, far below anything a report shows
FITTED = 1e-2  # the same for models with effects, some of which have many values
# Where no value [m, rad] changes by more, and steps become shorter, the curvature is left as it is, which changes with
# their length. The covariance is then right to 1e-4 (robust fits of few: 1e-3), and better where a stricter end is set.
_NEAR = 1e-4
_SHRINKING = 0.3
# With effects, whose curvature takes far longer than their gradient, steps are taken with the same one while each is
# shorter than so much of the last, or shrinks as the last with a curvature of its own did: robust weights alone let
# them shrink by a factor of 1.1 to 10, whatever the curvature; so no more than that is expected of the next one
_LEADING, _CLOSE, _SLOWLY = 0.7, 10.0, 0.1  # the second in standard deviations
# Within half a standard deviation they are taken with the same one whatever they do, so many at most: a sample near the
# limit of rejection lets the weights, and with them the steps, go to and fro, which no curvature ends. Where so many
# steps gain no more together than a tenth of a squared deviation, that is the end.
_WITHIN, _MAX_SAME, _TO_AND_FRO, _NO_GAIN = 0.5, 10, 4, 0.1
_SURE = 0.1  # of the tolerance; what is expected to be left
_MIN_SHARE = 0.2  # of a step that leads uphill, before steps are bent towards the steepest way down
_DAMPING, _MIN_DAMPING = 1e-4, 1e-12  # of the curvature along each value; the least is far above rounding
_FLAT, _SHOWN = 30, 1.0  # iterations that together gain less of the cost than readings can show
# A sample at the limit of rejection may go in and out for ever, each time by what the others then say of it. After so
# many iterations, three times the usual, what is rejected once stays so
_BARRING = 30
_LONGER = 2.5  # times as many iterations of geometry alone, whose valleys are long; each of them is cheap
_ROUGHLY = 5e-3  # m, rad; what a step of values that a fit begins with misses is of the order of its square
_UNSEEN = 1e-2  # standard deviations; what a shorter step changes in the residuals is a millionth of their spread
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
    hopeless: Callable[[Model, float], bool] | None = None,
    spread: bool = True,
) -> Fit:
    """The fit of these parameters, and of the model's effects with them, about this model, to the samples.

    keep_effects: leave the effects as they are. tolerance: standard deviations within which no value moves any more.
    begin: values of the parameters to begin from; zero by default. reject: give samples far outside no weight at all;
    otherwise, where wrong ones have been left out already, they only count less. most: iterations, where fewer than
    usual are enough. hopeless: asked after each step, of the model and the step's length in standard deviations; ends
    the fit. spread: find how well values are known; otherwise covariance and standard deviations are NaN.

    Raises NotEnoughData when the readings are too few for the parameters.
    """
    require_enough(samples, len(parameters), len(distances))
    P = len(parameters)
    values = np.zeros(P) if begin is None else begin
    fitted = () if keep_effects else start.effects
    few = min(_FEW, len(samples) // _MANY)
    limit = None if not robust else REJECT_Z if reject else np.inf
    if begin is None and not start.effects and few >= _EACH * P:
        some = samples.select(slice(None, None, len(samples) // few))
        values = _minimum(start, some, parameters, distances, limit, (), tolerance, values, rough=True).values
    at = _minimum(start, samples, parameters, distances, limit, fitted, tolerance, values, False, most, hopeless)
    covariance = Curvature.of(at.H).inverse() if spread else np.full_like(at.H, np.nan)
    return Fit(
        model_at(start, parameters, at.values, np.sqrt(np.diag(covariance)[P:])),
        start,
        tuple(parameters),
        at.values[:P],
        covariance[:P, :P],
        at.noise,
        at.weights,
        at.H_data[:P, :P],
        at.iterations,
        at.converged,
    )


@dataclass(frozen=True)
class _Minimum:
    """Where the cost is least. H, H_data: JᵀWJ with and without the prior. Others as in the fit."""

    values: Array
    H: Array
    H_data: Array
    weights: Array
    noise: NoiseModel
    iterations: int
    converged: bool


def _minimum(
    start: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    distances: Sequence[AnyDistance],
    limit: float | None,
    fitted: Sequence[Effect],
    tolerance: float,
    begin: Array,
    rough: bool = False,
    most: int | None = None,
    hopeless: Callable[[Model, float], bool] | None = None,
) -> _Minimum:
    """The least cost that is reached from these values of the parameters.

    limit: standard score beyond which a sample is rejected; None for least squares. rough: no more than a beginning;
    its last step is taken without looking where it leads. most: iterations; None for as many as a fit may need.
    hopeless: see :func:`identify`.
    """
    known_p, known_r = known_sigma(samples.sigma_position), known_sigma(samples.sigma_rotation[samples.is_pose])
    pose = samples.is_pose
    groups = Groups.of(samples, bool(start.instruments))
    around = start.drivers(samples)
    centre, prior = priors(fitted, parameters, around)
    known = np.diag(prior**-2.0)
    values = np.concatenate([begin, *(e.values for e in fitted)])
    equations = system_of(start, parameters, samples, around)
    damping, length, near = 0.0, np.inf, False  # length: of the last step, in standard deviations
    least = _DAMPING  # from which a step is damped that leads uphill
    gained: list[float] = []
    flat = False
    moved, leading, same = 0.0, _LEADING, 0  # since the curvature was computed
    curvature: Curvature | None = None
    weighed = 1.0  # all rows, when it was factored
    # numbers that the samples have to tell: of what is held, first none, then what the prior does not tell
    held = np.concatenate(
        [np.zeros(len(parameters), bool), *(np.full(len(e.values), e.held is not None) for e in fitted)]
    )
    told = float((~held).sum())
    barred: np.ndarray | None = None  # samples that stay rejected
    at = equations.residuals(values)
    most = int(MAX_ITERATIONS * (1.0 if fitted else _LONGER)) if most is None else most
    for iteration in range(1, most + 1):
        weights, noise = weigh(at, pose, known_p, known_r, groups, told, limit, barred)
        if iteration > _BARRING:
            barred = weights == 0.0
        row_weight = of_rows(weights, noise.of(samples), noise.rotation, known_p, known_r, pose)
        if near:
            H_samples, g = equations.last_curvature(row_weight), equations.gradient(values, row_weight)
            same += 1
        else:
            H_samples, g = equations.normal_equations(values, row_weight)
            moved, same = 0.0, 0
        H_data, measured = H_samples, 0.0
        if distances:
            H_data = H_samples.copy()
            rows = distance_rows(start, parameters, values, distances)
            H_data += (rows.J / rows.std**2) @ rows.J.T
            g = g + (rows.J / rows.std**2) @ rows.residual
            measured = rows.cost
        H, g = H_data + known, g - (values - centre) * prior**-2.0
        last, share = length, 1.0
        room = tolerance**2 if near and fitted else 0.0  # what a step as long as the tolerance would gain is nothing
        if not (near and fitted):
            curvature = None
        while True:
            if curvature is None:
                curvature, weighed = Curvature.of(H, damping), float(row_weight.sum())
                if held.any() and damping == 0.0:
                    told = len(values) - float(np.sum(curvature.variances()[held] / prior[held] ** 2))
            step = share * weighed / float(row_weight.sum()) * curvature.solve(g)
            length = float(np.sqrt(max(float(step @ H @ step), 0.0))) / share if damping == 0.0 else np.inf
            shrinks = min(max(length / last, _SLOWLY if fitted else 0.0), 1.0) if last < np.inf else 1.0
            following = length * shrinks  # the next step's, most likely
            ended = length <= tolerance or following <= _SURE * tolerance
            begun = rough and damping == 0.0 and float(np.abs(step).max()) <= _ROUGHLY
            if begun or (ended and length <= _UNSEEN):
                new = at
                break
            trial = values + step
            new = equations.residuals(trial)
            before = _cost(at, row_weight) + measured + float(np.sum(((values - centre) / prior) ** 2))
            after = _cost(new, row_weight) + float(np.sum(((trial - centre) / prior) ** 2))
            if distances:
                after += distance_cost(start, parameters, trial, distances)
            downhill = after <= before * (1.0 + 1e-6) + 1e-12 + room
            if downhill or damping > 1e6:
                break
            if near and fitted:  # that curvature has done its service: look again from here
                break
            # bent, along a direction that is hardly seen
            if damping == 0.0 and share > _MIN_SHARE and least == _DAMPING:
                share *= 0.5
            else:
                damping, share, curvature = max(10.0 * damping, least), 1.0, None
        if damping > 0.0:  # in a long and bent valley a tenth of what was enough is enough again
            least = max(0.1 * damping, _MIN_DAMPING)
        looked = new is not at
        if near and fitted and looked and not downhill:
            near, length = False, last
            continue
        gained.append(before - after if looked else 0.0)
        values, at = values + step, new
        flat = len(gained) >= 2 * _FLAT and sum(gained[-_FLAT:]) < _SHOWN
        if fitted and length <= _WITHIN and len(gained) > _TO_AND_FRO:
            flat = flat or sum(gained[-_TO_AND_FRO:]) < _NO_GAIN
        if ended or begun or flat:
            break
        if hopeless is not None and hopeless(model_at(start, parameters, values), length):
            break
        moved = max(moved, float(np.abs(step).max()))
        if fitted:
            if not near and length < last < np.inf:
                leading = max(_LEADING, length / last)
            near = length <= leading * last and length <= _CLOSE
            near = near or (length <= _WITHIN and same < _MAX_SAME)
        else:
            near = length <= _SHRINKING * last and float(np.abs(step).max()) <= _NEAR * min(tolerance / CONVERGED, 1.0)
        near = near and damping == 0.0 and equations.quick_gradient
        damping = 0.0 if damping < 1e-3 else damping / 10.0
    if looked and not rough:  # else these are of the same residuals
        weights, noise = weigh(at, pose, known_p, known_r, groups, told, limit, barred)
    if fitted and tolerance <= FITTED and moved > _NEAR:  # while searching nobody asks for their covariance
        row_weight = of_rows(weights, noise.of(samples), noise.rotation, known_p, known_r, pose)
        H_data = equations.normal_equations(values, row_weight)[0]
        if distances:
            rows = distance_rows(start, parameters, values, distances)
            H_data = H_data + (rows.J / rows.std**2) @ rows.J.T
        H = H_data + known
    if not rough and has_shared_noise(samples):
        H_data = H_data / shared_noise(samples, at, row_weight)
        H = H_data + known
    # robust weights may oscillate without moving any value that matters, and the minimum may be a valley along which
    # the readings do not determine the values
    return _Minimum(values, H, H_data, weights, noise, iteration, ended or begun or flat or length <= FITTED)


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


def _cost(at: Linearised, row_weight: Array) -> float:
    N, M = at.position.shape[1], at.rotation.shape[1]
    return float(row_weight[:N] @ at.square_position + row_weight[3 * N : 3 * N + M] @ at.square_rotation)


# --- Moves of base and tool during a recording, and fits that begin about where they are

_MOVES_ROUGHLY = 1.0  # standard deviations to which a fit is brought before anything may be rejected
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
) -> Fit:
    """The fit of a model whose base or tool moved; as :func:`identify` where nothing did.

    A move is known as well as the arm that it was estimated with. Its stations may then lie far outside what the fitted
    arm leaves, and must not be rejected before the move itself has been fitted.
    """
    if not any(is_move(effect) for effect in start.effects):
        return identify(start, samples, parameters, distances, tolerance=tolerance, reject=reject)
    first = identify(start, samples, parameters, distances, tolerance=_MOVES_ROUGHLY, reject=False)
    start = start.with_effects(first.model.effects)
    return identify(start, samples, parameters, distances, tolerance=tolerance, begin=first.values, reject=reject)
