"""How large the residuals are, and how much each one counts.

Every reading has its own scatter (known from the dwell, or not), and on top of it the arm misses by an amount that no
reading knows: gears, repeatability. The variance of a residual is ``s² + σ_i²``, with one s for positions and one for
orientations, found so that the weighted sum of squares equals the degrees of freedom (Paule & Mandel 1982). A sample
far outside, judged by its whole residual against a χ² law, counts less (Huber) and beyond a limit not at all.

Written on ``scipy.special``: ``scipy.stats`` takes longer to import than most questions take to answer. SciPy loads
what is named after it when that is first used, so what only reads a calibration does without.

The sum of the residuals of a stop is as large as it is by chance where they are independent, and as many times larger
in square as they are where all are the same (the design effect; Kish 1965, *Survey sampling*, section 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import cbrt, sqrt

import numpy as np
import scipy

from modcal_core.calibration.data_split import independent_unit
from modcal_core.calibration.linearisation import Linearised, RowView
from modcal_core.calibration.model import Model
from modcal_core.geometry import Array, so3
from modcal_core.measurements import SAME, Samples
from modcal_core.measurements.kinds import indirect_rows, kinds

# --- How likely noise is to do as much: the tails of the distributions that evidence is weighed with


def beyond_normal(z: float) -> float:
    """The chance that a standard normal number is greater than z."""
    return float(scipy.special.ndtr(-z))


def beyond_chi2(x: float, freedom: int) -> float:
    """Survival function of the chi-square distribution: the chance of a value greater than x."""
    return float(scipy.special.chdtrc(freedom, x))


def as_normal(square: float, freedom: int) -> float:
    """Two-sided standard normal quantile with the same chance as a chi-square value."""
    chance = beyond_chi2(square, freedom)
    return float(-scipy.special.ndtri(0.5 * chance)) if chance > 1e-300 else float(np.sqrt(square))


def median_chi2(freedom: int) -> float:
    """Median of the chi-square distribution."""
    return float(2.0 * scipy.special.gammaincinv(0.5 * freedom, 0.5))


def quantile_chi2(share: float, freedom: float) -> float:
    """Quantile of the chi-square distribution: stays below it with probability ``share``."""
    return float(2.0 * scipy.special.gammaincinv(0.5 * freedom, share))


def exceeded_chi2(chance: float, freedom: int) -> float:
    """Quantile of the chi-square distribution that is exceeded with a probability, which may be tiny."""
    return float(scipy.special.chdtri(freedom, chance))


def log10_beyond_f(x: Array, m: int, freedom: int) -> Array:
    """log10 of the chance that a ratio of mean squares, over m and over freedom numbers, is greater than x."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log10(scipy.special.fdtrc(m, freedom, x)))


def gumbel_of(x: Array) -> tuple[float, float]:
    """(location, scale) of the law of largest values that makes these numbers (n,) most likely; they must differ.

    The scale s solves s = x̄ − Σ x e^(−x/s) / Σ e^(−x/s), whose two sides cross once; then the location is
    −s log mean e^(−x/s) (Johnson, Kotz, Balakrishnan, Continuous Univariate Distributions 2, ch. 22).
    """
    mean, y = float(x.mean()), x - float(x.min())

    def excess(s: float) -> float:
        w = np.exp(-y / s)
        return s - mean + float((x * w).sum() / w.sum())

    low, high = 1e-6 * float(y.max()), float(y.max())
    while high - low > 1e-13 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) < 0.0 else (low, middle)
    scale = 0.5 * (low + high)
    return float(x.min()) - scale * float(np.log(np.mean(np.exp(-y / scale)))), scale


def beyond_gumbel(x: float, location: float, scale: float) -> float:
    """The chance that a number of this law of largest values is greater than x."""
    return float(-np.expm1(-np.exp(-(x - location) / scale)))


HUBER_Z = 2.5  # standard scores; a Gaussian sample passes this once in 160
REJECT_Z = 6.0  # standard scores; a Gaussian sample passes this once in 10⁹, so what is rejected is no noise
_FLOOR = 1e-9  # m or rad; exact data must not divide by zero
# m or rad; what instruments usually leave. It counts as much as a fit takes up of an equation: one that follows the few
# readings of a kind leaves nothing of them, which says nothing of their noise
_USUAL = 5e-5
# times the finest kind's noise, at most: draw wires beside a tracker. A kind that is off by more is none that a fit may
# leave aside because it does not follow it yet
_COARSER = 20.0


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviations that no reading explains, per axis: position [m], rotation [rad], and of readings that are
    no positions, by kind and in its unit.
    """

    position: float
    rotation: float
    others: dict[str, float] = field(default_factory=dict)

    def of(self, samples: Samples) -> Array | float:
        """Noise (N,) of each sample's position or scalar reading, or one number for all."""
        if not self.others:
            return self.position
        out = np.full(len(samples), self.position)
        for kind, size in self.others.items():
            out[samples.kind == kind] = size
        return out


