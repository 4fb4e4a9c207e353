"""The running estimate: every sample updates the parameters, the effects' values, and their covariance.

A sample is linearised at the present estimate and taken into a square-root information. The
latest samples are kept and linearised again when the estimate has moved, as a batch Gauss–Newton step does, so that on
an arm that does not change the running estimate is the batch solution. An arm that does change may drift: parameters
named for it get process noise. Samples that do not fit count less, as in a batch fit, and are counted.

What is known of x is kept as an upper triangular R and a vector z with ``R x = z + noise of unit variance``: R is, but
for the signs of its rows, the Cholesky factor of the information matrix, so nothing is squared and an estimate stays
positive definite however long it runs (Bierman 1977, *Factorization Methods for Discrete Sequential Estimation*). New
rows are taken in by one orthogonal triangularisation, which gives what a batch solution of all rows would.

A linearisation of many samples inserts the values again in every call. Here that is done once, and a sample costs one
pass along the chain and a few small products. What a place does to the tool is first seen at the root's origin: the
adjoint matrix of the place's frame carries its twists there, and the way from there to the tool is the same for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.linalg import lapack, solve_triangular

from modcal_core.calibration import (
    HUBER_Z,
    INSTRUMENT,
    Deviations,
    Model,
    ModelParameter,
    NoiseModel,
    RowView,
    View,
    deviations,
    general_samples,
    geometry_rows,
    linearise,
    model_at,
    robust_weights,
    score_of_one,
)
from modcal_core.effects import all_columns, motion, place_index
from modcal_core.geometry import HAT, Array, combined, local_twists, se3, so3
from modcal_core.measurements import POSE, Samples
from modcal_core.robots import Chain, frames, is_serial_arm

_EYE = np.eye(6)
_PANEL = 8  # columns that are eliminated together


@dataclass(frozen=True)
class Information:
    """What is known of x (P,): ``R x = z``.

    triangle: (P + 1, P + 1), upper triangular, in Fortran's order: R, z beside it, and in the corner below z what the
    rows that were added last could not be made to agree with the rest.
    """

    triangle: Array

    @classmethod
    def of(cls, R: Array, z: Array) -> Information:
        """``R x = z``, R (P, P) being upper triangular."""
        P = len(z)
        triangle = np.zeros((P + 1, P + 1), order="F")
        triangle[:P, :P], triangle[:P, P] = R, z
        return cls(triangle)

    @classmethod
    def of_prior(cls, mean: Array, covariance: Array) -> Information:
        """What a mean (P,) and a covariance (P, P) say."""
        L = np.linalg.cholesky(covariance)
        R = np.asarray(np.linalg.qr(solve_triangular(L, np.eye(len(mean)), lower=True), mode="r"))
        return cls.of(R, R @ mean)

    @property
    def R(self) -> Array:
        """(P, P), upper triangular."""
        return self.triangle[:-1, :-1]

    @property
    def z(self) -> Array:
        """What ``R x`` is, (P,)."""
        return self.triangle[:-1, -1]

    def with_rows(self, rows: Array) -> Information:
        """The same with rows ``A x = b + noise of unit variance`` added, which are given as [A b], (k, P + 1)."""
        triangle = self.triangle.copy(order="F")
        triangle[-1, -1] = 0.0
        # made for rows beneath a triangle: its zeros are not gone through
        return Information(lapack.dtpqrt(0, min(_PANEL, len(triangle)), triangle, rows, overwrite_a=1)[0])

    @property
    def innovation(self) -> float:
        """How far the rows that were added last lay from what had been expected of them, squared: ``rᵀ S⁻¹ r``.

        r is their residual before and S its covariance. A sum of squares grows by this where its least is found again,
        so it stands in the corner, and nothing has to be solved for it.
        """
        return float(self.triangle[-1, -1]) ** 2

    def grown(self, G: Array, variance: Array) -> Information:
        """The same after x has drifted by ``G w``, w (m,) being noise of these variances (m,), G (P, m).

        The noise is added as unknowns of its own, known to be about zero, and eliminated again.
        """
        moving = np.asarray(variance) > 0.0
        m, P = int(moving.sum()), len(self.z)
        if not m:
            return self
        stacked = np.zeros((m + P, m + P + 1), order="F")
        stacked[:m, :m] = np.diag(1.0 / np.sqrt(np.asarray(variance)[moving]))
        stacked[m:, :m] = -self.R @ G[:, moving]
        stacked[m:, m : m + P], stacked[m:, m + P] = self.R, self.z
        rest = np.asarray(np.linalg.qr(stacked, mode="r"))[m : m + P, m:]
        return Information.of(rest[:, :P], rest[:, P])

    @property
    def mean(self) -> Array:
        """The estimate of x, (P,)."""
        # the last row is beneath what is solved, and stays: without it the triangle would have to be copied
        return np.asarray(lapack.dtrtrs(self.triangle[:, :-1], self.z)[0])

    @property
    def root(self) -> Array:
        """A square root S of the covariance, ``S Sᵀ``, (P, P)."""
        return np.asarray(solve_triangular(self.R, np.eye(len(self.z)), check_finite=False))


class FixedLinearisation:
    """Residual and derivatives of single samples at these values of a model's parameters and effects."""

    def __init__(self, start: Model, parameters: Sequence[ModelParameter], values: Array) -> None:
        """values: of the parameters, and behind them those of the effects; left out, effects stay as they are."""
        now = self._model = model_at(start, parameters, values)
        self._start, self._parameters, self._values = start, parameters, values
        self._effects = len(values) > len(parameters)
        self._chain: Chain | None = None
        if not is_serial_arm(now.chain):  # of closed chains nothing can be carried from joint to joint
            return
        errors, chain = deviations(start, parameters, values[: len(parameters)]), now.serial
        self._twists = [_twists(now, parameters, errors, frame) for frame in range(len(now.frames))]
        self._T_root_frame = se3.inverse(now.T_frame_base @ chain.T_base_root)
        rooted = np.array(chain.origins)
        rooted[0] = se3.inverse(se3.transform(chain.joint_basis[0]))
        rooted[-1] = rooted[-1] @ now.T_tip_tool
        self._chain = chain.with_origins(rooted)

    def __call__(self, sample: Samples) -> tuple[Array, Array]:
        """(residual (3,) or (6,): position [m] then rotation [rad], its negative derivative (3 or 6, P)) of one row."""
        at, pose = self._model.drivers(sample), np.flatnonzero(sample.is_pose)
        if self._chain is None:
            view = RowView.of(self._model, sample, at)
            J = geometry_rows(view, self._start, self._parameters, self._values)
        else:
            twists, scale = motion(self._model.effects, at)
            f = frames(self._chain, sample.q, twists)
            T = np.concatenate([f.transform(k) for k in range(len(f.p))])
            T_root_frame, p = self._T_root_frame[sample.frame[0]], T[-1, :3, 3]
            R_root_frame = T_root_frame[:3, :3]
            reading = R_root_frame @ (sample.reading[0] / scale[0])
            turned = so3.log(R_root_frame @ sample.R[pose] @ T[-1, :3, :3].T)
            view = RowView(
                sample, pose, f, (reading + T_root_frame[:3, 3] - p)[:, None], turned.reshape(-1, 3).T, reading[:, None]
            )
            to_tool = _EYE.copy()
            to_tool[3:, :3] = (p @ HAT).reshape(3, 3)
            towards = np.swapaxes(se3.adjoint(T), -1, -2).reshape(-1, 6)  # from each place, seen at the root's origin
            J = self._twists[sample.frame[0]] @ towards @ to_tool[:, : 6 if len(pose) else 3]
        if self._effects:
            J = np.concatenate([J, *(view.moved_by(terms)[None] for terms in all_columns(self._model.effects, at))])
        return view.residual, J.T


