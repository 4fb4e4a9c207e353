"""The linear equations of a camera fit at one state, and what the sizes of its errors make of them.

An image's target is not quite where the model has it: joints do not repeat, and the arm has faults that its geometry
lacks. That is one unknown twist ξ per image, with the covariance Q that joints of standard deviation ``joint`` and a
shift ``shift`` make. It is integrated out image by image. With G the products of an image's columns,

    G_eff = G − G_p S G_pᵀ,   S = Q (1 + G_pp Q)⁻¹

so the equations are a sum of small ones (Woodbury). Images that several cameras took at one stop share what joints and
tool are off by: with z in standard deviations, camera k sees ξ_k = B_k z. So z is integrated out stop by stop,

    H = Σ_k H_k − Uᵀ M⁻¹ U,   U = Σ_k B_kᵀ G_p,k,   M = 1 + Σ_k B_kᵀ G_pp,k B_k

Readings of other instruments beside the images (tracker, points, sockets, ranges, bearings) are one more block of rows:
they share the arm and its effects, and have frames, tool and constants of their own. The sizes of noise, ξ, the arm's
faults and the readings' scatter are those that make the data likeliest, the parameters integrated out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from modcal_core.calibration import (
    INSTRUMENT,
    Cell,
    Model,
    ModelParameter,
    choose_parameters,
    fit_cell,
    linearise,
    views_of,
    with_sockets,
)
from modcal_core.camera.arm_poses import ArmFaults
from modcal_core.camera.bundle import PlacePrior
from modcal_core.camera.corners import POSE
from modcal_core.effects import Effect
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array
from modcal_core.hypotheses import proved
from modcal_core.measurements import BEARING, Samples
from modcal_core.measurements.kinds import dimensions, kinds
from modcal_core.robots import Chain, Inertias

_NEAR = 1e-3  # rad, m: joints of one stop, read at the moments of two images; a stop is told by no less
_NEAR_S = 2.0  # s, between two images of one stop: each camera's is taken from its middle
MIN = 3  # readings, from which base and tool of an instrument can be placed about an arm that is known
_LEVER = 0.3  # m; an instrument that scatters by so much in position scatters by as much over this in orientation
_FAR = 8.0  # standard deviations, beyond which a reading is left out
_MEDIAN = 2.366  # of a χ² of three
_PLACED = 1.0  # m, rad; how far base and tool may be from where the nominal arm puts them


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
        return np.log(list(vars(self).values()))

    def off(self, count: int) -> Array:
        """Standard deviations of what joints and, behind them, the tool are off by, (count,)."""
        return np.r_[np.full(count - 3, self.joint), np.full(3, self.shift)]

    @classmethod
    def of_logs(cls, logs: Array) -> Sizes:
        """The sizes with these logarithms (7,)."""
        return cls(*(float(x) for x in np.exp(logs)))


@dataclass(frozen=True)
class CameraRows:
    """The images of one camera at one state, the factors of a fit.

    grams (N, 22 + Z, 22 + Z): products of each image's columns, at noise 1. moved (N, 6, K): twists by the K parameters
    of arm and clock. own (N, 6, n + 3): twists by joints and shifts of an image's own. columns (K + 15 + Z,):
    where its parameters stand among those of all cameras. corners: number in use. stop (N,): number of each image's
    stop, which images of other cameras may share. pixels (M, 2): by how much corners are elsewhere than the model has
    them [px].
    """

    grams: Array
    moved: Array
    own: Array
    columns: np.ndarray
    corners: int
    stop: np.ndarray
    pixels: Array

    def by_all(self, products: Array, size: int) -> Array:
        """Products (N, m, 22 + Z) with an image's columns as those with all values and residual, (N, m, size + 1)."""
        out = np.zeros((*products.shape[:2], size + 1))
        parts = [products[:, :, :POSE] @ self.moved, products[:, :, POSE:]]
        out[:, :, np.r_[self.columns, size]] = np.concatenate(parts, axis=2)
        return out


