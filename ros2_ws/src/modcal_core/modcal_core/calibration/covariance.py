"""How well a calibrated model is known: one covariance of its geometry and its effects together.

Amplitudes of effects and constants of the arm share what the data says (a sag that grows with load is half a joint
zero), so their variances alone would say too much or too little of a predicted pose. The values are small deviations
about the calibrated model *as it is written*, after its gauge has been chosen.

A direction counts as observed when the data alone fixes it better than the prior does, that is better than 10 mm or
20 mrad. With every parameter measured in units of its prior deviation, the eigenvalues of the data's information are
(prior deviation / data deviation)², so the line is drawn at one.

With θ the values taken away and C the covariance of all, the rest moves by C_re C_ee⁻¹ θ: there the quadratic about the
minimum is least among the models without them.

Groups of values: the x of a group are normal about zero with one standard deviation σ, residuals are linear in them. Of
all σ, and of the noise, the likelihood of the data with x integrated out is greatest where

    σ² = Σ x² / γ,      γ = Σ (1 − V_ii / σ²),      s² = |r|² / (R − Σ γ)

over the values of the group, with V the covariance that the data leaves them: γ is how many numbers the data tells of
the group (MacKay 1992, *Bayesian interpolation*; for groups Tipping 2001). One of which it says nothing shrinks to
nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from modcal_core.calibration.distances import AnyDistance, distance_rows
from modcal_core.calibration.equations import blocks_at, normal_equations
from modcal_core.calibration.fit import Curvature, Fit, inverse_of_triangle
from modcal_core.calibration.linearisation import RowView, apply_deviations, deviations, effect_rows, linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import (
    FINEST,
    REJECT_Z,
    Groups,
    NoiseModel,
    errors,
    has_shared_noise,
    known_sigma,
    median_chi2,
    row_weights,
    shared_noise,
    squared_residuals,
    standard_score,
)
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.prediction import outside_drivers
from modcal_core.effects import Drivers, Effect, all_columns, is_large_move, motion, prior_stds
from modcal_core.geometry import Array, so3
from modcal_core.measurements import POINT, Samples, spread_rows
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.robots import is_serial_arm, tool_frames


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of deviations from a model.

    parameters: P of the geometry, each one direction at one place (see :mod:`modcal_core.calibration.parameters`), zero
    at the model itself. covariance: (K, K), of the parameters [m, rad], then of the values of the model's effects in
    their order.
    """

    parameters: tuple[ModelParameter, ...]
    covariance: Array

    @property
    def std(self) -> Array:
        """Standard deviations, (K,)."""
        return np.sqrt(np.diag(self.covariance))


def uncertainty(
    model: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    fit: Fit,
    distances: Sequence[AnyDistance] = (),
) -> Uncertainty:
    """The uncertainty of these parameters about a model, and of its effects, as these samples leave it.

    fit: of the same samples, whose weights and noise count. It is the inverse of JᵀWJ with the priors added.
    """
    P = len(parameters)
    values = np.concatenate([np.zeros(P), *(e.values for e in model.effects)])
    around = model.drivers(samples)
    prior = np.concatenate([[p.prior_std for p in parameters], *(prior_stds(e, around) for e in model.effects)])
    weight = row_weights(fit.weights, fit.noise, samples)
    H, _ = normal_equations(model, parameters, values, samples, weight, blocks_at(samples, around))
    if has_shared_noise(samples):
        left = linearise(model, parameters, values, samples, jacobian=False, drivers=around)
        H /= shared_noise(samples, left, weight)
    if distances:
        rows = distance_rows(model, parameters, values, distances)
        H += (rows.J / rows.std**2) @ rows.J.T
    return Uncertainty(tuple(parameters), Curvature.of(H + np.diag(prior**-2.0)).inverse())


_LIKELY = 0.999  # chance that the noise is not underestimated by more
_MAX_FITTED = 1500  # samples that a covariance is made from; more are thinned and count for those left out


def uncertainty_of(
    fit: Fit, samples: Samples, seen: np.ndarray, distances: Sequence[AnyDistance] = (), noise: NoiseModel | None = None
) -> Uncertainty:
    """The uncertainty that a fit to some rows (``seen``) of these samples leaves. noise: of residuals; None: the fit's.

    What judges the fit's misfit gives the noise, so that a large misfit does not excuse itself.
    """
    rows = spread_rows(len(seen), _MAX_FITTED)
    weights = fit.weights[rows] * (len(seen) / max(len(rows), 1))
    part = replace(fit, weights=weights, noise=noise or fit.noise)
    return uncertainty(fit.model, samples.select(seen[rows]), fit.parameters, part, distances)