@dataclass(frozen=True)
class Groups:
    """Samples by what shares its noise. positions: rows (or all). others: rows by kind, of those that are no positions.
    dimensions: directions in which each sample sees, (N,). pose: whether it has an orientation, (N,). known_position,
    known_rotation: what readings know of their own scatter, zero where they do not, (N,) and (M,).
    """

    positions: np.ndarray | slice
    others: dict[str, np.ndarray]
    dimensions: Array
    pose: np.ndarray
    known_position: Array
    known_rotation: Array

    @classmethod
    def of(cls, samples: Samples, mixed: bool) -> Groups:
        """The groups of these samples. mixed: whether there may be readings that are no positions."""
        pose, dimensions = samples.is_pose, np.where(samples.is_pose, 6.0, 3.0)
        known = pose, known_sigma(samples.sigma_position), known_sigma(samples.sigma_rotation[pose])
        if not mixed or not (indirect := indirect_rows(samples)).any():
            return cls(slice(None), {}, dimensions, *known)
        others = {}
        for name in np.unique(samples.kind[indirect]).tolist():
            others[name] = np.flatnonzero(samples.kind == name)
            dimensions[others[name]] = kinds()[name].dimensions
        return cls(np.flatnonzero(~indirect), others, dimensions, *known)

    @cached_property
    def rows(self) -> float:
        """Equations that the samples give."""
        return float(self.dimensions.sum())


def robust_noise(position: Array, rotation: Array, groups: Groups | None = None, spent: float = 0.0) -> NoiseModel:
    """The noise of residuals (3, N) and (3, M) by their medians: half of the samples may be wrong. spent: degrees of
    freedom that each row gave up.
    """

    def one(r: Array, dimensions: int = 3) -> float:
        if not r.size:
            return _FLOOR
        square, n = float(np.median(np.einsum("ij,ij->j", r, r))) / median_chi2(dimensions), dimensions * r.shape[1]
        freedom = max(n * (1.0 - spent), 1.0) + spent
        return max(float(np.sqrt((n * square + spent * _USUAL**2) / freedom)), _FLOOR)

    if groups is None or not groups.others:
        return NoiseModel(one(position), one(rotation))
    others = {name: one(position[:, rows], kinds()[name].dimensions) for name, rows in groups.others.items()}
    return NoiseModel(one(position[:, groups.positions]), one(rotation), others)


def excess_sigma(square: Array, known: Array, weight: Array, lost: float, dimensions: int = 3) -> float:
    """s for squares (N,) of residuals with known deviations (N,) and robust weights (N,), ``lost`` degrees of freedom
    spent.
    """
    if not square.size:
        return _FLOOR
    spent = lost / (dimensions * len(square))
    freedom = max(dimensions * float(weight.sum()) - lost, 1.0) + spent
    square, known, weight = np.append(square, _USUAL**2), np.append(known, 0.0), np.append(weight, spent)
    s2 = float(weight @ square) / freedom
    if not known.any():
        return max(float(np.sqrt(s2)), _FLOOR)
    # the sum falls monotonically in s², and is convex: Newton's steps end at its root. From above they can pass zero,
    # where the sum is infinite: they must stay above it.
    for _ in range(100):
        v = s2 + known**2
        miss = float((weight * square / v).sum()) - freedom
        slope = -float((weight * square / v**2).sum())
        new = max(s2 - miss / slope, 0.1 * s2, _FLOOR**2) if slope else 0.0
        if abs(new - s2) <= 1e-12 * max(s2, _FLOOR**2):
            break
        s2 = new
    return max(float(np.sqrt(s2)), _FLOOR)


def standard_score(square: Array | float, dimensions: Array | float) -> Array:
    """Approximate standard scores of χ² values (N,) with these degrees of freedom (N,) (Wilson & Hilferty 1931)."""
    c = 2.0 / (9.0 * dimensions)
    return np.asarray((np.cbrt(square / dimensions) - (1.0 - c)) / np.sqrt(c))


