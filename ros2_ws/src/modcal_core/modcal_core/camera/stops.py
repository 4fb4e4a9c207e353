"""Stops of the arm that several cameras saw: what joints and tool were off by there is one and the same for all.

Two images of one stop are no two repeats of the arm. Each has noise of its own, but the twist ξ by which an image's
target is not where the model has it (equations) comes from one set of joints: with z what joints and tool are off by at
a stop, in standard deviations, camera k sees ξ_k = B_k z. So z is integrated out stop by stop, over all cameras,

    H = Σ_k H_k − Uᵀ M⁻¹ U,   U = Σ_k B_kᵀ G_p,k,   M = 1 + Σ_k B_kᵀ G_pp,k B_k

which for a stop that one camera saw is what integrating out ξ gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.corners import POSE
from modcal_core.geometry import Array

ALONE = -1  # number of the stop of an image that no other camera's is known to share
_NEAR = 1e-3  # rad, m: joints of one stop, read at the moments of two images; a stop is told by no less
_NEAR_S = 2.0  # s, between two images of one stop: each camera's is taken from its middle


@dataclass(frozen=True)
class SeenStops:
    """Images of one camera at stops that others saw as well. grams (R, 22 + Z, 22 + Z), moved (R, 6, K): as in the
    equations. own: (R, 6, m), twists by what joints and tool are off by, per unit. columns: where each of its
    parameters stands among those of all, −1 for one that is not fitted. stop: number of each, (R,).
    """

    grams: Array
    moved: Array
    own: Array
    columns: np.ndarray
    stop: np.ndarray

    def rows(self) -> tuple[Array, Array]:
        """(Bᵀ G_pp B (R, m, m), Bᵀ G_p by its own columns and the residual (R, m, K + 15 + Z + 1)), at noise 1."""
        to_pose = np.swapaxes(self.own, 1, 2) @ self.grams[:, :POSE]
        by_pose = to_pose[:, :, :POSE]
        return by_pose @ self.own, np.concatenate([by_pose @ self.moved, to_pose[:, :, POSE:]], axis=2)


@dataclass(frozen=True)
class TiedStops:
    """S stops that several cameras saw. inner: Σ Bᵀ G_pp B, (S, m, m). rows: Σ Bᵀ G_p by all columns and the residual,
    (S, m, size + 1). Both per unit of what is off, at noise 1.
    """

    inner: Array
    rows: Array

    @classmethod
    def of(cls, seen: Sequence[SeenStops], size: int) -> TiedStops:
        """The stops of these cameras. size: number of all columns."""
        stops = np.unique(np.concatenate([one.stop for one in seen]))
        m = seen[0].own.shape[2]
        inner, rows = np.zeros((len(stops), m, m)), np.zeros((len(stops), m, size + 1))
        for one in seen:
            at = np.searchsorted(stops, one.stop)
            own_inner, own_rows = one.rows()
            keep = np.flatnonzero(one.columns >= 0)
            inner[at] += own_inner
            rows[at[:, None], :, np.r_[one.columns[keep], size]] += own_rows[:, :, np.r_[keep, -1]].transpose(0, 2, 1)
        return cls(inner, rows)

    def taken(self, off: Array, noise: float) -> tuple[Array, Array, float, float]:
        """(Uᵀ M⁻¹ U (size, size), Uᵀ M⁻¹ r (size,), rᵀ M⁻¹ r, log det M), summed over all stops.

        off: standard deviation of what is off, (m,). noise: of corners.
        """
        scale = off / noise
        M = np.eye(len(off)) + scale[:, None] * self.inner * scale
        L = np.linalg.cholesky(M)
        to_white = np.linalg.inv(L) * (off / noise**2)
        V = (to_white @ self.rows).reshape(-1, self.rows.shape[2])
        square = V.T @ V
        log_det = 2.0 * float(np.log(np.einsum("sii->si", L)).sum())
        return square[:-1, :-1], square[:-1, -1], float(square[-1, -1]), log_det


def numbered(q: Sequence[Array], names: Sequence[Sequence[str]], stamps: Sequence[Array]) -> list[np.ndarray]:
    """The stop of every image of several cameras: a number that images of one stop share, ALONE where there is none.

    q: joints at the images of each camera, (N, n). names: of the images. stamps: [s], empty where they are not known.
    Images are of one stop where their joints are the same and they were taken at nearly the same time; without times,
    where they have one name, or no other images of these cameras have these joints.
    """
    cameras = np.concatenate([np.full(len(one), k) for k, one in enumerate(q)])
    joints = np.concatenate(list(q))
    called = np.array([name for one in names for name in one], dtype=object)
    at = np.concatenate([t if len(t) else np.full(len(one), np.nan) for t, one in zip(stamps, q, strict=True)])
    stop = np.full(len(joints), ALONE)
    count = 0
    for i in range(len(joints)):
        if stop[i] != ALONE:
            continue
        near = np.flatnonzero((np.abs(joints - joints[i]).max(axis=1) <= _NEAR) & (stop == ALONE))
        if np.isfinite(at[near]).all():
            near = near[np.abs(at[near] - at[i]) <= _NEAR_S]
            near = near[np.argsort(np.abs(at[near] - at[i]), kind="stable")]
        elif (alike := called[near] == called[i]).sum() > 1:
            near = near[alike]
        elif len(np.unique(cameras[near])) < len(near):
            continue
        near = near[(cameras[near] != cameras[i]) | (near == i)]
        first = near[np.unique(cameras[near], return_index=True)[1]]
        if len(first) > 1:
            stop[first] = count
            count += 1
    return np.split(stop, np.cumsum([len(one) for one in q])[:-1])
