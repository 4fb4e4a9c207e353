"""Maximum likelihood of one kind of joint, with a latent configuration for every sample, and how well it is known.

What is minimised, over the parameters θ of the motion and the configurations a of all samples, is

    Σᵢ (ν + m) / 2 · log(1 + χᵢ² / ν) + ½ Σ ((θ − prior mean) / prior std)²,   χᵢ² = |eᵢ|² / σ_p² + |φᵢ|² / σ_r²

Student's t with ν = 4 in m = 2 (5 with rotations) dimensions across the path (Lange, Little and Taylor, JASA 1989).
Given θ, the configurations are those nearest; their share of every derivative is projected out (Kaufman's variable
projection). Scales are re-estimated in every step as in EM. The prior on radius and pitch is furniture's. The
covariance is Huber's for M-estimates, times a factor for neighbours in time whose residuals agree.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from modcal_core.articulation.joint_motion import ArticulationModel, Kind, Motion
from modcal_core.articulation.joints import JointModel, PathJoint
from modcal_core.articulation.models.registry import axis_model
from modcal_core.articulation.track import Track, one_way
from modcal_core.geometry import Array, descend

NU = 4.0  # of Student's t: the usual robust choice (Lange, Little & Taylor 1989)
_MIN = (2e-6, 2e-6)  # m, rad: no scale is smaller, so that exact data can be fitted
_STEPS = 40  # iterations
_INSIDE = 4.0  # times the expected square, beyond which a sample is an outlier: two deviations
_MIN_LAGS = 8  # samples of which an autocorrelation says anything
SOUND = 0.2  # weight of a sample that is no outlier
_ENOUGH = 1e-3  # of a log-likelihood


@dataclass(frozen=True)
class JointFit:
    """model; configurations (n,), 0 at the first sample for what has an axis; weights (n,), near 0 for an outlier.

    covariance: about an axis of ``axis`` (3, 3), ``start`` (3, 3) [m²], and where it turns ``point`` (3, 3) [m²],
    ``centre`` the same, ``pitch`` (1, 1) [(m/rad)²]; of a parametric model of each parameter (1, 1).
    sigma_position [m], sigma_rotation [rad or nan]: scatter of one sample along one axis.
    log_likelihood: of the whole track, at the best configurations. motion: what was fitted, before its start was
    chosen.
    """

    model: JointModel | PathJoint
    configurations: Array
    covariance: dict[str, Array]
    log_likelihood: float
    weights: Array
    sigma_position: float
    sigma_rotation: float
    motion: Motion = field(repr=False)

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of everything that is one number."""
        return {name: float(np.sqrt(C[0, 0])) for name, C in self.covariance.items() if C.shape == (1, 1)}


