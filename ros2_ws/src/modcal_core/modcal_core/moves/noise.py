"""How far readings may lie from a frozen model while nothing has changed.

Four parts: what the calibration does not know of its own parameters, seen at these postures (``J Σ Jᵀ``); the spread
that the calibration found and could not explain; what each reading states of itself; and, where the calibration's
verdict left a pattern, a share of the spread that neighbouring postures have in common and that no number of stations
averages away. How the spread divides between the instrument and joints that repeat imperfectly is not known from its
size alone, and neither is the size to a few per cent: a small grid of both is kept, each with its prior probability.

Errors of stations close to one another are alike, so ten neighbours are not ten witnesses. How many they stand for is
``n² / Σ ρ_ij`` with ρ the correlation by their postures: that many independent values have a mean as well known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import FINEST, Model, ModelParameter, NoiseModel, RowView, geometry_rows
from modcal_core.effects import Drivers, Effect, all_columns
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

_ALIKE = 0.6  # rad or m, over all joints: postures this far apart share 61 % of a pattern
_ROUGH = 0.5  # share of such a curve that changes from station to station, as the many waves of a gear do
# rad after which a joint's curve is another one: of a wave or two a turn, of ten, and of the finest gears
_LENGTHS = (0.7, 0.1, 0.01)
FACTORS = (0.71, 0.84, 1.0, 1.19, 1.41, 1.68)  # of the spread
_FACTOR_STD = 0.2  # of its logarithm: a spread of 160 stations is known to 3 %, that of another day to some 20 %
JOINT_SHARES = (0.0, 0.3, 0.6, 0.9)  # of the spread that joints make, as far as its size allows
_ONE_JOINT = 0.3  # prior that the pattern is that of one joint
# times the share of a pattern in the variance, where it is large: with a share of 0.15, places of the UR10 that
# bench/check looks at leave up to five times the usual variance
_THERE = (8.0, 16.0)
_NEVER = -6.0  # logarithm of a chance (1 in 400) below which stations do not all stand in such places
_LARGE = 400  # rows, beyond which a coarser grid is kept: it is then known well from the data


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
        position = np.broadcast_to(np.maximum(noise.of(samples), FINEST) ** 2, N)[sample]
        known_p, known_r = (np.nan_to_num(s)[sample] ** 2 for s in (samples.sigma_position, samples.sigma_rotation))
        variance = np.where(component >= 3, max(noise.rotation, FINEST) ** 2, position)
        return cls(sample, component, variance, np.where(component >= 3, known_r, known_p))

    def extra(self, position: float, rotation: float) -> Array:
        """Covariance (n, n) that readings have more where their spread grew by these factors."""
        return np.diag(np.where(self.component >= 3, rotation**2 - 1.0, position**2 - 1.0) * self.variance)

    def scaled(self, covariance: Array) -> tuple[Array, Array]:
        """The covariance as large as the spread allows in positions and orientations, and its share of each row."""
        turned, square = self.component >= 3, np.diag(covariance)
        size = np.zeros(len(turned))
        for part in (~turned, turned):
            size[part] = square[part].mean() / self.variance[part].mean() if part.any() else 0.0
        scale = 1.0 / max(float(size.max(initial=0.0)), 1e-300)
        return scale * covariance, np.minimum(scale * size, 1.0)


def witnesses(samples: Samples) -> float:
    """Number of independent stations that these count as, from one to their number."""
    first = np.unique(samples.station, return_index=True)[1]
    return len(first) ** 2 / float(_alike(samples.q[first]).sum())


def varying(q: Array, revolute: bool) -> Array:
    """Correlation (n, n) of a joint's curve at its positions (n,) [rad or m]: half smooth, half of any course."""
    q = q if revolute else q / 0.1  # a decimetre of travel as a radian
    return (1.0 - _ROUGH) * _curve(q, _LENGTHS[0]) + _ROUGH * _curve(q, _LENGTHS[-1])


def _curve(q: Array, length: float) -> Array:
    """Correlation (n, n) of a smooth periodic curve with this correlation length [rad]."""
    return np.asarray(np.exp(-2.0 * (np.sin(0.5 * (q[:, None] - q)) / length) ** 2))