def score_of_one(square: float, dimensions: int) -> float:
    """:func:`standard_score` of a single χ² value, without arrays: where samples come one by one."""
    c = 2.0 / (9.0 * dimensions)
    return (cbrt(square / dimensions) - (1.0 - c)) / sqrt(c)


def robust_weights(z: Array, limit: float = REJECT_Z) -> Array:
    """Weights in [0, 1] for standard scores: 1 inside, falling as 1/z, then 0 beyond the limit: a rejected sample."""
    w = np.minimum(1.0, HUBER_Z / np.maximum(z, HUBER_Z))
    return np.where(z > limit, 0.0, w)


# --- How much each sample, and each row of its equations, counts in a fit


def known_sigma(sigma: Array) -> Array:
    """What readings know of their own scatter; zero where they do not, (N,)."""
    return np.where(np.isfinite(sigma), sigma, 0.0)


def weigh(
    at: Linearised, groups: Groups, parameters: float, limit: float | None, barred: np.ndarray | None = None
) -> tuple[Array, NoiseModel]:
    """Robust weights of the samples and the spread left, at these residuals.

    parameters: numbers that the samples have told. limit: standard score beyond which a sample is rejected; None: all
    count alike. barred: samples without any weight.
    """
    square_p, square_r = at.square_position, at.square_rotation
    known_p, known_r, pose = groups.known_position, groups.known_rotation, groups.pose
    weights = np.ones(len(square_p))
    each = parameters / groups.rows  # degrees of freedom that a row gives up
    if limit is not None:
        rough = robust_noise(at.position, at.rotation, groups, each)
        total = square_p / (rough.position**2 + known_p**2)
        for kind, of_kind in groups.others.items():
            total[of_kind] = square_p[of_kind] / (rough.others[kind] ** 2 + known_p[of_kind] ** 2)
        if len(square_r):
            total[pose] += square_r / (rough.rotation**2 + known_r**2)
        weights = robust_weights(standard_score(total, groups.dimensions), limit)
        weights = weights if barred is None else np.where(barred, 0.0, weights)

    def left(rows: np.ndarray | slice, directions: int) -> float:
        seen = square_p[rows]
        return excess_sigma(seen, known_p[rows], weights[rows], each * directions * len(seen), directions)

    position = left(groups.positions, 3)
    others = {kind: left(rows, kinds()[kind].dimensions) for kind, rows in groups.others.items()}
    if others:
        sizes = [*others.values(), *([position] if len(square_p[groups.positions]) else [])]
        most = _COARSER * max(min(sizes), _USUAL)
        position, others = min(position, most), {kind: min(size, most) for kind, size in others.items()}
    turned = excess_sigma(square_r, known_r, weights[pose], each * 3.0 * len(square_r))
    return weights, NoiseModel(position, turned, others)


def row_weights(weights: Array, noise: NoiseModel, samples: Samples) -> Array:
    """Weight of each row of a linearisation, (3 N + 3 M,), of samples with these robust weights (N,)."""
    pose = samples.is_pose
    w_p = weights / (noise.of(samples) ** 2 + known_sigma(samples.sigma_position) ** 2)
    w_r = weights[pose] / (noise.rotation**2 + known_sigma(samples.sigma_rotation[pose]) ** 2)
    return np.concatenate([w_p, w_p, w_p, w_r, w_r, w_r])


# --- Readings of one stop share what the arm does not repeat: they tell of the parameters what fewer readings would


def has_shared_noise(samples: Samples) -> bool:
    """Whether some stop was read twice or more. In motion noise is another matter."""
    if samples.moving.any() or len(samples) < 2:
        return False
    q = samples.q[np.argsort(samples.stamps, kind="stable")]
    return bool((np.abs(np.diff(q, axis=0)).max(axis=1) <= SAME).any())


def shared_noise(samples: Samples, left: Linearised, row_weight: Array) -> float:
    """How many times more samples there are than independent ones, 1 or more, by what a fit leaves of them.

    row_weight: (3 N + 3 M,).
    """
    unit, N = independent_unit(samples), len(samples)
    weighed = left.residual * np.sqrt(row_weight)
    position, rotation = weighed[: 3 * N].reshape(3, -1), weighed[3 * N :].reshape(3, -1)
    square = float(weighed @ weighed)
    together = sum(
        float(np.sum(np.bincount(of, component) ** 2))
        for of, components in ((unit, position), (unit[samples.is_pose], rotation))
        for component in components
        if len(component)
    )
    return max(together / square, 1.0) if square > 0.0 else 1.0