def _twists(now: Model, parameters: Sequence[ModelParameter], errors: Deviations, frame: int) -> Array:
    """The twist per unit of each parameter in the frame of its place, (P, 6 (n + 1)); for readings in a frame."""
    of_frames, of_places = local_twists(errors.frames), local_twists(errors.places)
    out = np.zeros((len(parameters), now.serial.n + 1, 6))
    with_it = (frame, now.leader(frame))
    for j, p in enumerate(parameters):
        if p.place == INSTRUMENT:
            continue  # of an instrument whose readings do not come here: nothing moves with it
        if p.place:
            out[j, p.place] = of_places[p.place - 1][p.direction]
        elif p.frame in with_it:  # of a frame that does not lead this one, readings in this one say nothing
            out[j, 0] = of_frames[p.frame][p.direction]
    return out.reshape(len(parameters), -1)


def spread(noise: NoiseModel, sample: Samples) -> Array:
    """Standard deviations of the rows of one sample, (3,) or (6,): of the noise and what the reading states."""
    own = np.nan_to_num(np.r_[sample.sigma_position, sample.sigma_rotation])
    return np.hypot((noise.position, noise.rotation), own).repeat(3)[: 6 if sample.is_pose[0] else 3]


KEPT = 512  # samples that can be linearised again
_MOVED = 0.02  # standard deviations; an estimate that moved further is linearised again
_FAR = 0.5  # the same, a parameter: before the oldest are let go, whose error goes with the square of it
Rows = Array  # [A b] of A x = b, with noise of unit variance, (m, P + 1)


