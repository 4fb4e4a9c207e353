"""How far readings may lie from a frozen model while nothing has changed.

Four parts: what the calibration does not know of its own parameters, seen at these postures (``J Σ Jᵀ``); the spread
that the calibration found and could not explain; what each reading states of itself; and, where the calibration's
verdict left a pattern, a share of the spread that neighbouring postures have in common and that no number of stations
averages away. How the spread divides between the instrument and joints that repeat imperfectly is not known from its
size alone, and neither is the size to a few per cent: a small grid of both is kept, each with its prior probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from modcal_core.calibration.linearise import RowView, geometry_rows
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import NoiseModel
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.score import FINEST
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Effect, all_columns
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

FACTORS = (0.71, 0.84, 1.0, 1.19, 1.41, 1.68)  # of the spread
_FACTOR_STD = 0.2  # of its logarithm: a spread of 160 stations is known to 3 %, that of another day to some 20 %
JOINT_SHARES = (0.0, 0.3, 0.6, 0.9)  # of the spread that joints make, as far as its size allows
_ONE_JOINT = 0.3  # prior that the pattern is that of one joint
_OF_ONE = (1.0, 1.41)  # factors of the spread beside it
_ALIKE = 0.6  # rad or m, over all joints: postures this far apart share 61 % of a pattern
_LARGE = 400  # rows, beyond which a coarser grid is kept: it is then known well from the data


@dataclass(frozen=True)
class FrozenKnowledge:
    """What a calibration knows of itself. parameters: of the geometry. covariance: (K, K), of them and then of the
    values of the effects. noise: spread of single readings. pattern: share of its variance that postures share.
    """

    parameters: tuple[ModelParameter, ...]
    covariance: Array
    effects: tuple[Effect, ...]
    noise: NoiseModel
    pattern: float = 0.0


@dataclass(frozen=True)
class RowKinds:
    """What each row of a linearisation is. sample: its index. component: 0 … 5. variance, known: of the spread and of
    the reading's own statement.
    """

    sample: np.ndarray
    component: np.ndarray
    variance: Array
    known: Array

    @classmethod
    def of(cls, samples: Samples, noise: NoiseModel) -> RowKinds:
        """The rows of these samples."""
        N, pose = len(samples), np.flatnonzero(samples.is_pose)
        sample = np.concatenate([np.tile(np.arange(N), 3), np.tile(pose, 3)])
        component = np.concatenate([np.repeat(np.arange(3), N), np.repeat(np.arange(3, 6), len(pose))])
        position = np.broadcast_to(np.maximum(noise.of(samples), FINEST) ** 2, N)
        rotation = max(noise.rotation, FINEST) ** 2
        turned = component >= 3
        known_p, known_r = (np.nan_to_num(s) ** 2 for s in (samples.sigma_position, samples.sigma_rotation))
        return cls(
            sample,
            component,
            np.where(turned, rotation, position[sample]),
            np.where(turned, known_r[sample], known_p[sample]),
        )


@dataclass(frozen=True)
class NullModel:
    """Residuals, and what they scatter by while nothing has changed.

    residual: (n,). covariances: (n, n) each, for every member of the grid, with log_prior (G,). reference: the member
    that a person would take, for fits. rows: what each row is.
    """

    residual: Array
    covariances: tuple[Array, ...]
    log_prior: Array
    reference: int
    rows: RowKinds

    def with_more(self, residual: Array, columns: Array, scale: float) -> NullModel:
        """The same after a change was taken up: another residual, and a size along these columns (n, k) left open."""
        more = (scale * columns) @ (scale * columns).T
        return NullModel(residual, tuple(V + more for V in self.covariances), self.log_prior, self.reference, self.rows)

    def with_noise(self, position: float, rotation: float) -> NullModel:
        """The same with a spread that is larger by these factors."""
        extra = np.where(self.rows.component >= 3, rotation**2 - 1.0, position**2 - 1.0) * self.rows.variance
        covariances = tuple(V + np.diag(extra) for V in self.covariances)
        return NullModel(self.residual, covariances, self.log_prior, self.reference, self.rows)


def null(model: Model, samples: Samples, view: RowView, drivers: Drivers, known: FrozenKnowledge) -> NullModel:
    """What these samples scatter by about this model while nothing has changed."""
    rows = RowKinds.of(samples, known.noise)
    residual = np.concatenate([view.position.ravel(), view.rotation.ravel()])
    J = parameter_rows(model, view, drivers, known.parameters, known.effects)
    own = J.T @ known.covariance[: len(J), : len(J)] @ J if len(J) else np.zeros((len(residual),) * 2)
    own_joint = [_of_joint(p, samples, view, rows) for p in _turning(model)]
    joints, share = _together(own_joint, rows)
    pattern = _pattern(samples, rows) * np.sqrt(np.outer(rows.variance, rows.variance))
    turned = (rows.component >= 3).astype(int)

    def spread(part: float, common: Array) -> Array:
        white = np.diag(rows.variance * (1.0 - part * share[turned]))
        return (1.0 - known.pattern) * (white + part * joints) + known.pattern * common

    fine = len(residual) <= _LARGE
    members: list[tuple[Array, float]] = []  # covariance of the spread, and the logarithm of its prior
    reference = 0
    for factor in FACTORS if fine else FACTORS[2:3]:
        for part in JOINT_SHARES if fine else JOINT_SHARES[1:3]:
            if factor == 1.0 and part == JOINT_SHARES[1]:
                reference = len(members)
            members.append((factor**2 * spread(part, pattern), -0.5 * (np.log(factor) / _FACTOR_STD) ** 2))
    # the pattern that is left may be one joint's, as of a gear whose curve was too fine to be found
    usual = float(scipy.special.logsumexp([p for _, p in members]))
    if known.pattern > 0.0 and own_joint:
        each = np.log(_ONE_JOINT / (1.0 - _ONE_JOINT) / (len(own_joint) * len(_OF_ONE))) + usual
        for T, size in own_joint:
            single = T + np.diag(rows.variance * (1.0 - size[turned]))
            members += [(factor**2 * spread(JOINT_SHARES[1], single), each) for factor in _OF_ONE]
    log_prior = np.array([p for _, p in members])
    log_prior -= scipy.special.logsumexp(log_prior)
    return NullModel(residual, tuple(own + V + np.diag(rows.known) for V, _ in members), log_prior, reference, rows)


def parameter_rows(
    model: Model, view: RowView, drivers: Drivers, parameters: Sequence[ModelParameter], effects: Sequence[Effect]
) -> Array:
    """Derivatives of the predictions by what a calibration's covariance is of, (K, n)."""
    geometry = geometry_rows(view, model, parameters, np.zeros(len(parameters)))
    terms = all_columns(effects, drivers)
    return np.concatenate([geometry, *(view.moved_by(t)[None] for t in terms)]) if terms else geometry