def _alike(q: Array) -> Array:
    return np.exp(-0.5 * np.sum((q[:, None] - q) ** 2, axis=-1) / _ALIKE**2)


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
class NullModel:
    """Residuals, and what they scatter by while nothing has changed.

    residual: (n,). covariances: (n, n) each, for every member of the grid, with log_prior (G,). reference: the member
    that a person would take, for fits. rows: what each row is. weight: of what the stations say together, one where
    they are as many witnesses as stations. widest: the member with the largest common error of a place, -1 for none.
    """

    residual: Array
    covariances: tuple[Array, ...]
    log_prior: Array
    reference: int
    rows: RowKinds
    weight: float = 1.0
    widest: int = -1

    def whitened(self, vectors: Array) -> Array:
        """Vectors (n, …) in standard deviations of the reference."""
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.covariances[self.reference]), vectors))

    def with_more(self, columns: Array, scale: float) -> NullModel:
        """The same with a size along these columns (n, k) left open."""
        more = (scale * columns) @ (scale * columns).T
        return replace(self, covariances=tuple(V + more for V in self.covariances))

    def only(self, member: int) -> NullModel:
        """The same with one member of the grid alone."""
        return replace(self, covariances=(self.covariances[member],), log_prior=np.zeros(1), reference=0, widest=-1)

    def with_noise(self, position: float, rotation: float) -> NullModel:
        """The same with a spread that is larger by these factors."""
        extra = self.rows.extra(position, rotation)
        return replace(self, covariances=tuple(V + extra for V in self.covariances))


def null(model: Model, samples: Samples, view: RowView, drivers: Drivers, known: FrozenKnowledge) -> NullModel:
    """What these samples scatter by about this model while nothing has changed."""
    rows, chain = RowKinds.of(samples, known.noise), model.chain
    at, n = rows.sample, len(rows.sample)
    J = parameter_rows(model, view, drivers, known.parameters, known.effects)
    own = J.T @ known.covariance[: len(J), : len(J)] @ J if len(J) else np.zeros((n, n))
    turning = [(j, view.unit_column(chain.first_place + j, 5)) for j in range(chain.n) if chain.revolute[j]]
    same = (samples.station[at][:, None] == samples.station[at]).astype(float)
    each = (rows.scaled(np.outer(g, g) * same)[0] for _, g in turning)  # with equal shares of the spread
    joints, share = rows.scaled(sum(each, np.zeros((n, n))))
    alike = _alike(samples.q)[np.ix_(at, at)] * (rows.component[:, None] == rows.component)
    pattern = alike * np.sqrt(np.outer(rows.variance, rows.variance))
    count, shared = witnesses(samples), known.pattern

    def spread(part: float, common: Array) -> Array:
        return (1.0 - shared) * (np.diag(rows.variance * (1.0 - part * share)) + part * joints) + shared * common

    fine = n <= _LARGE
    members: list[tuple[Array, float]] = []  # covariance of the spread, and the logarithm of its prior
    reference, widest = 0, -1
    for factor in FACTORS if fine else FACTORS[2:3]:
        for part in JOINT_SHARES if fine else JOINT_SHARES[1:3]:
            if factor == 1.0 and part == JOINT_SHARES[1]:
                reference = len(members)
            members.append((factor**2 * spread(part, pattern), -0.5 * (np.log(factor) / _FACTOR_STD) ** 2))
    if shared > 0.0:
        usual = float(np.logaddexp.reduce([p for _, p in members]))
        plain = members[reference][0]
        curves = [
            rows.scaled(np.outer(g, g) * _curve(samples.q[:, j], length)[np.ix_(at, at)])
            for j, g in turning
            for length in _LENGTHS
        ]
        # the pattern that is left may be one joint's, as of a gear whose curve was too fine to be found
        chance = usual + np.log(_ONE_JOINT / (1.0 - _ONE_JOINT) / max(len(turning), 1))
        for curve, part_of in curves[len(_LENGTHS) - 1 :: len(_LENGTHS)]:
            members.append((spread(JOINT_SHARES[1], curve + np.diag(rows.variance * (1.0 - part_of))), chance))
        # and it is larger in some places than in others: all stations may stand in one of these
        stand = count * np.log(shared)
        if stand > _NEVER:
            widest = len(members) + len(_THERE) - 1
            for k, common in enumerate((pattern, *(curve for curve, _ in curves))):
                chance = usual + stand + np.log((0.5 / len(curves) if k else 0.5) / len(_THERE))
                members += [(plain + times * shared * common, chance) for times in _THERE]
    log_prior = np.array([p for _, p in members])
    return NullModel(
        np.concatenate([view.position.ravel(), view.rotation.ravel()]),
        tuple(own + V + np.diag(rows.known) for V, _ in members),
        log_prior - np.logaddexp.reduce(log_prior),
        reference,
        rows,
        count / samples.stations if shared > 0.0 else 1.0,
        widest,
    )


def parameter_rows(
    model: Model, view: RowView, drivers: Drivers, parameters: Sequence[ModelParameter], effects: Sequence[Effect]
) -> Array:
    """Derivatives of the predictions by what a calibration's covariance is of, (K, n)."""
    geometry = geometry_rows(view, model, parameters, np.zeros(len(parameters)))
    terms = all_columns(effects, drivers)
    return np.concatenate([geometry, *(view.moved_by(t)[None] for t in terms)]) if terms else geometry
