"""How far readings may lie from a frozen model while nothing has changed; how much more probable a change makes them.

The null has four parts: what the calibration does not know of its own parameters, seen at these postures (``J Σ Jᵀ``);
the spread that the calibration found and could not explain; what each reading states of itself; and, where the
calibration's verdict left a pattern, a share of the spread that neighbouring postures have in common and that no number
of stations averages away. How the spread divides between the instrument and joints that repeat imperfectly is not known
from its size alone, and neither is the size to a few per cent: a small grid of both is kept, each with its prior
probability.

A change of unknown size has a prior of its own: sizes along its columns as large as make the readings move by τ
standard deviations of their noise, τ from one half to a thousand, each factor of two alike (Zellner 1986 for the
columns' own metric). So a change of six directions pays for them, and none pays for the units it is written in.

The mean over all changes, with their prior probabilities, of how much more probable they make the readings is an
*e-value*: while nothing has changed it exceeds 1/α with a chance of at most α, whatever the number of changes that are
looked for and however alike they are (Markov's inequality; Vovk & Wang 2021).

Errors of stations close to one another are alike, in ways that no model of theirs has in full: ten neighbours are not
ten witnesses. How many they stand for is ``m = n² / Σ ρ_ij`` with ρ the correlation by their postures: that many
independent values have a mean as well known. What n stations say together is raised to the power m/n: an e-value to a
power below one is one as well (Jensen's inequality), and of neighbours more is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from modcal_core.calibration import FINEST, Model, ModelParameter, NoiseModel, RowView, geometry_rows
from modcal_core.effects import Drivers, Effect, all_columns
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.moves.rows import NOISE, READING, CellChange

_ALIKE = 0.6  # rad or m, over all joints: postures this far apart share 61 % of a pattern
_ROUGH = 0.5  # share of such a curve that changes from station to station, as the many waves of a gear do
_MEAN = 0.1  # share of a curve's square that is one number everywhere: few stations see the mean of a wave as well
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
SIZES = 2.0 ** np.arange(-1.0, 11.0)  # standard deviations of the noise, RMS over the readings
_RANK = 1e-10  # of the largest square; directions below it are not seen at these postures
_NOISIER = (1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0)  # factors of a spread that grew


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


def curve_root(joint: int, model: Model, samples: Samples) -> Array:
    """A root (S, r) of the covariance of one joint's curve at the S stations: random sums of its columns are curves of
    the joint's position, half smooth, half of any course.

    A curve that hardly varies is a joint's zero, which is plainer.
    """
    first = np.unique(samples.station, return_index=True)[1]
    q = samples.q[first, joint] / (1.0 if model.chain.revolute[joint] else 0.1)  # a decimetre of travel as a radian
    course = (1.0 - _ROUGH) * _curve(q, _LENGTHS[0]) + _ROUGH * _curve(q, _LENGTHS[-1])
    values, vectors = np.linalg.eigh((1.0 - _MEAN) * course + _MEAN)
    kept = values > 1e-9
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def _curve(q: Array, length: float) -> Array:
    """Correlation (n, n) of a smooth periodic curve with this correlation length [rad]."""
    return np.asarray(np.exp(-2.0 * (np.sin(0.5 * (q[:, None] - q)) / length) ** 2))


def _alike(q: Array) -> Array:
    return np.exp(-0.5 * np.sum((q[:, None] - q) ** 2, axis=-1) / _ALIKE**2)


@dataclass(frozen=True)
class FrozenKnowledge:
    """What a calibration knows of itself. noise: spread of single readings. parameters: of the geometry. covariance:
    (K, K), of them and then of the values of the effects. pattern: share of the noise's variance that postures share.
    """

    noise: NoiseModel
    parameters: tuple[ModelParameter, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    effects: tuple[Effect, ...] = ()
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

    def wider(self, covariance: Array) -> NullModel:
        """The same with more covariance (n, n)."""
        return replace(self, covariances=tuple(V + covariance for V in self.covariances))

    def only(self, member: int) -> NullModel:
        """The same with one member of the grid alone."""
        return replace(self, covariances=(self.covariances[member],), log_prior=np.zeros(1), reference=0, widest=-1)


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
    factors, parts = (FACTORS, JOINT_SHARES) if fine else (FACTORS[2:3], JOINT_SHARES[1:3])
    grid = [(factor, part) for factor in factors for part in parts]
    # covariances of the spread, and the logarithms of their priors
    members = [(f**2 * spread(part, pattern), -0.5 * (np.log(f) / _FACTOR_STD) ** 2) for f, part in grid]
    reference, widest = grid.index((1.0, JOINT_SHARES[1])), -1
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
        view.residual,
        tuple(own + V + np.diag(rows.known) for V, _ in members),
        log_prior - np.logaddexp.reduce(log_prior),
        reference,
        rows,
        count / samples.stations if shared > 0.0 else 1.0,
        widest,
    )


def parameter_rows(
    model: Model, view: RowView, drivers: Drivers, parameters: Sequence[ModelParameter], effects: Sequence[Effect] = ()
) -> Array:
    """Derivatives of the predictions by what a calibration's covariance is of, (K, n)."""
    geometry = geometry_rows(view, model, parameters, np.zeros(len(parameters)))
    return np.concatenate([geometry, *(view.moved_by(terms)[None] for terms in all_columns(effects, drivers))])


