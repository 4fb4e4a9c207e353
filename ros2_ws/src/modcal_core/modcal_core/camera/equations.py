"""The linear equations of a camera fit at one state, and what the sizes of its errors make of them.

An image's target is not quite where the model has it: joints come back with an error of their own, and the arm has
faults that its geometry lacks. That is one unknown twist ξ per image, with the covariance Q that joints of standard
deviation ``joint`` and a shift ``shift`` make. It is integrated out image by image. With G the products of an image's
columns, corners' noise counted,

    G_eff = G − G_p S G_pᵀ,   S = Q (1 + G_pp Q)⁻¹

so images never tie parameters together, and the equations are a sum of small ones (Woodbury). Images that several
cameras took at one stop are no two repeats of the arm. Each has noise of its own, but their twists ξ come from one set
of joints: with z what joints and tool are off by at a stop, in standard deviations, camera k sees ξ_k = B_k z. So z is
integrated out stop by stop, over all cameras,

    H = Σ_k H_k − Uᵀ M⁻¹ U,   U = Σ_k B_kᵀ G_p,k,   M = 1 + Σ_k B_kᵀ G_pp,k B_k

which for a stop that one camera saw is what integrating out ξ gives. The sizes of noise, ξ and the arm's expected
faults are those that make the data likeliest, the parameters integrated out (evidence, type II).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.linalg

from modcal_core.camera.arm_poses import ArmFaults
from modcal_core.camera.bundle import PlacePrior
from modcal_core.camera.corners import POSE
from modcal_core.camera.other_readings import BesideRows
from modcal_core.geometry import Array

ALONE = -1  # number of the stop of an image that no other camera's is known to share
_NEAR = 1e-3  # rad, m: joints of one stop, read at the moments of two images; a stop is told by no less
_NEAR_S = 2.0  # s, between two images of one stop: each camera's is taken from its middle


@dataclass(frozen=True)
class TiedStops:
    """S stops that several cameras saw. inner: Σ Bᵀ G_pp B, (S, m, m). rows: Σ Bᵀ G_p by all columns and the residual,
    (S, m, size + 1). Both per unit of what is off, at noise 1.
    """

    inner: Array
    rows: Array

    @classmethod
    def of(cls, cameras: Sequence[tuple[Equations, np.ndarray, np.ndarray]], size: int) -> TiedStops | None:
        """The stops of these cameras, None where there are none: equations, its columns among all, −1 for one that is
        not fitted, which of its images others share. size: number of all columns.
        """
        cameras = [one for one in cameras if one[2].any()]
        if not cameras:
            return None
        stops = np.unique(np.concatenate([eq.stop[shared] for eq, _, shared in cameras]))
        m = cameras[0][0].joints.shape[2] + 3
        inner, rows = np.zeros((len(stops), m, m)), np.zeros((len(stops), m, size + 1))
        for eq, columns, shared in cameras:
            at = np.searchsorted(stops, eq.stop[shared])
            own = np.concatenate([eq.joints[shared], eq.shifts[shared]], axis=2)  # twists per unit of what is off
            to_pose = np.swapaxes(own, 1, 2) @ eq.grams[shared, :POSE]
            by_pose = to_pose[:, :, :POSE]
            inner[at] += by_pose @ own
            own_rows = np.concatenate([by_pose @ eq.moved[shared], to_pose[:, :, POSE:]], axis=2)
            keep = np.flatnonzero(columns >= 0)
            rows[at[:, None], :, np.r_[columns[keep], size]] += own_rows[:, :, np.r_[keep, -1]].transpose(0, 2, 1)
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


@dataclass(frozen=True)
class Sizes:
    """noise: of corners, in units of what detection states. joint: what joints repeat to [rad, m]. shift: of the tool
    besides [m]. arm: faults of the arm, in units of its prior. other: what readings of other instruments scatter beyond
    what they state [m]. lengths: faults of its lengths against those of its angles, in units of what is usual.
    places: offsets of a body's markers, in units of their tolerances.
    """

    noise: float
    joint: float
    shift: float
    arm: float
    other: float = 1e-4
    lengths: float = 1.0
    places: float = 1.0

    @property
    def logs(self) -> Array:
        """Their logarithms, (7,)."""
        values = (self.noise, self.joint, self.shift, self.arm, self.other, self.lengths, self.places)
        return np.log(np.array(values))

    @classmethod
    def of_logs(cls, logs: Array) -> Sizes:
        """The sizes with these logarithms (7,)."""
        return cls(*(float(x) for x in np.exp(logs)))


@dataclass(frozen=True)
class OtherBlock:
    """Images of a further camera. equations: theirs, in an order of their own, whose priors do not count. columns:
    where each of their parameters stands among those of all, −1 for one that is not fitted.
    """

    equations: Equations
    columns: np.ndarray


@dataclass(frozen=True)
class _Reduced:
    """H, b: of images alone, their own twists integrated out, without a prior. cost, spread, S: as elsewhere."""

    H: Array
    b: Array
    cost: float
    spread: float
    S: Array


@dataclass(frozen=True)
class Equations:
    """At one state: grams (N, 22 + Z, 22 + Z) at noise 1; moved (N, 6, K): twists by the K parameters of arm and clock;
    joints (N, 6, n), shifts (N, 6, 3): twists by what an image has of its own. arm: which of the K are faults of the
    arm. offset (K + 15 + Z,): the state less the prior's mean. information: of the prior but for the arm's faults and
    the places of markers, (K + 15 + Z, K + 15 + Z). free: (K + 15 + Z,) bool. corners: number of corners in use.
    beside: rows of other instruments. others: images of further cameras. faults: of those of the K that are the arm's.
    places: of the last Z, None of a flat sheet. stop: of each image, which images of others may share, (N,), empty
    where none does.
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
    others: tuple[OtherBlock, ...] = ()
    faults: ArmFaults | None = None
    places: PlacePrior | None = None
    stop: np.ndarray = field(default_factory=lambda: np.empty(0, int))

    @cached_property
    def _shared(self) -> tuple[tuple[Equations, np.ndarray, np.ndarray], ...]:
        """(equations of a camera, its columns among those of all, which of its images others share), of each camera."""
        every = [(self, np.arange(len(self.offset))), *((o.equations, o.columns) for o in self.others)]
        stops = np.concatenate([eq.stop for eq, _ in every])
        number, seen = np.unique(stops, return_counts=True)
        often = number[(seen > 1) & (number != ALONE)]
        shares = [np.isin(eq.stop, often) if len(eq.stop) else np.zeros(len(eq.grams), bool) for eq, _ in every]
        return tuple((eq, columns, share) for (eq, columns), share in zip(every, shares, strict=True))

    @cached_property
    def _tied(self) -> TiedStops | None:
        """The stops that several cameras saw, None where there are none."""
        return TiedStops.of(self._shared, len(self.offset))

    @cached_property
    def _total(self) -> Array:
        """Sum over all images of what no image has of its own, at noise 1: (16 + Z, 16 + Z)."""
        return np.asarray(self.grams[:, POSE:, POSE:].sum(0))

    def covariance_of_views(self, sizes: Sizes) -> Array:
        """Q of each image's own twist, (N, 6, 6)."""
        joints, shifts = sizes.joint * self.joints, sizes.shift * self.shifts
        return joints @ np.swapaxes(joints, 1, 2) + shifts @ np.swapaxes(shifts, 1, 2)

    def prior(self, sizes: Sizes) -> Array:
        """Information of the prior, (K + 15 + Z, K + 15 + Z)."""
        out = self.information.copy()
        if self.faults is not None:
            arm = np.flatnonzero(self.arm)
            out[np.ix_(arm, arm)] = self.faults.information(sizes.arm, sizes.lengths)
        if self.places is not None:
            first = len(out) - len(self.places.apart)
            out[first:, first:] = self.places.information(sizes.places)
        return out

    def _reduced(self, sizes: Sizes, shared: np.ndarray | None = None) -> _Reduced:
        """What the images say with these sizes. shared: images whose own twists are not integrated out, (N,) bool."""
        K = self.moved.shape[2]
        own = self.grams[:, :POSE] / sizes.noise**2  # an image's pose against everything
        Q = self.covariance_of_views(sizes)
        inner = np.eye(POSE) + own[:, :, :POSE] @ Q
        S = Q @ np.linalg.inv(inner)
        log_det = np.linalg.slogdet(inner)[1]
        alone = slice(None) if shared is None or not shared.any() else ~shared
        taken = S[alone] @ own[alone]
        rows = own.copy()
        rows[alone] -= own[alone][:, :, :POSE] @ taken
        width = own.shape[2] - POSE
        size = width - 1
        # one product over all images rather than a sum of many
        E = self._total / sizes.noise**2
        E = E - own[alone][:, :, POSE:].reshape(-1, width).T @ taken[:, :, POSE:].reshape(-1, width)
        H = np.empty((K + size, K + size))
        b = np.empty(K + size)
        A = self.moved.reshape(-1, K)
        H[:K, :K] = A.T @ (rows[:, :, :POSE] @ self.moved).reshape(-1, K)
        H[:K, K:] = A.T @ rows[:, :, POSE:-1].reshape(-1, size)
        H[K:, :K] = H[:K, K:].T
        H[K:, K:] = E[:-1, :-1]
        b[:K] = A.T @ rows[:, :, -1].reshape(-1)
        b[K:] = E[:-1, -1]
        spread = 2.0 * self.corners * np.log(sizes.noise**2) + float(log_det[alone].sum())
        return _Reduced(H, b, float(E[-1, -1]), spread, S)

    def of_others(self, sizes: Sizes) -> Array:
        """What further cameras and other instruments say beside this camera's images, (K + 15 + Z, K + 15 + Z)."""
        return np.asarray(self._of_all(sizes).H - self._reduced(sizes).H)

    def _of_all(self, sizes: Sizes) -> _Reduced:
        """What all images and instruments say. S: of the first camera's, each by itself."""
        out = self._reduced(sizes, self._shared[0][2] if self.others else None)
        if not self.others and self.beside is None:
            return out
        K = self.moved.shape[2]
        H, b, cost, spread = out.H, out.b, out.cost, out.spread
        for eq, columns, share in self._shared[1:]:
            there = eq._reduced(sizes, share)
            keep = np.flatnonzero(columns >= 0)
            at = columns[keep]
            H[np.ix_(at, at)] += there.H[np.ix_(keep, keep)]
            b[at] += there.b[keep]
            cost, spread = cost + there.cost, spread + there.spread
        if self._tied is not None:
            off = np.r_[np.full(self.joints.shape[2], sizes.joint), np.full(3, sizes.shift)]
            taken = self._tied.taken(off, sizes.noise)
            H, b, cost, spread = H - taken[0], b - taken[1], cost - taken[2], spread + taken[3]
        if self.beside is not None:
            variance = self.beside.variance(sizes.other)
            weighted = self.beside.J / variance[:, None]
            H[:K, :K] += self.beside.J.T @ weighted
            b[:K] += weighted.T @ self.beside.residual
            cost += float((self.beside.residual**2 / variance).sum())
            spread += float(self.beside.share @ np.log(variance))
        return _Reduced(H, b, cost, spread, out.S)

    def solve(self, sizes: Sizes) -> SolvedEquations:
        """The normal equations with these sizes."""
        data = self._of_all(sizes)
        H, b, cost = data.H, data.b, data.cost
        prior = self.prior(sizes)
        use = np.flatnonzero(self.free)
        chosen = np.ix_(use, use)
        P = prior[chosen]
        pull = prior @ self.offset
        cost += float(self.offset @ pull)
        return SolvedEquations(
            *(H[chosen] + P, b[use] - pull[use], P, use, len(self.offset), cost, data.spread, data.S),
            self.grams,
            sizes.noise,
        )


