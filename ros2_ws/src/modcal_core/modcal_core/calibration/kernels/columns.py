"""The curvature JᵀWJ of a serial chain, from as few columns as there are different ones.

A twist at place k moves the tool by its shift along the place's axes and its turn about them. What a joint lets through
need not have columns there: a turn or shift along a revolute joint's axis, or any shift and that turn at a sliding one,
is the same twist seen behind the joint, where it stands still (see :mod:`parameters`). So a place has the columns

    x, y  and  e_x × t, e_y × t         (axes, and what turns about them do to the tool t, seen from the root),

the tool's place x, y, z, and every parameter is a constant combination of these, found by carrying its twist from place
to place: ``J = A U`` and ``JᵀWJ = A (U W Uᵀ) Aᵀ``. Turns of the tool are made of the same axes.

In front of the arm, where an error concerns the samples of its frame only, all six columns are kept for each frame.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from modcal_core.calibration.kernels.sweeps import PostureBlock
from modcal_core.geometry import Array, so3

_SLIDES = [0, 1, 2, 5]  # directions that a sliding joint lets through
_THREE = np.arange(3)
# of which axis each part of a turned one is: c y, c x, s y, s x and z; x' = c x + s y and y' = c y − s x
_PARTS, _SIGNS = [1, 0, 0, 1, 2], np.array([1.0, 1.0, 1.0, -1.0, 1.0])


@lru_cache
def columns_of(revolute: tuple[bool, ...], frames: int, orientations: bool) -> DistinctColumns:
    """The columns of a chain with these joints; arms of one kind share them."""
    return DistinctColumns(revolute, frames, orientations)


class DistinctColumns:
    """The different columns U of a chain: first the axes of all places, then their turns. Nothing in it changes.

    frames: how many errors in front of the arm are told apart. axes: how many of the columns are axes.
    """

    def __init__(self, revolute: tuple[bool, ...], frames: int, orientations: bool) -> None:
        """revolute: of each joint. orientations: whether those of the tool are seen."""
        n = len(revolute)
        self._revolute = revolute
        self._ahead = frames if frames > 1 else 0  # frames that have columns of their own at place 0
        first = 3 * frames if self._ahead else 2
        at = [0, *range(first, first + 2 * n, 2)]  # where each place's columns begin, the tool's last
        self.axes = at[n] + 3
        self.count = self.axes + at[n]
        self._behind = at[1]
        # what a twist at each place is made of, (n + 1, 6, columns and, of the orientations, axes); a frame in front of
        # the arm is a place of its own, behind the others
        self._made = np.zeros((n + 1 + self._ahead, 6, self.count + (self.axes if orientations else 0)))
        two, three, turned = np.arange(2), np.arange(3), self.count
        for k in range(n):
            if revolute[k]:
                self._made[k, two, at[k] + two] = 1.0
            self._made[k, 3 + two, self.axes + at[k] + two] = 1.0
            if orientations:
                self._made[k, 3 + two, turned + at[k] + two] = 1.0
        self._made[n, three, at[n] + three] = 1.0
        if orientations:
            self._made[n, 3 + three, turned + at[n] + three] = 1.0
        for f in range(self._ahead):
            self._made[n + 1 + f, three, 3 * f + three] = 1.0
            self._made[n + 1 + f, 3 + three, self.axes + 3 * f + three] = 1.0
            if orientations:
                self._made[n + 1 + f, 3 + three, turned + 3 * f + three] = 1.0

    def combination(self, M: Array, place: np.ndarray, frame: np.ndarray, twists: Array) -> tuple[Array, Array]:
        """A of the positions (P, columns), and of the orientations (P, axes).

        M: (n, 4, 4). place, frame: of each parameter, (P,). twists: of each at its place, (P, 6).
        """
        n, made = len(M), self._made.copy()
        R = M[:, :3, :3]
        passing = np.zeros((n, 6, 6))  # of rows of twists, from place k to k + 1: Ad(M⁻¹)ᵀ
        passing[:, :3, :3] = passing[:, 3:, 3:] = R
        passing[:, 3:, :3] = so3.hat(M[:, :3, 3]) @ R
        for k in range(n - 1, 0 if self._ahead else -1, -1):
            through = slice(2, 6, 3) if self._revolute[k] else _SLIDES
            made[k, through] = passing[k, through] @ made[k + 1]
        row = np.where(place == 0, n + 1 + frame, place) if self._ahead else place
        A = (twists[:, None] @ made[row])[:, 0]
        return A[:, : self.count], A[:, self.count :]

    def write(self, M: Array, at: PostureBlock, t: Array, root: Array, frame: np.ndarray | None, out: Array) -> None:
        """Write the columns of a block of B postures, seen from the root, into out (count, 3, B).

        M: (n, 4, 4). t: the tool in the places, (n, B, 4). root: square roots of the samples' weights, (B,). frame: the
        one that each sample is watched from, where there are several.
        """
        n = at.n
        R = M[:, :3, :3].transpose(0, 2, 1)
        turning = R[:, :, _PARTS] * _SIGNS
        c, s = np.ascontiguousarray(at.turn.real), np.ascontiguousarray(at.turn.imag)
        parts = np.empty((5, 3, at.count))
        flat = parts.reshape(5, -1)
        product = np.empty((2, 3, at.count))
        tool = np.empty((3, 1, at.count))
        axes = out[:3] if frame is None else np.empty((3, 3, at.count))  # x, y, z of the place
        axes[:] = 0.0
        axes[_THREE, _THREE] = root
        first = 0
        for k in range(n):
            tool[:2, 0], tool[2, 0] = t[k, :, 1:3].T, t[k, :, 0]
            if k == 0 and frame is not None:
                self._write_ahead(axes, tool, frame, out)
                first = self._behind
            else:
                # z t_y − y t_z and x t_z − z t_x
                turned = out[self.axes + first : self.axes + first + 2]
                np.multiply(axes[2::-2], tool[:2], out=turned)
                turned -= np.multiply(axes[1:], tool[1:], out=product)
                first += 2
            behind = out[first : first + 3]  # its x takes the row of this one's z, which is no column
            if self._revolute[k]:
                np.multiply(axes[1::-1], c[k], out=parts[:2])
                np.multiply(axes[1::-1], s[k], out=parts[2:4])
                parts[4] = axes[2]
                np.matmul(turning[k], flat, out=behind.reshape(3, -1))
            else:
                behind[:] = (R[k] @ axes.reshape(3, -1)).reshape(axes.shape)
            axes = behind

    def _write_ahead(self, axes: Array, tool: Array, frame: np.ndarray, out: Array) -> None:
        """Write the columns in front of the arm, those of each frame for its own samples."""
        x, y, z = axes
        ty, tz, tx = tool[:, 0]
        turned = np.stack([z * ty - y * tz, x * tz - z * tx, y * tx - x * ty])
        for f in range(self._ahead):
            own = frame == f
            np.multiply(axes, own, out=out[3 * f : 3 * f + 3])
            np.multiply(turned, own, out=out[self.axes + 3 * f : self.axes + 3 * f + 3])