def rejected(fit: Fit, samples: Samples, seen: np.ndarray, distances: Sequence[AnyDistance] = ()) -> np.ndarray:
    """True for samples that lie outside the noise of a fit to some rows (``seen``) of them, (N,).

    What the fit has not seen, or gave no weight, may be farther off by what its parameters are uncertain by. Of few
    samples it knows the noise hardly: positions, or orientations, may take up all of its parameters. What it has not
    seen is then compared with the usual size of that, as far as the degrees of freedom leave the noise open (F law).
    """
    unseen = np.setdiff1d(np.arange(len(samples)), seen[fit.weights > 0.0])
    known = uncertainty_of(fit, samples, seen, distances)
    placed = np.unique(samples.frame[seen[fit.weights > 0.0]])  # a frame that is rejected whole is not uncertain
    spread = with_doubt(samples, fit.model, known, unseen[np.isin(samples.frame[unseen], placed)])
    dimensions = Groups.of(samples, bool(fit.model.instruments)).dimensions
    square = squared_residuals(errors(fit.model, samples), spread, fit.noise, FINEST)
    values = len(fit.parameters) + sum(len(e.values) for e in fit.model.effects)
    freedom = max(float(np.minimum(dimensions[seen], 3.0).sum()) - values, 1.0)
    if len(unseen):
        usual = float(np.median(square[unseen] / [median_chi2(int(d)) for d in dimensions[unseen]]))
        most = float(scipy.special.fdtri(float(dimensions[unseen].sum()), freedom, _LIKELY))
        square[unseen] /= np.clip(usual, 1.0, max(most, 1.0))
    return np.asarray(standard_score(square, dimensions) > REJECT_Z)


def with_doubt(samples: Samples, model: Model, known: Uncertainty, rows: np.ndarray) -> Samples:
    """The samples; to the standard deviations of some rows, which no fit has seen, is added what the model's own
    uncertainty makes there (the trace of J C Jᵀ over its axes).
    """
    position, rotation = (known_sigma(s) ** 2 for s in (samples.sigma_position, samples.sigma_rotation))
    values = np.concatenate([np.zeros(len(known.parameters)), *(e.values for e in model.effects)])
    for part in np.split(rows, range(_CHUNK, len(rows), _CHUNK)) if len(known.covariance) else ():
        seen = samples.select(part)
        J = linearise(model, known.parameters, values, seen).J
        variance = np.einsum("kr,kr->r", J, known.covariance @ J)
        N, pose = len(seen), part[seen.is_pose]
        axes = np.maximum(Groups.of(seen, bool(model.instruments)).dimensions - 3.0 * seen.is_pose, 1.0)
        position[part] += variance[: 3 * N].reshape(3, N).sum(axis=0) / axes
        rotation[pose] += variance[3 * N :].reshape(3, -1).sum(axis=0) / 3.0
    return replace(samples, sigma_position=np.sqrt(position), sigma_rotation=np.sqrt(rotation))


# --- What the data can tell: rank, condition, and by name the combinations that it leaves open

_NAMED = 0.3  # share of a direction (of unit length) above which a parameter is named as part of it
_FEW_NAMED = 3  # parameters that are named where none is that large
_WEAK = 0.2  # of the prior's deviation, above which a combination that is seen counts as hardly seen
_MAX_WEAK = 5  # named in one report


@dataclass(frozen=True)
class Identifiability:
    """parameters: how many were fitted. rank: how many combinations the data shows. condition: ratio of the largest to
    the smallest singular value of the observed part, columns scaled to unit length. unobservable: the rest, by name.
    deviations: of every combination its deviation by the data alone, in deviations of the prior, the best known first.
    weak: those that are observed, but hardly: their names and spreads, the weakest first.
    """

    parameters: int
    rank: int
    condition: float
    unobservable: tuple[str, ...]
    deviations: tuple[float, ...] = ()
    weak: tuple[tuple[str, float], ...] = ()