@dataclass(frozen=True)
class RandomWalk:
    """Places that may move with time, and how fast. places: of "base", "tool" and joints. metres, radians: standard
    deviation after one second [m/√s, rad/√s].
    """

    places: tuple[str, ...]
    metres: float
    radians: float

    def directions(
        self, model: Model, parameters: Sequence[ModelParameter], count: int, views: Sequence[View]
    ) -> tuple[Array, Array]:
        """How the values (count,) change with each motion of the places, (count, 6 m), and how fast, (6 m,).

        views: what the instruments see.

        A minimal set of parameters holds only some directions of a place; the others are what they pass through to.
        """
        samples = general_samples(model, views, each=max(12, -(-len(parameters) // len(views))))
        bare = model.with_effects(())
        J = linearise(bare, parameters, np.zeros(len(parameters)), samples).J
        seen = RowView.of(bare, samples, bare.drivers(samples))
        moved = [seen.unit_column(place_index(place, model.chain), d) for place in self.places for d in range(6)]
        directions = np.zeros((count, len(moved)))
        directions[: len(parameters)] = combined(J.T, np.stack(moved, axis=1))
        return directions, np.tile([self.metres] * 3 + [self.radians] * 3, len(self.places))


class Estimator:
    """Values of a model's parameters and effects, and their covariance, as samples come in.

    The values are those of :func:`~modcal_core.calibration.fit.identify` about the same model: the parameters',
    relative to the model, and behind them the values of its effects.
    """

    def __init__(
        self,
        model: Model,
        parameters: Sequence[ModelParameter],
        noise: NoiseModel,
        covariance: Array,
        random_walk: RandomWalk | None = None,
        kind: str = POSE,
        robust: bool = True,
    ) -> None:
        """Begin at a model.

        noise: what samples scatter beyond their own noise. covariance: of the values, (P, P). random_walk: what may
        change with time; samples then have an order, and none is linearised again. kind: of the readings. robust:
        mistrust samples that do not fit.
        """
        self.start, self.parameters, self.noise = model, tuple(parameters), noise
        values = [(e, name) for e in model.effects for name in (*range(1, len(e.amplitudes) + 1), *e.refined)]
        self.names = (*(p.name for p in parameters), *(f"{e.label} / {name}" for e, name in values))
        self._robust = robust
        begin = np.concatenate([np.zeros(len(parameters)), *(e.values for e in model.effects)])
        self._now = self._before = Information.of_prior(begin, covariance)
        self.values = begin
        self._stand_at(begin)
        self._kept: list[tuple[Samples, float, Rows]] = []  # each with its weight, and its rows at the point
        views = [View(kind, f) for f in range(len(model.frames))]
        self._directions = random_walk.directions(model, self.parameters, len(begin), views) if random_walk else None
        self._stamp = -np.inf
        self.taken, self.rejected = 0, 0

    @property
    def covariance(self) -> Array:
        """Covariance of the values, (P, P)."""
        return self._now.root @ self._now.root.T

    @property
    def std(self) -> Array:
        """Standard deviations of the values, (P,)."""
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", self._now.root, self._now.root)))

    @property
    def model(self) -> Model:
        """The model with the present values put in."""
        return model_at(self.start, self.parameters, self.values)

    def update(self, sample: Samples) -> float:
        """Take in one sample (a row); returns its weight, 1 for one that is taken in full and 0 for a rejected one."""
        self._grow_covariance(float(sample.stamps[0]))
        rows = self._rows(sample)
        now = self._now.with_rows(rows)
        score = score_of_one(now.innovation, len(rows))
        sure = score <= HUBER_Z or not self._robust
        weight = 1.0 if sure else float(robust_weights(np.asarray(score)))
        self.taken += 1
        self.rejected += weight == 0.0
        if weight > 0.0:
            if weight < 1.0:
                rows = sqrt(weight) * rows
                now = self._now.with_rows(rows)
            self._now, self.values = now, now.mean
            self._keep(sample, weight, rows)
        return weight

    def _grow_covariance(self, stamp: float) -> None:
        passed = stamp - self._stamp
        self._stamp = max(stamp, self._stamp)
        if self._directions is not None and np.isfinite(passed) and passed > 0.0:
            directions, rates = self._directions
            self._now = self._now.grown(directions, rates**2 * passed)

    def _keep(self, sample: Samples, weight: float, rows: Rows) -> None:
        if self._directions is not None:
            if self._apart() > _MOVED:
                self._stand_at(self.values)
            return
        self._kept.append((sample, weight, rows))
        if len(self._kept) >= KEPT:
            if self._apart() > _FAR * sqrt(len(self.values)):
                self.linearise_again()
            half = len(self._kept) // 2
            self._before = self._before.with_rows(np.concatenate([rows for *_, rows in self._kept[:half]]))
            del self._kept[:half]
        elif (self.taken & (self.taken - 1)) == 0 and self._apart() > _MOVED:
            self.linearise_again()  # at every doubling: an estimate moves less and less

    def linearise_again(self) -> None:
        """Linearise the kept samples at the present estimate: one Gauss–Newton step of a batch fit."""
        self._stand_at(self.values)
        self._kept = [(sample, weight, sqrt(weight) * self._rows(sample)) for sample, weight, _ in self._kept]
        self._now = self._before.with_rows(np.concatenate([rows for *_, rows in self._kept]))
        self.values = self._now.mean

    def _stand_at(self, values: Array) -> None:
        """Linearise samples about these values from now on."""
        self._point, self._frozen = values, FixedLinearisation(self.start, self.parameters, values)

    def _rows(self, sample: Samples) -> Rows:
        residual, J = self._frozen(sample)
        rows = np.concatenate([J, (residual + J.dot(self._point))[:, None]], axis=1)
        return np.asarray(rows / spread(self.noise, sample)[:, None])

    def _apart(self) -> float:
        """How far the estimate is from where samples are linearised, in standard deviations."""
        return float(np.linalg.norm(self._now.R @ (self.values - self._point)))
