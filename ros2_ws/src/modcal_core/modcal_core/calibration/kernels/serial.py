"""Equations of a serial arm without effects that is watched by points or by poses: quick, block by block.

The plain version is :func:`~modcal_core.calibration.linearisation.linearise` with
:func:`~modcal_core.calibration.equations.normal_equations`. What makes this one quick:

* turns of the joints are computed once, as complex numbers, for they do not change with the values (see :mod:`turns`);
* residual and gradient come from two sweeps along the chain (see :mod:`sweeps`), without a Jacobian;
* the curvature comes from as few columns as there are different ones (see :mod:`columns`), made with the square roots
  of the weights in them, so that it is one symmetric product; those of turns are among them;
* blocks stay in the cache, and memory flat.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.kernels import turns
from modcal_core.calibration.kernels.columns import columns_of
from modcal_core.calibration.kernels.sweeps import (
    Constants,
    PostureBlock,
    moments,
    orientation_of_tool,
    sums,
    sums_in_places,
    tool_in_places,
    wrench_on_tool,
)
from modcal_core.calibration.linearisation import Linearised
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import is_serial_arm

BLOCK = 4096  # samples in a sweep
COLUMNS = 2048  # samples whose columns are made at once; they fit the cache of one core
_KEPT = 4 * BLOCK  # samples whose sweep is kept from residual to gradient; beyond, it is made again
_ALIKE = 1e-13  # relative differences of weights that are rounding


def is_serial(model: Model, samples: Samples, parameters: Sequence[ModelParameter]) -> bool:
    """Whether the equations are of the kind that this module knows."""
    return (
        is_serial_arm(model.chain)
        and not model.effects
        and not model.instruments
        and all(p.place >= 0 and p.direction < 6 for p in parameters)
        and len(samples.kinds) == 1
        and is_direct(samples.kinds)
    )


class SerialSystem:
    """The equations of :class:`~modcal_core.calibration.equations.System` for one serial arm."""

    quick_gradient = True

    def __init__(self, start: Model, parameters: Sequence[ModelParameter], samples: Samples) -> None:
        """start, parameters: see :func:`is_serial`."""
        chain = start.serial
        self._n, self._revolute = chain.n, tuple(chain.revolute.tolist())
        self._M = np.array(chain.along_z[1:])
        self._M[-1] = self._M[-1] @ start.T_tip_tool
        self._T_frame_root = start.T_frame_base @ chain.T_base_root
        self._led = np.array([start.leader(f) for f in range(len(start.frames))])
        self._frame = samples.frame if len(start.frames) > 1 else None
        self._count = N = len(samples)
        self._pose = bool(samples.is_pose[0])
        self._q = samples.q
        angles = np.ascontiguousarray(samples.q.T)
        self._half = turns.unit(0.5 * angles) if self._pose else np.empty((chain.n, 0), dtype=complex)
        self._turn = self._half * self._half if self._pose else turns.unit(angles)
        self._y = np.ones((N, 4))
        self._y[:, :3] = samples.reading
        self._orientation = turns.quaternions(samples.R) if self._pose else None
        where = np.array([(p.place, p.direction, max(p.frame, 0)) for p in parameters], dtype=int).reshape(-1, 3)
        self._place, self._direction, self._of_frame = where.T
        # row of each parameter's place: those in front of the arm, then places 1 … n
        self._row = np.where(self._place == 0, self._of_frame, len(self._led) + self._place - 1)
        self._columns = columns_of(self._revolute, len(self._led), self._pose)
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
            at = self._postures(rows)
            t = tool_in_places(self._constants, at)
            if keep:
                self._kept.append(t)
            position[:, rows] = (self._reading(rows) - t[0])[:, :3].T
            if self._pose:
                tool = orientation_of_tool(self._constants, at)
                rotation[:, rows] = turns.log_between(self._measured_orientation(rows), tool)
        self._position, self._rotation = position, rotation
        return Linearised(position, rotation, np.empty((0, position.size + rotation.size)))

    def gradient(self, values: Array, row_weight: Array) -> Array:
        """JᵀWr alone, (P,)."""
        self._require(values)
        N, frames = self._count, len(self._led)
        total = np.zeros((self._n + 1, 1 + self._pose, 4, 4))
        ahead = np.zeros((frames, 1 + self._pose, 4, 4))  # the same of place 0, frame by frame
        w_p, w_r = row_weight[:N], row_weight[3 * N : 4 * N]
        for i, rows in enumerate(self._blocks()):
            at = self._postures(rows)
            t = self._kept[i] if self._kept else tool_in_places(self._constants, at)
            torque = self._rotation[:, rows] * w_r[rows] if self._pose else None
            wrench = wrench_on_tool(self._position[:, rows] * w_p[rows], torque)
            if self._frame is not None:
                for f in range(frames):
                    own = self._led[self._frame[rows]] == f
                    ahead[f] += sums(t[0, own], wrench[:, own])
            total += sums_in_places(self._constants, at, t, wrench)
        felt = moments(total)[self._place]
        if frames > 1:
            felt[self._place == 0] = moments(ahead)[self._of_frame[self._place == 0]]
        return np.asarray((self._twists * felt).sum(axis=1))

    def normal_equations(self, values: Array, row_weight: Array) -> tuple[Array, Array]:
        """(JᵀWJ, JᵀWr) with these weights of the rows, (3 N + 3 M,)."""
        self._require(values)
        N, columns = self._count, self._columns
        w_p, w_r = row_weight[:N], row_weight[3 * N : 4 * N]
        root = np.sqrt(w_p)
        # the residuals stand behind the columns, so that one product gives the gradient too
        rows_of_U = columns.count + 1 + self._pose
        products, G_turn = np.zeros((rows_of_U, rows_of_U)), np.zeros((columns.axes, columns.axes))
        alike, ratio = True, 0.0
        if self._pose:
            # the axes carry the weight of positions; where that is nothing, so is that of the turn
            ratios = np.sqrt(np.divide(w_r, w_p, out=np.zeros(N), where=w_p > 0.0))
            ratio = float(ratios.max(initial=0.0))
            alike = bool(np.all((ratios >= ratio * (1.0 - _ALIKE)) | (w_p == 0.0)))
        buffer = np.empty(rows_of_U * 3 * min(COLUMNS, N))
        for i, rows in enumerate(self._blocks()):
            t = self._kept[i] if self._kept else tool_in_places(self._constants, self._postures(rows))
            for part in _slices(rows.start, rows.stop, COLUMNS):
                B = part.stop - part.start
                U = buffer[: rows_of_U * 3 * B].reshape(rows_of_U, 3, B)
                frame = None if self._frame is None else self._led[self._frame[part]]
                here = slice(part.start - rows.start, part.stop - rows.start)
                columns.write(self._M_now, self._postures(part), t[:, here], root[part], frame, out=U)
                np.multiply(self._position[:, part], root[part], out=U[columns.count])
                if self._pose:
                    np.multiply(self._rotation[:, part], ratios[part] ** 2 * root[part], out=U[-1])
                flat = U.reshape(rows_of_U, -1)
                products += flat @ flat.T
                if not alike:
                    U[: columns.axes] *= ratios[part]
                    G_turn += flat[: columns.axes] @ flat[: columns.axes].T
        G, g, g_turn = (products[: columns.count, a] for a in (slice(columns.count), columns.count, -1))
        if alike:
            G_turn = ratio**2 * G[: columns.axes, : columns.axes]
        A, A_turn = columns.combination(self._M_now, self._place, self._of_frame, self._twists)
        self._parts = (A @ G @ A.T, A_turn @ G_turn @ A_turn.T if self._pose else 0.0)
        self._weighed = (float(w_p.sum()), float(w_r.sum()))
        return self._parts[0] + self._parts[1], A @ g + (A_turn @ g_turn[: columns.axes] if self._pose else 0.0)

    def last_curvature(self, row_weight: Array) -> Array:
        """JᵀWJ, (P, P), of the last normal equations, scaled as the weights have been since, on the whole."""
        N = self._count
        total = float(row_weight[:N].sum()), float(row_weight[3 * N : 4 * N].sum())
        position, turn = (now / max(before, 1e-300) for now, before in zip(total, self._weighed, strict=True))
        return position * self._parts[0] + turn * self._parts[1]

    def _stand_at(self, values: Array) -> None:
        """Put values into the constants."""
        frames = len(self._led)
        errors = np.bincount(6 * self._row + self._direction, values, 6 * (frames + self._n)).reshape(-1, 6)
        errors[:frames] = errors[self._led]
        R, L = so3.exp_and_left_jacobian(errors[:, 3:])
        E = se3.transform(R, errors[:, :3])
        self._M_now = self._M @ E[frames:]
        self._constants = Constants(self._M_now, self._pose)
        self._T_root_frame = se3.inverse(self._T_frame_root @ E[:frames])
        if self._pose:
            self._turn_root_frame = turns.quaternions(self._T_root_frame[:, :3, :3])
        # row d of a place: the twist per unit of its value d (see linearise.local_twists)
        twists = np.zeros((len(errors), 6, 6))
        twists[:, :3, :3], twists[:, 3:, 3:] = R, L
        self._twists = twists[self._row, self._direction]
        self._values = np.array(values)

    def _require(self, values: Array) -> None:
        """Residuals at these values must be at hand."""
        if self._values is None or not np.array_equal(values, self._values):
            self.residuals(values)

    def _blocks(self) -> list[slice]:
        return _slices(0, self._count, BLOCK)

    def _postures(self, rows: slice) -> PostureBlock:
        return PostureBlock(self._q[rows], self._turn[:, rows], self._half[:, rows], self._revolute)

    def _reading(self, rows: slice) -> Array:
        """Positions read, seen from the root, (B, 4) [m]."""
        if self._frame is None:
            return np.asarray(self._y[rows] @ np.ascontiguousarray(self._T_root_frame[0].T))
        return np.asarray(np.einsum("nij,nj->ni", self._T_root_frame[self._frame[rows]], self._y[rows]))

    def _measured_orientation(self, rows: slice) -> turns.Complex:
        """Orientations read, seen from the root, (B, 2)."""
        assert self._orientation is not None
        if self._frame is None:
            return (self._orientation[rows].view(float) @ turns.from_left(self._turn_root_frame[0])).view(complex)
        return turns.product(self._turn_root_frame[self._frame[rows]], self._orientation[rows])


def _slices(first: int, end: int, most: int) -> list[slice]:
    return [slice(a, min(a + most, end)) for a in range(first, end, most)]