def identifiability(fit: Fit) -> Identifiability:
    """Rank, condition and unobservable combinations of a fit."""
    prior = np.array([p.expected if np.isfinite(p.expected) else 1.0 for p in fit.parameters])
    value, vector = np.linalg.eigh(fit.information * np.outer(prior, prior))
    seen = value >= 1.0
    rank = int(seen.sum())
    names = [_name(v, fit) for v in vector[:, ~seen].T]
    deviations = 1.0 / np.sqrt(np.maximum(value, 1e-300))
    hardly = [k for k in np.flatnonzero(seen) if deviations[k] > _WEAK][:_MAX_WEAK]
    weak = tuple((_name(vector[:, k], fit), float(deviations[k])) for k in hardly)
    size = np.sqrt(np.maximum(np.diag(fit.information), 1e-300))
    scaled = np.linalg.eigvalsh(fit.information / np.outer(size, size))[len(prior) - rank :]
    condition = float(np.sqrt(scaled[-1] / max(scaled[0], 1e-300))) if rank else float("inf")
    known = tuple(float(x) for x in deviations[::-1])
    return Identifiability(len(prior), rank, condition, tuple(dict.fromkeys(names)), known, weak)


def _name(direction: Array, fit: Fit) -> str:
    """The parameters that a direction (P,) mostly consists of."""
    parts = sorted(((abs(x), p.name) for x, p in zip(direction, fit.parameters, strict=True)), reverse=True)
    # where many parameters share a direction, none of them is a large part of it
    large = [name for size, name in parts if size >= _NAMED] or [name for _, name in parts[:_FEW_NAMED]]
    return " with ".join(large)


# --- A model without some of its effects, everything else fitted again: by one step in closed form


def without(model: Model, known: Uncertainty, gone: Sequence[int]) -> Model:
    """The model without the effects of these numbers. known: covariance of its parameters and effects' values."""
    if not len(gone):
        return model
    values, kept = values_without(model, known, gone)
    return apply_deviations(model, deviations(model, known.parameters, values)).with_effects(kept)


def values_without(model: Model, known: Uncertainty, gone: Sequence[int]) -> tuple[Array, tuple[Effect, ...]]:
    """By how much the parameters move, (P,) [m, rad], and the effects that are left, where those go."""
    P, effects = len(known.parameters), model.effects
    if any(is_large_move(effects[i]) for i in gone):  # no small step of the others stands in for it
        return np.zeros(P), tuple(e for i, e in enumerate(effects) if i not in set(gone))
    ends = P + np.cumsum([0, *(len(e.values) for e in effects)])
    values = np.concatenate([np.zeros(P), *(e.values for e in effects)])
    # their settings mean nothing without their amplitudes
    own = np.concatenate([np.arange(ends[i], ends[i] + len(effects[i].amplitudes)) for i in gone])
    C = known.covariance
    step = -C[:, own] @ np.linalg.lstsq(C[np.ix_(own, own)], values[own], rcond=1e-12)[0]
    values = values + step
    kept = [e.with_values(values[ends[i] : ends[i + 1]], e.std) for i, e in enumerate(effects) if i not in set(gone)]
    return values[:P], tuple(kept)


# --- How well a full model knows itself at a posture, beside what geometry alone leaves

# Of the squares that geometry alone leaves: what a covariance says of a model is too little by several times where
# the model is not quite right, so that at a fifth in RMS the better of the two is no longer known.
# A judgement, made on parts of one real UR10's series. On 180 parts of other arms and recordings, it is worse than
# geometry alone in three (bench/outside.py).
UNSURE = 0.05
_CHUNK = 500  # samples, for memory