@dataclass(frozen=True)
class ChangeCandidate:
    """A change fitted to the readings. residual: what it leaves, (n,). columns: its derivatives there, (n, k); of a
    free curve those that its random sums are of. sizes: that were put in.
    """

    hypothesis: CellChange
    residual: Array
    columns: Array
    sizes: Array = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class JudgedChange:
    """A change and what speaks for it. log_factor: logarithm of its Bayes factor against no change. likelihood: the
    largest logarithm of the likelihood, its sizes at their best. size: the τ that suits it best. noise: by which
    factors position and orientation scatter more.
    """

    hypothesis: CellChange
    log_factor: float
    likelihood: float
    size: float
    noise: tuple[float, float] = (1.0, 1.0)

    @property
    def is_noise(self) -> bool:
        """Whether it is the readings that scatter more."""
        return self.hypothesis.kind == NOISE


class ChangeJudge:
    """What one null says of candidates: its covariances are factored once."""

    def __init__(self, null: NullModel) -> None:
        self.null = null
        factors = np.linalg.cholesky(np.stack(null.covariances))
        self._half_logdet = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
        self._whiten = np.stack([scipy.linalg.lapack.dtrtri(L, lower=1)[0] for L in factors])
        self._z = self._whiten @ null.residual
        self._square = np.sum(self._z**2, axis=1)
        self._each = null.log_prior - self._half_logdet - 0.5 * self._square
        self.log_null = float(np.logaddexp.reduce(self._each))
        self.best = int(np.argmax(self._each))

    @property
    def square(self) -> float:
        """Squared residuals in variances, at the noise that suits them best."""
        return float(self._square[self.best])

    def whitened(self, vectors: Array, member: int) -> Array:
        """Vectors (n, …) in standard deviations of one member of the grid."""
        return np.asarray(self._whiten[member] @ vectors)

    def judged(self, candidate: ChangeCandidate) -> JudgedChange:
        """The Bayes factor of one candidate, over all members of the grid and sizes."""
        h, columns = candidate.hypothesis, candidate.columns
        if h.kind == READING:  # single rows, each by itself: no product is needed
            A = self._whiten[:, :, np.argmax(columns, axis=0)]
        else:  # of whatever length, but for sums of a curve
            A = self._whiten @ (columns if h.free else columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))
        z = self._z if candidate.residual is self.null.residual else self._whiten @ candidate.residual
        squares, vectors = np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)  # (G, k), (G, k, k)
        kept = squares > _RANK * squares.max(axis=1, keepdims=True, initial=1e-300)
        along = (np.swapaxes(vectors, 1, 2) @ (np.swapaxes(A, 1, 2) @ z[..., None]))[..., 0]
        seen = np.where(kept, along**2 / np.where(kept, squares, 1.0), 0.0)  # of z, along each direction
        square = np.sum(z**2, axis=1)  # about the sizes of a large change another one than without it
        weight = np.where(kept, squares, 0.0) if h.free else kept  # sums of a curve have sizes of their own
        spread = weight * (len(self.null.residual) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300))
        spread = SIZES[:, None, None] ** 2 * spread  # (12, G, k)
        share = spread / (1.0 + spread)
        most = share.max(axis=2, initial=0.0)
        bent = np.maximum(self._square - square, -seen.sum(axis=1))
        each = self._each + 0.5 * (most * bent + (share * seen).sum(axis=2) - np.log1p(spread).sum(axis=2))
        factor = float(np.logaddexp.reduce(each, axis=None)) - np.log(len(SIZES)) - self.log_null
        left = square - ((2.0 * share - share**2 if h.free else np.ones_like(share)) * seen).sum(axis=2)
        likely = float((self.null.log_prior - self._half_logdet - 0.5 * left).max())
        return JudgedChange(h, factor, likely, float(SIZES[np.unravel_index(int(np.argmax(each)), each.shape)[0]]))

    def noisier(self, hypothesis: CellChange) -> JudgedChange:
        """The Bayes factor of readings that scatter more, in position, orientation, or both."""
        turned = bool((self.null.rows.component >= 3).any())
        pairs = [(a, b) for a in _NOISIER for b in (_NOISIER if turned else (1.0,)) if max(a, b) > 1.0]
        if len(self.null.residual) > _LARGE:
            pairs = [(a, b) for a, b in pairs if a == b or min(a, b) == 1.0]
        logs = []
        for pair in pairs:
            L = np.linalg.cholesky(self.null.covariances[self.null.reference] + self.null.rows.extra(*pair))
            z = scipy.linalg.solve_triangular(L, self.null.residual, lower=True)
            logs.append(-float(np.log(np.diag(L)).sum() + 0.5 * z @ z))
        factor = float(np.logaddexp.reduce(logs)) - np.log(len(logs)) - self.log_null
        at = int(np.argmax(logs))
        return JudgedChange(hypothesis, factor, logs[at], 1.0, pairs[at])


def e_value(judged: Sequence[JudgedChange], log_prior: Array, weight: float = 1.0) -> float:
    """Logarithm of the mean Bayes factor over all changes, raised to the stations' weight."""
    return weight * float(np.logaddexp.reduce([j.log_factor for j in judged] + log_prior))


def by_name(
    judged: Sequence[JudgedChange], log_prior: Array, weight: float
) -> dict[tuple[str, str], tuple[float, JudgedChange]]:
    """What can be named: its probability, one of them being the case, and its most probable shape."""
    each = weight * np.array([j.log_factor for j in judged]) + log_prior
    out: dict[tuple[str, str], tuple[float, JudgedChange]] = {}
    for j, p in zip(judged, np.exp(each - np.logaddexp.reduce(each)), strict=True):
        so_far, top = out.get(j.hypothesis.key, (0.0, j))
        out[j.hypothesis.key] = so_far + float(p), top if top.log_factor > j.log_factor else j
    return out


def most_probable(judged: Sequence[JudgedChange], log_prior: Array, weight: float = 1.0) -> JudgedChange:
    """The most probable thing to name, by its most probable shape. weight: of what the stations say."""
    return max(by_name(judged, log_prior, weight).values(), key=lambda pair: pair[0])[1]
