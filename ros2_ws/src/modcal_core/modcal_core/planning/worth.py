"""What each candidate would be worth beside the stations that are chosen, kept up as these come and go.

A station k that is added (+) or taken out (−) changes P = H⁻¹ by a matrix of rank c, its c readings:

    P± = P ∓ U M Uᵀ,      U = P J_kᵀ,      M = (1 ± J_k P J_kᵀ)⁻¹

What a candidate j is worth hangs on S_j = 1 + J_j P J_jᵀ and, for accuracy, G_j = J_j P Γ P J_jᵀ alone, which change
with A_j = J_j U and B_j = J_j P Γ U:

    S_j± = S_j ∓ A_j M A_jᵀ,      G_j± = G_j ∓ A_j M B_jᵀ ∓ B_j M A_jᵀ + A_j M (Uᵀ Γ U) M A_jᵀ

(Sherman, Morrison & Woodbury). So a change costs one product of all candidates' rows with 2 c columns, in place of two
with all P parameters.

The parameters, their derivatives and the weights are those of ``modcal calibrate``: one weight a reading from its own
scatter and from what the arm does not repeat. The noise itself is not that simple, for a joint that does not repeat
moves the tool along its own arc; so the covariance that the fit will really have is kept beside,

    C = A (Σ_i J_iᵀ W_i R_i W_i J_i + Λ) A,    A = (Σ_i J_iᵀ W_i J_i + Λ)⁻¹,    R_i = σ_i² 1 + J_q Σ_q J_qᵀ

with Λ the prior, which takes the arm to be as far from its drawing as robots are.

What is left of the position error, in a posture with derivatives G, is ``G θ`` with θ of the covariance that the fit
has, and on top of it what the joints do not repeat. Sizes are over postures of the workspace and over what the noise
may turn out to be; the noise of the tracker itself is not part of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import Model, ModelParameter, RowView, exact_samples, geometry_rows
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.planning.criteria import Criterion
from modcal_core.planning.site import Noise

# --- What each station would tell: the rows that it adds to the normal equations of the calibration, and its noise


@dataclass(frozen=True)
class StationRows:
    """N stations with c numbers read at each: 3 of a point, 6 of a pose.

    J: derivatives times the prior's standard deviations, over the readings' that the fit supposes, (N, c, P). noise:
    the true covariance of the readings in the same units, (N, c, c). scale: the prior's standard deviations, (P,)
    [m, rad]. unrepeated: mean square of the distance [m²] by which the joints do not repeat, (N,). joint_variance: what
    variance the fit adds to each reading's own for it, (c,) [m², rad²].
    """

    J: Array
    noise: Array
    scale: Array
    unrepeated: Array
    joint_variance: Array

    def of(self, chosen: np.ndarray) -> StationRows:
        """These stations alone."""
        return replace(self, J=self.J[chosen], noise=self.noise[chosen], unrepeated=self.unrepeated[chosen])

    def joined(self, other: StationRows) -> StationRows:
        """These stations and others of the same fit."""
        return replace(
            self,
            J=np.concatenate([self.J, other.J]),
            noise=np.concatenate([self.noise, other.noise]),
            unrepeated=np.concatenate([self.unrepeated, other.unrepeated]),
        )

    def __len__(self) -> int:
        return len(self.J)

    def information(self, chosen: np.ndarray | Sequence[int]) -> Array:
        """JᵀWJ of these stations, parameters in units of their priors, (P, P)."""
        J = self.J[chosen].reshape(-1, self.J.shape[2])
        return J.T @ J

    def covariance(self, chosen: np.ndarray | Sequence[int]) -> Array:
        """Covariance (P, P) of the parameters, in units of their priors, that a fit to these stations will have."""
        J, R = self.J[chosen], self.noise[chosen]
        eye = np.eye(J.shape[2])
        A = np.linalg.inv(self.information(chosen) + eye)
        out = A @ (np.einsum("ncp,ncd,ndr->pr", J, R, J, optimize=True) + eye) @ A
        return np.asarray(0.5 * (out + out.T))


def station_rows(
    model: Model,
    parameters: Sequence[ModelParameter],
    q: Array,
    kind: str,
    noise: Noise,
    joint_variance: Array | None = None,
) -> StationRows:
    """The rows of stations at postures q (N, n) [rad, m], read as points or poses through the model's one frame.

    joint_variance: that of other stations of the same fit; that of these where it is not given.
    """
    samples, J, Jq = _seen(model, parameters, q, kind, noise)
    N = len(q)
    unrepeated = np.sum(Jq[:, :3] ** 2, axis=(1, 2))
    distance = np.linalg.norm(samples.reading, axis=1)
    read = np.full((N, J.shape[1]), noise.rotation)
    read[:, :3] = (noise.position + noise.per_metre * distance)[:, None]
    # as a fit finds it: one number for all stations
    if joint_variance is None:
        joint_variance = np.repeat(np.mean(np.sum(Jq**2, axis=2).reshape(N, -1, 3), axis=(0, 2)), 3)
    weight = 1.0 / np.sqrt(read**2 + joint_variance)
    R = Jq @ Jq.transpose(0, 2, 1)
    R[:, np.arange(J.shape[1]), np.arange(J.shape[1])] += read**2
    scale = np.array([p.prior_std for p in parameters])
    return StationRows(
        J * weight[..., None], R * weight[:, :, None] * weight[:, None, :], scale, unrepeated, joint_variance
    )


def position_rows(model: Model, parameters: Sequence[ModelParameter], q: Array, noise: Noise) -> tuple[Array, Array]:
    """Derivatives of the target's position (N, 3, P) [m] per prior deviation, and unrepeated mean squares (N,) [m²]."""
    _, G, Jq = _seen(model, parameters, q, "point", noise)
    return G, np.sum(Jq**2, axis=(1, 2))


