"""Stretches of a recording that cannot have had the same base and tool, with the arm itself taken as it stands.

A move of base or tool changes all stations from there on, by any amount. A fit that knows of one base and one tool only
meets most of them and takes the others for wrong readings, so nothing may be rejected before moves are looked for.
Short windows in order of time are each given a base or a tool of their own, or both, in closed form; each such *setup*
is tried on every station; and the cheapest sequence of setups is found by dynamic programming (Viterbi 1967), where a
change costs as much as a few stations that are missed by far. The stretches are then given setups again, and so on.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from modcal_core.calibration import Model, base_and_tool_turns, base_by_positions, procrustes, tool_and_place
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples
from modcal_core.robots import forward

_WINDOW = {True: 8, False: 12}  # stations that fix base and tool together: of poses, of points
_MAX_WINDOWS = 60  # for time; they overlap by half up to there
_FAR = 3.0  # usual misses beyond which a station is missed altogether
_CHANGE = 4.0 * _FAR**2  # a change must be worth as much as four stations that are missed altogether
_ROUNDS = 3  # of stretches and their base and tool
MAX_STRETCHES = 10  # more are no moves, but a motion

Stretches = list[tuple[int, int]]  # first, end, in order of time


@dataclass(frozen=True)
class Setup:
    """Where base and tool are in a stretch: ``reading = D · T_root_tip · X``, both (4, 4) [m], seen from the root.

    Of several stretches at once both are (W, 4, 4).
    """

    D: Array
    X: Array


@dataclass(frozen=True)
class SetupReadings:
    """Readings in order of time, seen from the root of an arm that is taken as it stands.

    A: poses of the tip (N, 4, 4). B: readings (N, 4, 4), orientations identity where there are none. poses: whether all
    have an orientation. lever: [m], what an angle is worth. stamps: [s], (N,). setup: where base and tool were thought
    to be.
    """

    A: Array
    B: Array
    poses: bool
    lever: float
    stamps: Array
    setup: Setup

    @classmethod
    def of(cls, model: Model, samples: Samples) -> SetupReadings:
        """What the samples, of positions or poses, show of a model's arm, its base and tool."""
        order = np.argsort(samples.stamps, kind="stable")
        A = se3.inverse(model.chain.T_base_root) @ forward(model.chain, samples.q[order])
        T_root_frame = se3.inverse(model.T_frame_base @ model.chain.T_base_root)
        reading = se3.transform(samples.R[order], samples.reading[order])
        lever = float(np.linalg.norm(A[:, :3, 3], axis=1).mean())
        return cls(
            *(A, T_root_frame[samples.frame[order]] @ reading, bool(samples.is_pose.all()), lever),
            *(samples.stamps[order], Setup(np.eye(4), model.T_tip_tool)),
        )

    def __len__(self) -> int:
        return len(self.A)

    def residual(self, setup: Setup) -> Array:
        """How far a setup misses each reading [m], (N,), angles by the lever."""
        gap = se3.error(setup.D @ self.A @ setup.X, self.B) * np.repeat([1.0, self.lever if self.poses else 0.0], 3)
        return np.asarray(np.linalg.norm(gap, axis=1))

    def tool(self, rows: np.ndarray, D: Array) -> Array:
        """The tools (..., 4, 4) that the readings of these rows (..., n) show best, the base being at D, (4, 4) or one
        for each reading, (..., n, 4, 4).
        """
        gap = se3.inverse(D @ self.A[rows]) @ self.B[rows]
        R = so3.mean(gap[..., :3, :3]) if self.poses else self.setup.X[:3, :3]
        return se3.transform(R, np.median(gap[..., :3, 3], axis=-2))

    def base(self, rows: np.ndarray, X: Array) -> Array:
        """The bases (..., 4, 4) that the readings of these rows (..., n) show best, the tool being at X, (4, 4) or one
        for each reading, (..., n, 4, 4).
        """
        T = self.A[rows] @ X
        if not self.poses:
            return procrustes(T[..., :3, 3], self.B[rows, :3, 3])
        R = so3.mean(self.B[rows, :3, :3] @ np.swapaxes(T[..., :3, :3], -1, -2))
        gap = self.B[rows, :3, 3] - T[..., :3, 3] @ np.swapaxes(R, -1, -2)
        return se3.transform(R, np.median(gap, axis=-2))

    def both(self, rows: np.ndarray) -> Setup:
        """Bases and tools that the readings of these rows (..., n) show best, in closed form."""
        A, B = self.A[rows], self.B[rows]
        p, stacked = B[..., :3, 3], (-1, rows.shape[-1])
        if self.poses:
            Y, X = base_and_tool_turns(A[..., :3, :3], B[..., :3, :3])
        else:
            Y, X = base_by_positions(A.reshape(*stacked, 4, 4), p.reshape(*stacked, 3)), self.setup.X[:3, :3]
            Y = Y.reshape(*rows.shape[:-1], 3, 3)
        _, x, t = tool_and_place(Y, A, p)
        return Setup(se3.transform(Y, t), se3.transform(np.broadcast_to(X, Y.shape), x))