@dataclass(frozen=True)
class SolvedEquations:
    """Normal equations H x = b of the free parameters, prior included; P: of the prior alone. use: indices of the free
    among all. cost: of the state. spread: log determinant of the noise. S: of each image, as above. grams, noise: what
    they come from.
    """

    H: Array
    b: Array
    P: Array
    use: np.ndarray
    count: int
    cost: float
    spread: float
    S: Array
    grams: Array
    noise: float

    @property
    def E(self) -> Array:
        """The products of each image's columns, its own twist integrated out, (N, 22 + Z, 22 + Z)."""
        G = self.grams / self.noise**2
        left = G[:, :, :POSE]
        return np.asarray(G - left @ self.S @ np.swapaxes(left, 1, 2))

    def step(self, damping: float = 0.0) -> Array:
        """The step of all parameters (K + 15 + Z,), zero for those held fixed."""
        scale = 1.0 / np.sqrt(np.diag(self.H))
        H = self.H * np.outer(scale, scale) + damping * np.eye(len(self.b))
        out = np.zeros(self.count)
        out[self.use] = scale * scipy.linalg.cho_solve(scipy.linalg.cho_factor(H), scale * self.b)
        return out

    def covariance(self) -> Array:
        """Covariance of all parameters, (K + 15 + Z, K + 15 + Z); zero for fixed ones."""
        scale = 1.0 / np.sqrt(np.diag(self.H))
        inverse = scipy.linalg.cho_solve(scipy.linalg.cho_factor(self.H * np.outer(scale, scale)), np.eye(len(self.b)))
        out = np.zeros((self.count, self.count))
        out[np.ix_(self.use, self.use)] = inverse * np.outer(scale, scale)
        return 0.5 * (out + out.T)

    def misfit(self) -> float:
        """−2 log of the likelihood of the data, all parameters integrated out, up to a constant."""
        L = np.linalg.cholesky(self.H)
        z = scipy.linalg.lapack.dtrtrs(L, self.b, lower=1)[0]
        logs = 2.0 * float(np.log(np.diag(L)).sum()) - float(np.linalg.slogdet(self.P)[1])
        return self.cost + self.spread + logs - float(z @ z)