# --- How far a model misses: sizes of position and orientation errors on given samples

FINEST = 2e-6  # m and rad; no instrument resolves less, so nothing is called wrong by less


@dataclass(frozen=True)
class ErrorSize:
    """Mean, root mean square, 95th percentile and largest of error norms, in the unit of the norms."""

    mean: float
    rms: float
    p95: float
    max: float

    @classmethod
    def of(cls, norms: Array) -> ErrorSize | None:
        """Sizes of these norms (N,), or None when there are none."""
        if not len(norms):
            return None
        rms = float(np.sqrt(np.mean(norms**2)))
        return cls(float(norms.mean()), rms, float(np.percentile(norms, 95)), float(norms.max()))


@dataclass(frozen=True)
class Errors:
    """Errors of samples: position (N, 3) [m] in each reading's frame, rotation (M, 3) [rad] of the M pose samples.

    Of a reading that is no position it is the miss at the tool along what the reading shows, from the root. lever:
    metres at the tool per unit of the reading, (N,); None where all are positions.
    """

    position: Array
    rotation: Array
    lever: Array | None = None

    @property
    def position_norm(self) -> Array:
        """Distances [m], (N,)."""
        return np.linalg.norm(self.position, axis=1)

    @property
    def reading_norm(self) -> Array:
        """Sizes in the unit that each reading's noise is in, (N,)."""
        return self.position_norm if self.lever is None else self.position_norm / self.lever

    @property
    def rotation_norm(self) -> Array:
        """Angles [rad], (M,)."""
        return np.linalg.norm(self.rotation, axis=1)

    def size_mm(self) -> ErrorSize | None:
        """Sizes of the position errors [mm]."""
        return ErrorSize.of(1e3 * self.position_norm)

    def size_deg(self) -> ErrorSize | None:
        """Sizes of the orientation errors [deg]; None where nothing had an orientation."""
        return ErrorSize.of(np.degrees(self.rotation_norm))


def errors(model: Model, samples: Samples) -> Errors:
    """Measured minus predicted, for every sample."""
    T = model.predict_samples(samples)
    pose = samples.is_pose
    rotation = so3.log(samples.R[pose] @ np.swapaxes(T[pose, :3, :3], -1, -2))
    gap, lever = samples.reading - T[:, :3, 3], None
    if model.instruments:
        sights = RowView.of(model, samples, model.drivers(samples)).sights
        if sights is not None:
            lever = sights.lever
            gap[sights.rows] = (sights.residual * lever[sights.rows]).T
    return Errors(gap, rotation, lever)


def usual_miss(model: Model, samples: Samples) -> float:
    """Median distance [m] by which a model misses samples."""
    return float(np.median(errors(model, samples).position_norm))


def outlying(model: Model, noise: NoiseModel, samples: Samples) -> np.ndarray:
    """True for samples so far outside this noise that a fit would have rejected them, (N,)."""
    size = squared_residuals(errors(model, samples), samples, noise, FINEST)
    return standard_score(size, Groups.of(samples, bool(model.instruments)).dimensions) > REJECT_Z


def typical_scatter(samples: Samples) -> tuple[float, float]:
    """Median deviation of the readings' positions [m, or the kind's unit] and orientations [rad]; 0 where unknown."""
    known = (samples.sigma_position, samples.sigma_rotation[samples.is_pose])
    position, rotation = (float(np.median(s[np.isfinite(s)])) if np.isfinite(s).any() else 0.0 for s in known)
    return position, rotation


def squared_residuals(e: Errors, samples: Samples, noise: NoiseModel, finest: float = 0.0) -> Array:
    """Squares of each sample's error, (N,), in variances: of this noise, no less than the finest, and of the reading's
    own scatter.
    """
    known_p = np.nan_to_num(samples.sigma_position)
    total = e.reading_norm**2 / (np.maximum(noise.of(samples), finest) ** 2 + known_p**2)
    pose = samples.is_pose
    if pose.any():
        known_r = np.nan_to_num(samples.sigma_rotation[pose])
        total[pose] += e.rotation_norm**2 / (max(noise.rotation, finest) ** 2 + known_r**2)
    return total
