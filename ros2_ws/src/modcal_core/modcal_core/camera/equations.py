"""The linear equations of a camera fit at one state, and what the sizes of its errors make of them.

An image's target is not quite where the model has it: joints come back with an error of their own, and the arm has
faults that its geometry lacks. That is one unknown twist ξ per image, with the covariance Q that joints of standard
deviation ``joint`` and a shift ``shift`` make. It is integrated out image by image. With G the products of an image's
columns, corners' noise counted,

    G_eff = G − G_p S G_pᵀ,   S = Q (1 + G_pp Q)⁻¹

so images never tie parameters together, and the equations are a sum of small ones (Woodbury). The sizes of noise, ξ and
the arm's expected faults are those that make the data likeliest, the parameters integrated out (evidence, type II).
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
import scipy.linalg

from modcal_core.camera.beside import BesideRows
from modcal_core.camera.corners import POSE
from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class Sizes:
    """noise: of corners, in units of what detection states. joint: what joints repeat to [rad, m]. shift: of the tool
    besides [m]. arm: faults of the arm, in units of its prior. other: what readings of other instruments scatter beyond
    what they state [m].
    """

    noise: float
    joint: float
    shift: float
    arm: float
    other: float = 1e-4

    @property
    def logs(self) -> Array:
        """Their logarithms, (5,)."""
        return np.log(np.array(astuple(self)))

    @classmethod
    def of_logs(cls, logs: Array) -> Sizes:
        """The sizes with these logarithms (5,)."""
        return cls(*(float(x) for x in np.exp(logs)))


@dataclass(frozen=True)
class Equations:
    """At one state: grams (N, 22, 22) at noise 1; moved (N, 6, K): twists by the K parameters of arm and clock; joints
    (N, 6, n), shifts (N, 6, 3): twists by what an image has of its own. arm: which of the K are faults of the arm.
    offset (K + 15,): the state less the prior's mean. information: of the prior with arm faults of size 1, (K + 15,
    K + 15). free: (K + 15,) bool. corners: number of corners in use. beside: rows of other instruments.
    """

    grams: Array
    moved: Array
    joints: Array
    shifts: Array
    arm: np.ndarray
    offset: Array
    information: Array
    free: np.ndarray
    corners: int
    beside: BesideRows | None = None

    def covariance_of_views(self, sizes: Sizes) -> Array:
        """Q of each image's own twist, (N, 6, 6)."""
        joints, shifts = sizes.joint * self.joints, sizes.shift * self.shifts
        return joints @ np.swapaxes(joints, 1, 2) + shifts @ np.swapaxes(shifts, 1, 2)

    def prior(self, sizes: Sizes) -> Array:
        """Information of the prior, (K + 15, K + 15)."""
        scale = np.ones(len(self.information))
        scale[: len(self.arm)][self.arm] = 1.0 / sizes.arm
        return self.information * np.outer(scale, scale)

    def solve(self, sizes: Sizes) -> SolvedEquations:
        """The normal equations with these sizes."""
        K = self.moved.shape[2]
        G = self.grams / sizes.noise**2
        Q = self.covariance_of_views(sizes)
        inner = np.eye(POSE) + G[:, :POSE, :POSE] @ Q
        S = Q @ np.linalg.inv(inner)
        left = G[:, :, :POSE]
        E = G - left @ S @ np.swapaxes(left, 1, 2)
        common = E.shape[1] - POSE - 1
        H = np.empty((K + common, K + common))
        b = np.empty(K + common)
        # one product over all images rather than a sum of many
        A = self.moved.reshape(-1, K)
        H[:K, :K] = A.T @ (E[:, :POSE, :POSE] @ self.moved).reshape(-1, K)
        H[:K, K:] = A.T @ E[:, :POSE, POSE:-1].reshape(-1, common)
        H[K:, :K] = H[:K, K:].T
        H[K:, K:] = E[:, POSE:-1, POSE:-1].sum(0)
        b[:K] = A.T @ E[:, :POSE, -1].reshape(-1)
        b[K:] = E[:, POSE:-1, -1].sum(0)
        extra = spread_beside = 0.0
        if self.beside is not None:
            variance = self.beside.variance(sizes.other)
            weighted = self.beside.J / variance[:, None]
            H[:K, :K] += self.beside.J.T @ weighted
            b[:K] += weighted.T @ self.beside.residual
            extra = float((self.beside.residual**2 / variance).sum())
            spread_beside = float(self.beside.share @ np.log(variance))
        prior = self.prior(sizes)
        use = np.flatnonzero(self.free)
        P = prior[np.ix_(use, use)]
        pull = prior[use] @ self.offset
        cost = float(E[:, -1, -1].sum() + self.offset @ prior @ self.offset) + extra
        spread = spread_beside + 2.0 * self.corners * np.log(sizes.noise**2) + float(np.linalg.slogdet(inner)[1].sum())
        return SolvedEquations(H[np.ix_(use, use)] + P, b[use] - pull, P, use, len(self.offset), cost, spread, S, E)


@dataclass(frozen=True)
class SolvedEquations:
    """Normal equations H x = b of the free parameters, prior included; P: of the prior alone. use: indices of the free
    among all. cost: of the state. spread: log determinant of the noise. S, E: of each image, as above.
    """

    H: Array
    b: Array
    P: Array
    use: np.ndarray
    count: int
    cost: float
    spread: float
    S: Array
    E: Array

    def step(self, damping: float = 0.0) -> Array:
        """The step of all parameters (K + 15,), zero for those held fixed."""
        scale = 1.0 / np.sqrt(np.diag(self.H))
        H = self.H * np.outer(scale, scale) + damping * np.eye(len(self.b))
        out = np.zeros(self.count)
        out[self.use] = scale * scipy.linalg.cho_solve(scipy.linalg.cho_factor(H), scale * self.b)
        return out

    def covariance(self) -> Array:
        """Of all parameters, (K + 15, K + 15), zero for those held fixed."""
        scale = 1.0 / np.sqrt(np.diag(self.H))
        inverse = scipy.linalg.cho_solve(scipy.linalg.cho_factor(self.H * np.outer(scale, scale)), np.eye(len(self.b)))
        out = np.zeros((self.count, self.count))
        out[np.ix_(self.use, self.use)] = inverse * np.outer(scale, scale)
        return 0.5 * (out + out.T)

    def misfit(self) -> float:
        """−2 log of the likelihood of the data, all parameters integrated out, up to a constant."""
        L = scipy.linalg.cholesky(self.H, lower=True)
        z = scipy.linalg.solve_triangular(L, self.b, lower=True)
        logs = 2.0 * float(np.log(np.diag(L)).sum()) - float(np.linalg.slogdet(self.P)[1])
        return self.cost + self.spread + logs - float(z @ z)