@dataclass(frozen=True)
class _Sums:
    """Sums over all images at noise 1. H, b, cost: of images whose target is where the model has it. inner: Σ Bᵀ G_pp
    B, (S, m, m). rows: Σ Bᵀ G_p by all columns and the residual, (S, m, size + 1). S stops, per unit of what is off.
    """

    H: Array
    b: Array
    cost: float
    inner: Array
    rows: Array

    @classmethod
    def of(cls, cameras: Sequence[CameraRows], size: int) -> _Sums:
        """Of all cameras. size: number of all columns."""
        stops = stops_of(cameras)
        count, m = 1 + max(int(stop.max()) for stop in stops), cameras[0].own.shape[2]
        inner, rows = np.zeros((count, m, m)), np.zeros((count, m, size + 1))
        whole = np.zeros((size + 1, size + 1))
        for one, stop in zip(cameras, stops, strict=True):
            by_twist, own = one.by_all(one.grams[:, :POSE], size), np.swapaxes(one.own, 1, 2)
            np.add.at(inner, stop, own @ one.grams[:, :POSE, :POSE] @ one.own)
            np.add.at(rows, stop, own @ by_twist)
            moving, still = one.columns[: one.moved.shape[2]], np.r_[one.columns[one.moved.shape[2] :], size]
            by_moved = np.tensordot(one.moved, by_twist, ((0, 1), (0, 1)))
            whole[moving] += by_moved
            whole[np.ix_(still, moving)] += by_moved[:, still].T
            whole[np.ix_(still, still)] += one.grams[:, POSE:, POSE:].sum(0)
        return cls(whole[:-1, :-1], whole[:-1, -1], float(whole[-1, -1]), inner, rows)


def stops_of(cameras: Sequence[CameraRows]) -> list[np.ndarray]:
    """The stop of every image (N,) of each camera, from 0 on."""
    given = [one.stop for one in cameras]
    number = np.unique(np.concatenate(given), return_inverse=True)[1]
    return np.split(number, np.cumsum([len(stop) for stop in given])[:-1])


def numbered(q: Sequence[Array], names: Sequence[Sequence[str]], stamps: Sequence[Array]) -> list[np.ndarray]:
    """The stop of every image of several cameras: a number that images of one stop share.

    q: joints at the images of each camera, (N, n). names: of the images. stamps: [s], empty where they are not known.
    Images are of one stop where their joints are the same and they were taken at nearly the same time; of several
    images of a camera the one of the same name, then the nearest in time.
    """
    cameras, joints = np.repeat(np.arange(len(q)), [len(one) for one in q]), np.concatenate(list(q))
    called = np.array([name for one in names for name in one], dtype=object)
    at = np.concatenate([t if len(t) else np.full(len(one), np.nan) for t, one in zip(stamps, q, strict=True)])
    stop, open_ = np.arange(len(joints)), np.ones(len(joints), bool)
    for i in range(len(joints)):
        if open_[i]:
            late = np.nan_to_num(np.abs(at - at[i]))  # where no time is known, the joints say it
            same = (np.abs(joints - joints[i]).max(axis=1) <= _NEAR) & (late <= _NEAR_S) & open_
            near = np.flatnonzero(same & ((cameras != cameras[i]) | (np.arange(len(joints)) == i)))
            near = near[np.lexsort((late[near], called[near] != called[i]))]
            first = near[np.unique(cameras[near], return_index=True)[1]]
            stop[first], open_[first] = i, len(first) < 2
    return np.split(stop, np.cumsum([len(one) for one in q])[:-1])


@dataclass(frozen=True)
class BesideRows:
    """Rows of other instruments. J: (R, K). residual: (R,). known: variance that each row states, (R,). unit: variance
    per square of the size of what else they scatter, (R,). share: of a row in the directions that are seen, (R,).
    """

    J: Array
    residual: Array
    known: Array
    unit: Array
    share: Array

    def variance(self, size: float) -> Array:
        """Variance of each row, (R,)."""
        return np.asarray(self.known + size**2 * self.unit)


@dataclass(frozen=True)
class ReadingsBeside:
    """Readings of other instruments. model: where the nominal arm puts their frames and tool. own: parameters of these
    and of the instruments. samples: the readings.
    """

    model: Model
    own: tuple[ModelParameter, ...]
    samples: Samples

    @property
    def prior_std(self) -> Array:
        """Prior standard deviations of the readings' own parameters."""
        return np.array([p.prior_std if p.place == INSTRUMENT else _PLACED for p in self.own])

    @property
    def metric(self) -> bool:
        """Whether the readings determine a length; directions alone do not."""
        return bool((self.samples.kind != BEARING).any())

    @property
    def label(self) -> str:
        """Description of the readings as text."""
        pairs = zip(self.samples.kind, self.samples.frame, strict=True)
        kinds_in = {(str(kind), self.samples.frames[f]) for kind, f in pairs}
        return ", ".join(f"{kind} in {frame}" for kind, frame in sorted(kinds_in))

    def rows(
        self, arm: Sequence[ModelParameter], values: Array, effects: Sequence[Effect], columns: Array, count: int
    ) -> BesideRows:
        """The rows at values of arm, effects and own parameters. columns: where these stand among ``count``."""
        order, samples = np.roll(np.arange(len(values)), len(self.own)), self.samples
        model = self.model.with_effects(tuple(effects))
        at = linearise(model, (*self.own, *arm), values[order], samples)
        J = np.zeros((at.residual.size, count))
        J[:, columns[order]] = at.J.T
        pose = samples.is_pose
        turned = np.array([kinds()[str(k)].unit == "rad" for k in samples.kind])

        def rows(of_position: Array, of_rotation: Array | float) -> Array:
            return np.r_[np.tile(of_position, 3), np.tile(np.broadcast_to(of_rotation, (int(pose.sum()),)), 3)]

        return BesideRows(
            J,
            at.residual,
            rows(np.nan_to_num(samples.sigma_position) ** 2, np.nan_to_num(samples.sigma_rotation[pose]) ** 2),
            rows(np.where(turned, _LEVER**-2.0, 1.0), _LEVER**-2.0),
            rows(np.where(pose, 3.0, dimensions(samples)) / 3.0, 1.0),
        )

    def far(self, rows: BesideRows, size: float) -> np.ndarray:
        """Which readings (N,) are nowhere near the arm, by the others' scatter: far ones make ``size`` large."""
        z = rows.residual**2 / rows.variance(size)
        N, pose = len(self.samples), self.samples.is_pose
        worst = z[: 3 * N].reshape(3, N).sum(axis=0)
        worst[pose] = np.maximum(worst[pose], z[3 * N :].reshape(3, -1).sum(axis=0))
        return np.asarray(worst > _FAR**2 * float(np.median(worst)) / _MEDIAN)