def _seen(
    model: Model, parameters: Sequence[ModelParameter], q: Array, kind: str, noise: Noise
) -> tuple[Samples, Array, Array]:
    """Exact samples, and the derivatives of their readings by parameters, (N, c, P) per prior deviation, and by joints,
    (N, c, n) per deviation of what these do not repeat.
    """
    N, n = q.shape
    samples = exact_samples(model, q, np.zeros(N, dtype=int), np.full(N, kind, dtype=KIND_NAMES))
    view = RowView.of(model, samples, model.drivers(samples))
    scale = np.array([p.prior_std for p in parameters])
    turning, first = model.chain.revolute, model.chain.first_place
    repeat = np.where(turning, noise.joint_turn, noise.joint_slide)
    Jq = _by_station(np.stack([view.unit_column(first + k, 5 if turning[k] else 2) for k in range(n)]), N) * repeat
    return samples, _by_station(geometry_rows(view, model, parameters, np.zeros(len(parameters))), N) * scale, Jq


def _by_station(rows: Array, N: int) -> Array:
    """Rows (P, c N), component-major, as (N, c, P)."""
    return rows.reshape(len(rows), -1, N).transpose(2, 1, 0)


@dataclass(frozen=True)
class Worth:
    """One moment. inverse: P (P, P). S, G: of every candidate, (c, c, N). logdet: of H. J: rows, (c, P, N)."""

    criterion: Criterion
    J: Array
    inverse: Array
    S: Array
    G: Array
    logdet: float

    @classmethod
    def of(cls, rows: StationRows, criterion: Criterion, H: Array, J: Array | None = None) -> Worth:
        """What the candidates are worth beside information H (P, P). J: of another moment of the same candidates."""
        J = np.ascontiguousarray(rows.J.transpose(1, 2, 0)) if J is None else J
        inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
        JP = np.matmul(inverse, J)
        S = _products(J, JP) + np.eye(len(J))[:, :, None]
        G = S[:, :, :0] if criterion.by_determinant else _products(np.matmul(criterion.gamma, JP), JP)
        return cls(criterion, J, inverse, S, G, float(np.linalg.slogdet(H)[1]))

    def changed(self, k: int, sign: float) -> Worth:
        """With station k added (1) or taken out (−1)."""
        c, gamma = len(self.J), self.criterion.gamma
        own = self.J[:, :, k]
        U = self.inverse @ own.T
        inside = np.eye(c) + sign * own @ U
        M = sign * np.linalg.inv(inside)
        inverse = self.inverse - U @ M @ U.T
        logdet = self.logdet + float(np.linalg.slogdet(inside)[1])
        if self.criterion.by_determinant:
            A = np.matmul(U.T, self.J)
            return replace(self, inverse=inverse, S=self.S - _products(np.matmul(M, A), A), logdet=logdet)
        AB = np.matmul(np.hstack([U, self.inverse @ (gamma @ U)]).T, self.J)
        A, B = AB[:, :c], AB[:, c:]
        MA = np.matmul(M, A)
        crossed = _products(MA, B - 0.5 * np.matmul(U.T @ gamma @ U, MA))
        G = self.G - crossed - crossed.transpose(1, 0, 2)
        return replace(self, inverse=inverse, S=self.S - _products(MA, A), G=G, logdet=logdet)

    def values(self) -> Array:
        """The criterion with each of the candidates added, (N,)."""
        if self.criterion.by_determinant:
            return self.logdet + np.log(_determinant(self.S))
        return -float(np.sum(self.inverse * self.criterion.gamma)) + _trace(self.S, self.G)