def stretches(sights: SetupReadings) -> Stretches:
    """Stretches of readings, in order of time, that have a base, a tool or both of their own; one where nothing moved.

    Empty where there are more than a person would move base or tool in one recording.
    """
    N, window = len(sights), _WINDOW[sights.poses]
    if 2 * window > N:
        return [(0, N)]
    step = max(window // 2, (N - window) // _MAX_WINDOWS)
    windows = np.arange(0, N - window + 1, step)[:, None] + np.arange(window)
    setups = _setups(sights, windows)
    missed = np.stack([sights.residual(s) for s in setups])
    own = [missed[i::3][np.arange(len(windows))[:, None], windows] for i in range(3)]
    usual = max(float(np.median(np.sqrt(np.mean(np.square(own), axis=-1)).min(axis=0))), 1e-6)
    found: Stretches = [(0, N)]
    for _ in range(_ROUNDS):
        before, found = found, _cheapest(np.minimum(missed / usual, _FAR) ** 2)
        if len(found) > MAX_STRETCHES:
            return []
        if found == before:
            break
        largest = max(found, key=lambda part: part[1] - part[0])
        rows = np.arange(*largest)
        reference = sights.both(rows)
        again = [s for a, b in found for s in _setups(sights, np.arange(a, b)[None], reference)]
        missed = np.stack([sights.residual(s) for s in (reference, *again)])
        usual = max(float(np.sqrt(np.mean(missed[0, rows] ** 2))), 1e-6)
    return found


def _setups(sights: SetupReadings, rows: np.ndarray, near: Setup | None = None) -> list[Setup]:
    """What each of these windows (W, n) may have: a tool, a base, or, of enough stations, both of its own."""
    known = near or sights.setup
    kinds = [
        Setup(np.broadcast_to(known.D, (len(rows), 4, 4)), sights.tool(rows, known.D)),
        Setup(sights.base(rows, known.X), np.broadcast_to(known.X, (len(rows), 4, 4))),
    ]
    if rows.shape[1] >= _WINDOW[sights.poses]:
        kinds.append(sights.both(rows))
    return [Setup(kind.D[i], kind.X[i]) for i in range(len(rows)) for kind in kinds]


def _cheapest(cost: Array) -> Stretches:
    """Stretches of the cheapest sequence of setups, where each station has its cost (S, N) and each change one too."""
    S, N = cost.shape
    came = np.zeros((N, S), int)
    total = cost[:, 0].copy()
    for i in range(1, N):
        best = int(np.argmin(total))
        change = total[best] + _CHANGE < total
        came[i] = np.where(change, best, np.arange(S))
        total = np.where(change, total[best] + _CHANGE, total) + cost[:, i]
    state = np.empty(N, int)
    state[-1] = int(np.argmin(total))
    for i in range(N - 1, 0, -1):
        state[i - 1] = came[i, state[i]]
    edges = [0, *(np.flatnonzero(np.diff(state)) + 1).tolist(), N]
    return list(pairwise(edges))