def fit(
    track: Track,
    model: Kind | ArticulationModel,
    rng: np.random.Generator | None = None,
    start: Motion | None = None,
    climbs: bool = True,
) -> JointFit:
    """The most likely joint of this type (a name: one about an axis).

    start: begin there, else with robust guesses (rng chooses their samples). climbs: else stay at the start, and find
    its scales and covariance only. Raises BadTable where a package's model gives no answer.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    of_type = axis_model(model) if isinstance(model, str) else model
    starts = [start] if start is not None else of_type.guesses(one_way(track), rng)
    best = min((climb(track, s, climbs) for s in starts), key=lambda c: c.cost)
    return _told(track, best)


@dataclass
class ClimbState:
    """A motion, the scales (m, rad) of its residuals, and what they cost together."""

    motion: Motion
    sigma: tuple[float, float]
    cost: float


def _dims(motion: Motion, m: int) -> int:
    """Dimensions of a residual that the configuration does not absorb."""
    return m - motion.moves


def _squared(e: Array, sigma: tuple[float, float]) -> Array:
    chi = (e[:, :3] ** 2).sum(axis=1) / sigma[0] ** 2
    return chi + (e[:, 3:] ** 2).sum(axis=1) / sigma[1] ** 2 if e.shape[1] == 6 else chi


def _objective(motion: Motion, e: Array, sigma: tuple[float, float]) -> float:
    d = _dims(motion, e.shape[1])
    cost = 0.5 * (NU + d) * float(np.log1p(_squared(e, sigma) / NU).sum())
    cost += len(e) * _log_scale(motion, e.shape[1], sigma)
    return cost + motion.prior_terms()[0]


def _log_scale(motion: Motion, m: int, sigma: tuple[float, float]) -> float:
    scales = (2 if motion.moves else 3) * np.log(sigma[0])
    return float(scales + (3 * np.log(sigma[1]) if m == 6 else 0.0))


def _rescaled(motion: Motion, e: Array, sigma: tuple[float, float]) -> tuple[float, float]:
    """Scales by EM: weighted mean squares, over the dimensions left."""
    d = _dims(motion, e.shape[1])
    w = (NU + d) / (NU + _squared(e, sigma))
    position = float((w * (e[:, :3] ** 2).sum(axis=1)).sum()) / (len(e) * (2 if motion.moves else 3))
    rotation = sigma[1] ** 2
    if e.shape[1] == 6:
        rotation = float((w * (e[:, 3:] ** 2).sum(axis=1)).sum()) / (len(e) * 3)
    return max(position**0.5, _MIN[0]), max(rotation**0.5, _MIN[1])


def _first_scales(e: Array) -> tuple[float, float]:
    """Scales that half of the samples keep."""
    position = float(np.median(np.linalg.norm(e[:, :3], axis=1))) / 1.18
    rotation = float(np.median(np.linalg.norm(e[:, 3:], axis=1))) / 1.54 if e.shape[1] == 6 else 1.0
    return max(position, _MIN[0]), max(rotation, _MIN[1])


def whitened(motion: Motion, track: Track, a: Array, sigma: tuple[float, float]) -> tuple[Array, Array]:
    """Residuals (n, m) over their scales, and derivatives (n, m, size) without what the configurations absorb."""
    e, by_a, J = motion.linearise(track, a)
    scale = np.array([sigma[0]] * 3 + [sigma[1]] * (e.shape[1] - 3))
    e, J = e / scale, J / scale[:, None]
    if motion.moves:
        t = by_a / scale
        t = t / np.linalg.norm(t, axis=1, keepdims=True)
        J = J - t[:, :, None] * np.einsum("nm,nmk->nk", t, J)[:, None, :]
        e = e - t * (t * e).sum(axis=1, keepdims=True)
    return e, J


def climb(track: Track, motion: Motion, climbs: bool = True) -> ClimbState:
    """Damped Gauss–Newton steps with scales re-estimated between them, until nothing changes; or the scales only."""
    sigma = (5e-3, 0.07)
    sigma = _first_scales(motion.residuals(track, motion.configurations(track, sigma)))
    last, quiet = np.inf, 0
    H = g = np.empty(0)

    def cost_of(motion: Motion) -> float:
        return _objective(motion, motion.residuals(track, motion.configurations(track, sigma)), sigma)

    def look(here: Motion) -> float:
        nonlocal sigma, H, g
        sigma = _rescaled(here, here.residuals(track, here.configurations(track, sigma)), sigma)
        if climbs:
            H, g = _normal_equations(here, track, sigma)
        return cost_of(here)

    def step(here: Motion, damping: float) -> tuple[Motion, float]:
        if not climbs:
            return here, cost_of(here)
        s = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.trace(H) * np.eye(len(H)), g)
        # no step turns a frame, or scales a radius, by more than half a radian or that share
        there = here.moved(s * min(1.0, 0.5 / max(float(np.abs(s).max()), 0.5)))
        return there, cost_of(there)

    def ended(here: Motion, gain: float, cost: float) -> bool:
        nonlocal last, quiet
        quiet = quiet + 1 if abs(last - cost) < _ENOUGH else 0
        last = cost
        return quiet >= 2

    motion = descend(motion, look, step, ended, _STEPS).place
    return ClimbState(motion, sigma, cost_of(motion))


def _normal_equations(motion: Motion, track: Track, sigma: tuple[float, float]) -> tuple[Array, Array]:
    """Curvature (size, size) and gradient (size,) of the objective by the parameters of the motion."""
    a = motion.configurations(track, sigma)
    z, J = whitened(motion, track, a, sigma)
    w = (NU + _dims(motion, z.shape[1])) / (NU + _squared(motion.residuals(track, a), sigma))
    flat = J.reshape(-1, motion.size)
    H, g = (np.repeat(w, z.shape[1])[:, None] * flat).T @ flat, flat.T @ (w[:, None] * z).ravel()
    _, gp, hp = motion.prior_terms()
    return H + np.diag(hp), g + gp


def _told(track: Track, state: ClimbState) -> JointFit:
    """What a climb comes to: configurations, scales, weights and covariance."""
    from scipy.special import gammaln

    motion, sigma = state.motion, state.sigma
    a = motion.configurations(track, sigma)
    z, J = whitened(motion, track, a, sigma)
    d = _dims(motion, z.shape[1])
    chi = (z**2).sum(axis=1)
    w = (NU + d) / (NU + chi)
    # logarithm of the density of Student's t in d dimensions at its middle
    constant = float(gammaln(0.5 * (NU + d)) - gammaln(0.5 * NU) - 0.5 * d * np.log(NU * np.pi))
    log_likelihood = motion.prior_terms()[0] - state.cost + len(z) * constant
    # what makes of a scale of Student's t the standard deviation of samples that are no outliers
    inside = chi < _INSIDE * d
    spread = float(np.sqrt(chi[inside].sum() / (d * inside.sum()))) if inside.any() else 1.0
    rotation = sigma[1] * spread if z.shape[1] == 6 else np.nan
    weights = np.minimum(w * NU / (NU + d), 1.0)
    first = motion.zero(a)
    return JointFit(
        model=motion.joint(first),
        configurations=motion.counted(a - first, weights > SOUND),
        covariance=motion.covariance(_covariance(motion, z, J, w, d)),
        log_likelihood=float(log_likelihood),
        weights=weights,
        sigma_position=sigma[0] * spread,
        sigma_rotation=rotation,
        motion=motion,
    )


def _covariance(motion: Motion, z: Array, J: Array, w: Array, d: int) -> Array:
    n = len(z)
    chi = (z**2).sum(axis=1)
    flat = J.reshape(-1, motion.size)
    free = max(n * d - motion.size, 1)
    scatter = float((w**2 * chi).sum()) / free
    slope = float((w - 2.0 * w**2 * chi / ((NU + d) * d)).mean())
    information = flat.T @ flat * (slope**2 / max(scatter, 1e-12) / _agreement(z * w[:, None]))
    information = information + np.diag(motion.prior_terms()[2])
    return np.asarray(np.linalg.pinv(information, rcond=1e-14, hermitian=True), dtype=float)


def _agreement(z: Array) -> float:
    """How many samples count as one: 1 + 2 Σ autocorrelation of residuals over time, while it is positive.

    Geyer's initial positive sequence (Statistical Science 1992): pairs of lags, as far as both together are above zero.
    """
    n = len(z)
    power = float((z * z).sum())
    if power <= 0.0 or n < _MIN_LAGS:
        return 1.0
    # Residuals of a fit lean to negative correlation by about parameters / n, which no one needs to correct.
    rho = np.array([1.0] + [float((z[k:] * z[:-k]).sum()) / power for k in range(1, min(n // 2, 200))])
    total = -1.0
    for k in range(0, len(rho) - 1, 2):
        pair = rho[k] + rho[k + 1]
        if pair <= 0.0 or (k > 0 and pair < 2.0 / np.sqrt(n)):
            break
        total += 2.0 * pair
    return max(total, 1.0)