def beside(chain: Chain, samples: Samples, inertias: Inertias | None = None) -> ReadingsBeside:
    """Readings of other instruments, their frames and tool placed about the nominal arm.

    Raises NotEnoughData for fewer than three of them in a frame, or of a kind that needs more.
    """
    samples, _ = proved(with_sockets(samples, Cell(), chain), chain)
    for f, frame in enumerate(samples.frames):
        rows = samples.frame == f
        least = max([MIN, *(kinds()[str(k)].least for k in np.unique(samples.kind[rows]))])
        if rows.sum() < least:
            said = f"{int(rows.sum())} readings in it, at least {least} are needed"
            raise NotEnoughData(f"frame {frame}", said, "take more, or leave the topic out (--ignore)")
    model = fit_cell(chain, samples, Cell(), inertias).model
    own = choose_parameters(model, views_of(samples), (), (), among=lambda p: not p.of_arm).parameters
    return ReadingsBeside(model, own, samples)


@dataclass(frozen=True)
class Equations:
    """All factors at one state.

    cameras: of each. offset (V,): all values less the prior's mean. information: of the prior but for the arm's faults
    and the places of markers, (V, V). free: (V,) bool. arm: indices of the faults of the arm. beside: rows of other
    instruments. faults: expected of the arm. places: expected of the last Z of the first camera, None of a flat sheet.
    """

    cameras: tuple[CameraRows, ...]
    offset: Array
    information: Array
    free: np.ndarray
    arm: np.ndarray
    beside: BesideRows | None = None
    faults: ArmFaults | None = None
    places: PlacePrior | None = None

    @cached_property
    def sums(self) -> _Sums:
        """Over all images at noise 1."""
        return _Sums.of(self.cameras, len(self.offset))

    def prior(self, sizes: Sizes) -> Array:
        """Information of the prior, (V, V)."""
        out = self.information.copy()
        if self.faults is not None:
            out[np.ix_(self.arm, self.arm)] = self.faults.information(sizes.arm, sizes.lengths)
        if self.places is not None:
            rows = self.cameras[0].columns[-len(self.places.apart) :]
            out[np.ix_(rows, rows)] = self.places.information(sizes.places)
        return out

    def with_block(self, rows: np.ndarray, information: Array, offset: Array) -> Equations:
        """The equations with another prior of these parameters, which the state has off its mean by so much."""
        every, off, use = self.information.copy(), self.offset.copy(), self.free.copy()
        every[rows], every[:, rows] = 0.0, 0.0
        every[np.ix_(rows, rows)], off[rows], use[rows] = information, offset, True
        return replace(self, information=every, offset=off, free=use)

    def _inner(self, sizes: Sizes) -> tuple[Array, Array]:
        """(standard deviations of what joints and tool are off by at a stop, (m,); M of each stop, (S, m, m))."""
        off = sizes.off(len(self.sums.inner[0]))
        scale = off / sizes.noise
        return off, np.eye(len(off)) + scale[:, None] * self.sums.inner * scale

    def by_change(self, sizes: Sizes, columns: Mapping[int, Array]) -> tuple[Array, Array]:
        """Products of a change with itself, (S, k, k), and with all parameters and the residual, (S, k, size + 1), at
        each stop, what the arm is off by there integrated out.

        columns: by camera, by how much k numbers change twist, lens, shape, readout and places, (N, 21 + Z, k).
        """
        sums, (off, inner), size = self.sums, self._inner(sizes), len(self.offset)
        stops, k = stops_of(self.cameras), next(iter(columns.values())).shape[2]
        own, cross = np.zeros((len(inner), k, k)), np.zeros((len(inner), k, size + 1))
        back = np.zeros((len(inner), k, len(off)))
        for camera, D in columns.items():
            one, stop = self.cameras[camera], stops[camera]
            by = np.swapaxes(D, 1, 2) @ one.grams[:, :-1] / sizes.noise**2
            np.add.at(own, stop, by[:, :, :-1] @ D)
            np.add.at(cross, stop, one.by_all(by, size))
            np.add.at(back, stop, by[:, :, :POSE] @ one.own)
        back *= off
        taken = back @ np.linalg.inv(inner)
        own -= taken @ np.swapaxes(back, 1, 2)
        cross -= taken @ (off[:, None] * sums.rows) / sizes.noise**2
        return own, cross

    def solve(self, sizes: Sizes) -> SolvedEquations:
        """The normal equations with these sizes."""
        sums, unit = self.sums, sizes.noise**-2
        off, inner = self._inner(sizes)
        L = np.linalg.cholesky(inner)
        V = (np.linalg.inv(L) * (off * unit) @ sums.rows).reshape(-1, len(sums.b) + 1)
        taken = V.T @ V
        H, b, cost = unit * sums.H - taken[:-1, :-1], unit * sums.b - taken[:-1, -1], unit * sums.cost - taken[-1, -1]
        spread = 2.0 * sum(one.corners for one in self.cameras) * np.log(sizes.noise**2)
        spread += 2.0 * np.log(np.einsum("sii->si", L)).sum()
        if self.beside is not None:
            variance, J, r = self.beside.variance(sizes.other), self.beside.J, self.beside.residual
            K = J.shape[1]
            H[:K, :K] += J.T @ (J / variance[:, None])
            b[:K] += (J / variance[:, None]).T @ r
            cost += (r**2 / variance).sum()
            spread += self.beside.share @ np.log(variance)
        prior = self.prior(sizes)
        use = np.flatnonzero(self.free)
        chosen = np.ix_(use, use)
        pull = prior @ self.offset
        cost += self.offset @ pull
        P = prior[chosen]
        return SolvedEquations(self, sizes, H[chosen] + P, b[use] - pull[use], P, float(cost), float(spread))