def _products(A: Array, B: Array) -> Array:
    """Σ_k A[r, k] B[s, k], (c, c, N)."""
    return np.asarray(np.einsum("rkn,skn->rsn", A, B))


def _determinant(S: Array) -> Array:
    if len(S) != 3:
        return _eliminated(S)[0]
    return np.asarray(S[0, 0] * _cofactor(S, 0, 0) + S[0, 1] * _cofactor(S, 0, 1) + S[0, 2] * _cofactor(S, 0, 2))


def _trace(S: Array, G: Array) -> Array:
    """tr(S⁻¹ G) of symmetric matrices (c, c, N), (N,)."""
    if len(S) != 3:
        return np.asarray(np.einsum("iin->n", _eliminated(S, G)[1]))
    straight = sum(_cofactor(S, i, i) * G[i, i] for i in range(3))
    across = sum(_cofactor(S, i, j) * G[i, j] for i, j in ((0, 1), (0, 2), (1, 2)))
    return np.asarray((straight + 2.0 * across) / _determinant(S))


def _eliminated(S: Array, *G: Array) -> tuple[Array, Array]:
    """det S (N,) and S⁻¹ G (c, c, N) of positive matrices, which need no pivots: all N at once."""
    c = len(S)
    both = np.concatenate([S, *G], axis=1)
    determinant = np.ones(S.shape[2])
    for k in range(c):
        determinant *= both[k, k]
        both[k, k + 1 :] /= both[k, k]
        for i in range(c):
            if i != k:
                both[i, k + 1 :] -= both[i, k] * both[k, k + 1 :]
    return determinant, both[:, c:]


def _cofactor(S: Array, i: int, j: int) -> Array:
    (a, b), (c, d) = ([k for k in range(3) if k != omitted] for omitted in (i, j))
    return np.asarray((-1) ** (i + j) * (S[a, c] * S[b, d] - S[a, d] * S[b, c]))


# --- How accurate an arm will be once it has been calibrated from certain stations


@dataclass(frozen=True)
class Accuracy:
    """model: RMS of the position error that the fit leaves [m]. repeat: RMS of what joints do not repeat [m]."""

    model: float
    repeat: float

    @property
    def rms(self) -> float:
        """Of both [m]."""
        return float(np.hypot(self.model, self.repeat))


@dataclass(frozen=True)
class Workspace:
    """Where accuracy counts. q: postures (N, n). G: (N, 3, P) [m] per prior deviation of each parameter. repeat: mean
    squares (N,) [m²].
    """

    q: Array
    G: Array
    repeat: Array

    @cached_property
    def gamma(self) -> Array:
        """Mean of GᵀG, (P, P): the mean square error is tr(C Γ)."""
        flat = self.G.reshape(-1, self.G.shape[2])
        return flat.T @ flat / len(self.G)

    def left(self, covariance: Array) -> float:
        """RMS position error [m] that this covariance leaves, without what the joints do not repeat."""
        return float(np.sqrt(np.sum(covariance * self.gamma)))

    def accuracy(self, covariance: Array) -> Accuracy:
        """The accuracy that this covariance (P, P) of the parameters, in units of their priors, leaves."""
        return Accuracy(self.left(covariance), float(np.sqrt(np.mean(self.repeat))))