def _turning(model: Model) -> list[tuple[int, int]]:
    """Place and direction of every joint that turns."""
    chain = model.chain
    return [(chain.first_place + j, 5) for j in range(len(chain.names)) if chain.revolute[j]]


def _of_joint(at: tuple[int, int], samples: Samples, view: RowView, rows: RowKinds) -> tuple[Array, Array]:
    """Covariance (n, n) of a joint that repeats badly, as large as the spread allows; its share of either variance."""
    g = view.unit_column(*at)
    size = _sizes(g**2, rows)
    tau2 = 1.0 / max(*size, 1e-300)
    same = samples.station[rows.sample][:, None] == samples.station[rows.sample]
    return tau2 * np.outer(g, g) * same, np.minimum(tau2 * np.array(size), 1.0)


def _sizes(square: Array, rows: RowKinds) -> tuple[float, float]:
    """Mean squares of positions and orientations, in the variances of the spread."""
    turned = rows.component >= 3
    position, rotation = (
        float(square[part].mean() / rows.variance[part].mean()) if part.any() else 0.0 for part in (~turned, turned)
    )
    return position, rotation


def _together(each: list[tuple[Array, Array]], rows: RowKinds) -> tuple[Array, Array]:
    """The same of all joints, each with an equal share of what the spread allows."""
    if not each:
        return np.zeros((len(rows.sample),) * 2), np.zeros(2)
    total = np.sum([T for T, _ in each], axis=0)
    size = _sizes(np.diag(total), rows)
    scale = 1.0 / max(*size, 1e-300)
    return scale * total, np.minimum(scale * np.array(size), 1.0)


def _pattern(samples: Samples, rows: RowKinds) -> Array:
    """Correlation (n, n) of what depends on the posture, smoothly."""
    q = samples.q
    far = np.sum((q[:, None] - q) ** 2, axis=-1)
    alike = np.exp(-0.5 * far / _ALIKE**2)
    same = rows.component[:, None] == rows.component
    return np.asarray(alike[np.ix_(rows.sample, rows.sample)] * same)