@dataclass(frozen=True)
class SolvedEquations:
    """H x = b of the free parameters, P of the prior in H. cost: of the state. spread: log determinant of the noise."""

    equations: Equations
    sizes: Sizes
    H: Array
    b: Array
    P: Array
    cost: float
    spread: float

    @property
    def use(self) -> np.ndarray:
        """Indices of the free parameters among all."""
        return np.flatnonzero(self.equations.free)

    @cached_property
    def S(self) -> Array:
        """S of each image of the first camera, (N, 6, 6)."""
        rows, unit = self.equations.cameras[0], self.sizes.noise**-2
        own = rows.own * self.sizes.off(rows.own.shape[2])
        Q = own @ np.swapaxes(own, 1, 2)
        return np.asarray(Q @ np.linalg.inv(np.eye(POSE) + unit * rows.grams[:, :POSE, :POSE] @ Q))

    @property
    def of_views(self) -> Array:
        """Products of each image's twist with all of its columns, its own twist integrated out, (N, 6, 22 + Z)."""
        own = self.equations.cameras[0].grams[:, :POSE] / self.sizes.noise**2
        return np.asarray(own - own[:, :, :POSE] @ self.S @ own)

    def step(self, damping: float = 0.0) -> Array:
        """The step of all parameters (V,), zero for those held fixed."""
        scale = 1.0 / np.sqrt(np.diag(self.H))
        H = self.H * np.outer(scale, scale) + damping * np.eye(len(self.b))
        out = np.zeros(len(self.equations.offset))
        out[self.use] = scale * scipy.linalg.cho_solve(scipy.linalg.cho_factor(H), scale * self.b)
        return out

    def covariance(self) -> Array:
        """Covariance of all parameters, (V, V); zero for fixed ones."""
        scale = 1.0 / np.sqrt(np.diag(self.H))
        inverse = scipy.linalg.cho_solve(scipy.linalg.cho_factor(self.H * np.outer(scale, scale)), np.eye(len(self.b)))
        out = np.zeros(self.equations.information.shape)
        out[np.ix_(self.use, self.use)] = inverse * np.outer(scale, scale)
        return 0.5 * (out + out.T)

    def misfit(self) -> float:
        """−2 log of the likelihood of the data, all parameters integrated out, up to a constant."""
        L = np.linalg.cholesky(self.H)
        z = scipy.linalg.lapack.dtrtrs(L, self.b, lower=1)[0]
        logs = 2.0 * float(np.log(np.diag(L)).sum()) - float(np.linalg.slogdet(self.P)[1])
        return self.cost + self.spread + logs - float(z @ z)
