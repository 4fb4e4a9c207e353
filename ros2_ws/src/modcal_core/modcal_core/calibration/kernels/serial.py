"""Equations of a serial arm without effects that is watched by points or by poses: quick, block by block.

The plain version is :func:`~modcal_core.calibration.linearise.linearise` with
:func:`~modcal_core.calibration.normal_equations.normal_equations`. What makes this one quick:

* sines and cosines of the joints are taken once, for they do not change with the values;
* residual and gradient come from two sweeps along the chain (see :mod:`sweeps`), without a Jacobian;
* the weights are put into the root's axes, which all columns are made of, so J comes out weighted and JᵀWJ is one
  symmetric product;
* blocks stay in the cache, and memory flat.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.kernels.sweeps import Postures, moments, outward, tool_in_places, unit_turns
from modcal_core.calibration.linearise import Linearised
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import Parameter
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.registry import is_direct
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain

BLOCK = 4096  # samples in a sweep
COLUMNS = 1024  # samples whose Jacobian is made at once; it fits the cache of one core
_KEPT = 4 * BLOCK  # samples whose sweep is kept from residual to gradient; beyond, it is made again
_TURNED = 0.5  # sine of an angle [rad] beyond which a residual turn is taken by the general logarithm


def is_serial(model: Model, samples: Samples, parameters: Sequence[Parameter]) -> bool:
    """Whether the equations are of the kind that this module knows."""
    return (
        isinstance(model.chain, Chain)
        and not model.effects
        and not model.instruments
        and all(p.place >= 0 and p.direction < 6 for p in parameters)
        and len(samples.kinds) == 1
        and is_direct(samples.kinds)
    )


class SerialSystem:
    """The equations of :class:`~modcal_core.calibration.system.System` for one serial arm."""

    quick_gradient = True

    def __init__(self, start: Model, parameters: Sequence[Parameter], samples: Samples) -> None:
        """start, parameters: see :func:`is_serial`."""
        chain = start.serial
        self._n, self._revolute = chain.n, chain.revolute
        self._M = np.array(chain.along_z[1:])
        self._M[-1] = self._M[-1] @ start.T_tip_tool
        self._T_frame_root = start.T_frame_base @ chain.T_base_root
        self._led = np.array([start.leader(f) for f in range(len(start.frames))])
        self._pose = bool(samples.is_pose[0])
        self._frame = samples.frame if len(start.frames) > 1 else None
        self._count = len(samples)
        self._q = np.ascontiguousarray(samples.q.T)
        self._y = np.ascontiguousarray(samples.position.T)
        # measured axes, (3, 3, N): component, then axis
        self._R = np.ascontiguousarray(samples.R.transpose(1, 2, 0)) if self._pose else np.empty((3, 3, 0))
        self._c, self._s = np.empty((2, *self._q.shape))
        np.cos(self._q, out=self._c)
        np.sin(self._q, out=self._s)
        self._place = np.array([p.place for p in parameters], dtype=int)
        self._direction = np.array([p.direction for p in parameters], dtype=int)
        self._of_frame = np.array([max(p.frame, 0) for p in parameters], dtype=int)
        # row of each parameter's place: those in front of the arm, then places 1 … n
        self._row = np.where(self._place == 0, self._of_frame, len(self._led) + self._place - 1)
        # columns are written place by place; where each parameter's stands
        self._order = np.argsort(self._place, kind="stable")
        self._ends = np.searchsorted(self._place[self._order], np.arange(self._n + 2))
        self._values: Array | None = None
        self._kept: list[Array] = []

    def residuals(self, values: Array) -> Linearised:
        """Residuals, without derivatives."""
        self._stand_at(values)
        N = self._count
        position, rotation = np.empty((3, N)), np.empty((3, N if self._pose else 0))
        keep = N <= _KEPT
        self._kept = []
        for rows in self._blocks():
            t = self._sweep(rows)
            if keep:
                self._kept.append(t)
            np.subtract(self._from_root(self._y[:, rows], rows, shift=True), t[0, :, 0], out=position[:, rows])
            if self._pose:
                rotation[:, rows] = self._turn(rows, t[0])
        self._position, self._rotation = position, rotation
        return Linearised(position, rotation, np.empty((0, position.size + rotation.size)))

    def gradient(self, values: Array, row_weight: Array) -> Array:
        """JᵀWr alone, (P,)."""
        self._require(values)
        N, frames = self._count, len(self._led)
        total = np.zeros((self._n + 1, 6))
        ahead = np.zeros((frames, 6))  # what place 0 feels, frame by frame
        w_p, w_r = row_weight[:N], row_weight[3 * N : 4 * N]
        for i, rows in enumerate(self._blocks()):
            t = self._kept[i] if self._kept else self._sweep(rows)
            force = self._position[:, rows] * w_p[rows]
            torque = self._rotation[:, rows] * w_r[rows] if self._pose else None
            total += moments(self._now, self._postures(rows), t[:, :, 0], force, torque)
            if frames > 1:
                felt = np.concatenate([force, so3.cross(t[0, :, 0], force) + (0.0 if torque is None else torque)])
                for f in range(frames):
                    ahead[f] += felt[:, self._led[self._frame[rows]] == f].sum(axis=1)  # type: ignore[index]
        felt = total[self._place]
        if frames > 1:
            felt[self._place == 0] = ahead[self._of_frame[self._place == 0]]
        return np.einsum("pi,pi->p", self._twists, felt)

    def normal_equations(self, values: Array, row_weight: Array) -> tuple[Array, Array]:
        """(JᵀWJ, JᵀWr) with these weights of the rows, (3 N + 3 M,)."""
        self._require(values)
        N, P = self._count, len(self._place)
        turning = self._turning
        root_p = np.sqrt(row_weight[:N])
        H, g = np.zeros((P, P)), np.zeros(P)
        H_turn, g_turn = np.zeros((len(turning), len(turning))), np.zeros(len(turning))
        if self._pose:
            # the axes carry the weight of positions; where that is nothing, so is that of the turn
            root_r = np.sqrt(row_weight[3 * N : 4 * N])
            ratio = np.divide(root_r, root_p, out=np.zeros(N), where=root_p > 0.0)
        for i, rows in enumerate(self._blocks()):
            t = self._kept[i] if self._kept else self._sweep(rows)
            for part in _slices(rows.start, rows.stop, COLUMNS):
                here = slice(part.start - rows.start, part.stop - rows.start)
                J, J_turn = self._columns(part, t[:, :, 0, here], root_p[part])
                H += J @ J.T
                g += J @ (self._position[:, part] * root_p[part]).ravel()
                if self._pose:
                    J_turn.reshape(len(turning), 3, -1)[...] *= ratio[part]
                    H_turn += J_turn @ J_turn.T
                    g_turn += J_turn @ (self._rotation[:, part] * root_r[part]).ravel()
        if self._pose:
            H[np.ix_(turning, turning)] += H_turn
            g[turning] += g_turn
        back = np.argsort(self._order)
        return H[np.ix_(back, back)], g[back]

    def _columns(self, rows: slice, t: Array, root: Array) -> tuple[Array, Array]:
        """Weighted columns of the positions (P, 3 B), and of the orientations (turning ones, 3 B), in our order."""
        B, at = len(root), self._postures(rows)
        J = np.empty((len(self._place), 3 * B))
        J_turn = np.empty((len(self._turning) if self._pose else 0, 3 * B))
        units, other = np.empty((6, 3, B)), np.empty((6, 3, B))
        units[:3] = np.eye(3)[:, :, None] * root
        twists, written = self._twists[self._order], 0
        for k in range(self._n + 1):
            a, b = self._ends[k], self._ends[k + 1]
            if k < self._n:
                unit_turns(units[:3], t[k], out=units[3:])
                np.matmul(twists[a:b], units.reshape(6, -1), out=J[a:b])
            else:
                np.matmul(twists[a:b, :3], units[:3].reshape(3, -1), out=J[a:b])
            if self._pose:
                some = np.flatnonzero(twists[a:b, 3:].any(axis=1))
                J_turn_k = J_turn[written : written + len(some)]
                np.matmul(twists[a:b][some, 3:], units[:3].reshape(3, -1), out=J_turn_k)
                if k == 0:
                    self._only_own_frame(rows, self._order[a:b][some], J_turn_k)
                written += len(some)
            if k == 0:
                self._only_own_frame(rows, self._order[a:b], J[a:b])
            if k < self._n:
                outward(units[:3], k, self._now, at, out=other[:3])
                units, other = other, units
        return J, J_turn

    def _only_own_frame(self, rows: slice, parameters: np.ndarray, J: Array) -> None:
        """Make columns of frames' errors zero for samples of other frames."""
        if self._frame is None:
            return
        own = self._of_frame[parameters][:, None] == self._led[self._frame[rows]]
        J.reshape(len(parameters), 3, -1)[...] *= own[:, None]

    def _stand_at(self, values: Array) -> None:
        """Put values into the constants."""
        errors = np.zeros((len(self._led) + self._n, 6))
        frames = len(self._led)
        row = self._row
        np.add.at(errors, (row, self._direction), values)
        errors[:frames] = errors[self._led]
        R, L = so3.exp(errors[:, 3:]), so3.left_jacobian(errors[:, 3:])
        E = se3.transform(R, errors[:, :3])
        self._now = self._M @ E[frames:]
        T = se3.inverse(self._T_frame_root @ E[:frames])
        self._T_root_frame = T
        # row d of a place: the twist per unit of its value d (see linearise.local_twists)
        twists = np.zeros((len(errors), 6, 6))
        twists[:, :3, :3], twists[:, 3:, 3:] = R, L
        self._twists = twists[row, self._direction]
        self._turning = np.flatnonzero(self._twists[self._order, 3:].any(axis=1))
        self._values = np.array(values)

    def _require(self, values: Array) -> None:
        """Residuals at these values must be at hand."""
        if self._values is None or not np.array_equal(values, self._values):
            self.residuals(values)

    def _blocks(self) -> list[slice]:
        return _slices(0, self._count, BLOCK)

    def _postures(self, rows: slice) -> Postures:
        return Postures(self._c[:, rows], self._s[:, rows], self._q[:, rows], self._revolute)

    def _sweep(self, rows: slice) -> Array:
        return tool_in_places(self._now, self._postures(rows), self._pose)

    def _from_root(self, vectors: Array, rows: slice, shift: bool = False) -> Array:
        """Vectors of the readings' frames (3, …, B), seen from the root."""
        if self._frame is None:
            R, p = self._T_root_frame[0, :3, :3], self._T_root_frame[0, :3, 3]
            out = (R @ vectors.reshape(3, -1)).reshape(vectors.shape)
            return out + p[:, None] if shift else out
        T = self._T_root_frame[self._frame[rows]]
        out = np.einsum("nij,j...n->i...n", T[:, :3, :3], vectors)
        return out + T[:, :3, 3].T if shift else out

    def _turn(self, rows: slice, tool: Array) -> Array:
        """``log(R_y Rᵀ)``, (3, B): by half the sum of the cross products of predicted and measured axes."""
        seen = self._from_root(self._R[:, :, rows], rows)
        x, y = tool[:, 1], tool[:, 2]
        z = so3.cross(x, y)
        v = so3.cross(x, seen[:, 0])
        v += so3.cross(y, seen[:, 1])
        v += so3.cross(z, seen[:, 2])
        v *= 0.5
        square = np.einsum("cb,cb->b", v, v)
        trace = sum(np.einsum("cb,cb->b", a, seen[:, d]) for d, a in enumerate((x, y, z)))
        far = (square > _TURNED**2) | (trace < 1.0)
        sine = np.sqrt(np.where(far, 0.0, square))
        out = v * np.where(sine > 1e-8, np.arcsin(sine) / np.maximum(sine, 1e-300), 1.0)
        if far.any():
            R = np.stack([x, y, z], axis=1)[:, :, far].transpose(2, 0, 1)  # columns are the axes
            out[:, far] = so3.log(seen[:, :, far].transpose(2, 0, 1) @ np.swapaxes(R, 1, 2)).T
        return out


def _slices(first: int, end: int, most: int) -> list[slice]:
    return [slice(a, min(a + most, end)) for a in range(first, end, most)]