@dataclass(frozen=True)
class Doubt:
    """model: calibrated, in its own frames. known: its uncertainty. alone: squared error [m²] of geometry alone."""

    model: Model
    known: Uncertainty
    alone: float

    def share(self, samples: Samples, drivers: Drivers | None = None) -> Array:
        """How much geometry alone should count for that reason at these samples, in [0, 1], (N,).

        drivers: of the samples and of this model's arm, where they are known already.
        """
        of = np.array([self.model.frames.index(f) if f in self.model.frames else 0 for f in samples.frames])
        N = len(samples)
        if drivers is not None and self._told.places is not None and N <= _CHUNK:
            return self._doubted(self._variance(self._moved(samples, of[samples.frame], drivers)))
        seen = replace(
            samples, frames=self.model.frames, frame=of[samples.frame], sockets=(),
            kind=np.full(N, POINT, dtype=KIND_NAMES), reading=np.zeros((N, 3)),
        )  # fmt: skip
        rows = [slice(k, min(k + _CHUNK, N)) for k in range(0, N, _CHUNK)]
        parts = [self._variance(self._rows(seen if len(rows) == 1 else seen.select(chunk))) for chunk in rows]
        return self._doubted(np.concatenate([np.zeros(0), *parts]))

    def _doubted(self, variance: Array) -> Array:
        """What share of geometry alone a variance of predicted positions (N,) [m²] calls for."""
        u = np.clip(variance / (UNSURE * self.alone), 0.0, 1.0)
        return np.asarray(u * u * (3.0 - 2.0 * u))

    def _variance(self, J: Array) -> Array:
        """Variance (N,) [m²] of predicted positions, from their derivatives J and what postures alone determine.

        The uncertainty of a free curve outside its samples does not count: geometry alone lacks the curve as well.
        """
        of = self._told
        return np.minimum(_spread(J, of.covariance), _spread(J[of.stated], of.covariance_stated))

    def _rows(self, samples: Samples) -> Array:
        """d(position)/d(value), (K, 3 N): those of ``linearise`` at the model's own values."""
        of, N = self._told, len(samples)
        if of.places is None:
            return linearise(of.model, of.parameters, of.values, samples).J[:, : 3 * N]
        return self._moved(samples, samples.frame, of.model.drivers(samples))

    def _moved(self, samples: Samples, frame: np.ndarray, at: Drivers) -> Array:
        """The same of samples whose readings and orientations do not count. frame: each one's in the model, (N,)."""
        # one posture a hundred times a second: all directions at once, of a model that need not be made anew
        of, N = self._told, len(samples)
        assert of.places is not None
        twists, _ = motion(of.model.effects, at)
        f = tool_frames(of.model.chain, of.model.T_tip_tool, samples.q, twists)
        view = RowView(samples, np.empty(0, int), f, np.zeros((3, N)), np.zeros((3, 0)), np.zeros((3, N)))
        axis = view.f.axes[of.places, of.directions % 3].transpose(1, 0, 2)  # (3, parameters, N)
        arm = (view.f.p[-1] - view.f.p[of.places]).transpose(1, 0, 2)
        moved = np.where(of.directions[:, None] < 3, axis, so3.cross(axis, arm)) * of.frames[:, frame]
        J, P = np.empty((len(of.values), 3 * N)), len(of.places)
        J[:P] = moved.transpose(1, 0, 2).reshape(P, 3 * N)
        if len(J) > P:
            effect_rows(view, all_columns(of.model.effects, at), out=J[P:])
        return J

    @functools.cached_property
    def _told(self) -> _Told:
        """The part of model and uncertainty that postures alone tell: the same for every posture."""
        parameters, effects = self.known.parameters, self.model.effects
        kept = [k for k, p in enumerate(parameters) if p.instrument < 0]
        rows = list(kept)
        first, told = len(parameters), []
        for effect in effects:
            if not outside_drivers(effect):
                told.append(effect)
                rows += range(first, first + len(effect.values))
            first += len(effect.values)
        C = self.known.covariance[np.ix_(rows, rows)]
        F, led = len(self.model.frames), self.model.frames_led_by
        free = np.concatenate([np.zeros(len(kept), bool), *(np.full(len(e.values), e.shape.is_free) for e in told)])
        stated = np.flatnonzero(~free)
        own = [parameters[k] for k in kept]
        simple = is_serial_arm(self.model.chain) and all(p.place >= 0 and p.direction < 6 for p in own)
        return _Told(
            model=replace(self.model.with_effects(tuple(told)), instruments=()),
            parameters=own,
            places=np.array([p.place for p in own], int) if simple else None,
            directions=np.array([p.direction for p in own], int),
            frames=np.array([[p.place > 0 or f in led(p.frame) for f in range(F)] for p in own]).reshape(-1, F),
            values=np.concatenate([np.zeros(len(kept)), *(e.values for e in told)]),
            covariance=C,
            stated=stated,
            covariance_stated=C[np.ix_(stated, stated)],
        )


@dataclass(frozen=True)
class _Told:
    """A model whose parameters and effects postures alone drive, and their covariance.

    values: of parameters and effects, (K,). places, directions: of the parameters; None: some move the tool otherwise
    than as a twist at a place. frames: whether each matters in each of the model's frames. covariance: (K, K). stated:
    which of them belong to no free curve, and covariance_stated: theirs.
    """

    model: Model
    parameters: list[ModelParameter]
    values: Array
    places: np.ndarray | None
    directions: np.ndarray
    frames: np.ndarray
    covariance: Array
    stated: np.ndarray
    covariance_stated: Array


