"""What each station would tell: the rows that it adds to the normal equations of the calibration, and its noise.

The parameters, their derivatives and the weights are those of ``modcal calibrate``: one weight a reading from its own
scatter and from what the arm does not repeat. The noise itself is not that simple, for a joint that does not repeat
moves the tool along its own arc; so the covariance that the fit will really have is kept beside,

    C = A (Σ_i J_iᵀ W_i R_i W_i J_i + Λ) A,    A = (Σ_i J_iᵀ W_i J_i + Λ)⁻¹,    R_i = σ_i² 1 + J_q Σ_q J_qᵀ

with Λ the prior, which takes the arm to be as far from its drawing as robots are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.linearise import RowView, geometry_rows
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.structure import exact_samples
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.planning.site import Noise


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
    N, n = q.shape
    samples = exact_samples(model, q, np.zeros(N, dtype=int), np.full(N, kind, dtype=KIND_NAMES))
    view = RowView.of(model, samples, model.drivers(samples))
    scale = np.array([p.prior_std for p in parameters])
    J = _by_station(geometry_rows(view, model, parameters, np.zeros(len(parameters))), N) * scale
    turning, first = model.chain.revolute, model.chain.first_place
    repeat = np.where(turning, noise.joint_turn, noise.joint_slide)
    Jq = _by_station(np.stack([view.unit_column(first + k, 5 if turning[k] else 2) for k in range(n)]), N) * repeat
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
    return StationRows(
        J * weight[..., None], R * weight[:, :, None] * weight[:, None, :], scale, unrepeated, joint_variance
    )


def position_rows(model: Model, parameters: Sequence[ModelParameter], q: Array, noise: Noise) -> tuple[Array, Array]:
    """Derivatives of the target's position (N, 3, P) [m] per prior deviation, and unrepeated mean squares (N,) [m²]."""
    N, n = q.shape
    samples = exact_samples(model, q, np.zeros(N, dtype=int), np.full(N, "point", dtype=KIND_NAMES))
    view = RowView.of(model, samples, model.drivers(samples))
    scale = np.array([p.prior_std for p in parameters])
    turning, first = model.chain.revolute, model.chain.first_place
    repeat = np.where(turning, noise.joint_turn, noise.joint_slide)
    Jq = _by_station(np.stack([view.unit_column(first + k, 5 if turning[k] else 2) for k in range(n)]), N) * repeat
    G = _by_station(geometry_rows(view, model, parameters, np.zeros(len(parameters))), N) * scale
    return G, np.sum(Jq**2, axis=(1, 2))


def _by_station(rows: Array, N: int) -> Array:
    """Rows (P, c N), component-major, as (N, c, P)."""
    return rows.reshape(len(rows), -1, N).transpose(2, 1, 0)