def _spread(J: Array, C: Array) -> Array:
    """Trace of J C Jᵀ of each sample, (N,), with J (K, 3 N)."""
    return np.asarray(np.einsum("kr,kr->r", J, C @ J).reshape(3, -1).sum(axis=0))


# --- How large groups of values are likely to be, by the very data that they explain (empirical Bayes)

_MAX_ROUNDS = 30  # for time
_SETTLED = 0.05  # change of the logarithm of a size: predictions hardly depend on it
# Times the change that the equations ask for, in the logarithm: where little is told of a group each round takes a part
# of the way, and below 2 no size swings for ever (in two thirds of the rounds it ends nearer to where many lead)
_FARTHER = 1.8
# Numbers told of a group, below which it is as good as nothing where it shrinks, and what it grows by matters as much
# less: by a few per cent a round for ever, of a joint that hardly moves the tool
_NOTHING = 0.3


@dataclass(frozen=True)
class GroupSizes:
    """sizes: standard deviation of each group's values, zero where it is nothing. told: numbers that the data told of
    it. values: most likely ones of all, (K,). noise: the data's, in units of what it was taken for.
    """

    sizes: tuple[float, ...]
    told: tuple[float, ...]
    values: Array
    noise: float


def likely_sizes(
    H: Array, g: Array, square: float, rows: float, prior: Array, groups: Sequence[np.ndarray], begin: Sequence[float]
) -> GroupSizes:
    """The most likely sizes of groups of values.

    H, g, square: JᵀWJ (K, K), JᵀWr (K,) and rᵀWr of residuals about values of zero. rows: of r. prior: standard
    deviations (K,) of values in no group. groups: numbers of the values of each. begin: sizes to begin from.
    """
    std, sizes, told = np.array(prior), list(begin), [0.0] * len(groups)
    alive = [len(own) > 0 and size > 0.0 for own, size in zip(groups, sizes, strict=True)]
    for own, size in zip(groups, sizes, strict=True):
        std[own] = size
    noise, x = 1.0, np.zeros(len(std))
    used, own_H = np.arange(len(std)), H
    for _ in range(_MAX_ROUNDS):
        still = std[used] > 0.0
        if not still.all():
            used = used[still]
            own_H = H[np.ix_(used, used)]
        if not len(used):
            break
        d = std[used]
        A = own_H * (d[:, None] / noise**2)
        A *= d
        A.flat[:: len(A) + 1] += 1.0
        lower, failed = scipy.linalg.lapack.dpotrf(A.T, lower=1, clean=0, overwrite_a=1)
        if failed:  # the data leave no noise to weigh sizes against
            return GroupSizes((0.0,) * len(groups), (0.0,) * len(groups), np.zeros(len(std)), noise)
        x = np.zeros(len(std))
        x[used] = d * scipy.linalg.lapack.dpotrs(lower, d * g[used] / noise**2, lower=1)[0]
        told_each = np.zeros(len(std))
        half = inverse_of_triangle(lower)
        told_each[used] = 1.0 - np.einsum("ij,ij->j", half, half)
        left = square - 2.0 * float(x @ g) + float(x @ H @ x)
        new = float(np.sqrt(max(left, 0.0) / max(rows - float(told_each.sum()), 1.0)))
        change = abs(np.log(max(new, 1e-12) / noise))
        noise = max(new, 1e-12)
        for i, own in enumerate(groups):
            if not alive[i]:
                continue
            told[i] = float(told_each[own].sum())
            size = float(np.sqrt(x[own] @ x[own] / max(told[i], 1e-12)))
            if (told[i] < _NOTHING and size < sizes[i]) or not size > 0.0:
                alive[i], size, told[i] = False, 0.0, 0.0
            else:
                farther = float(np.log(size / sizes[i]))
                change = max(change, abs(farther) * min(told[i] / _NOTHING, 1.0))
                size = sizes[i] * float(np.exp(_FARTHER * farther))
            sizes[i] = size
            std[own] = size
        if change <= _SETTLED:
            break
    return GroupSizes(tuple(sizes), tuple(told), x, noise)
