"""The fit that the league's own methods share: six errors a place, corrections of joints, held near nominal by priors.

Damped least squares in sixteen steps with a normal prior for every parameter; the noise, and where it is asked for the
size of each group of parameters, are estimated along the way (empirical Bayes).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from league.arm import Arm, Array, align, cross, pose, quaternion_rotation, rotation, rotation_vector
from league.task import Task

STEPS = 16
FREE = 1e3  # prior of base and tool, m and rad: none
LENGTH, ANGLE = 3e-3, 5e-3  # prior of a link's errors, m and rad: above what makers leave
CHI95 = 7.815  # the 95 % point of χ² with three degrees of freedom
FINEST = 1e-7  # m, below which no noise is believed
Basis = Callable[[Arm, Array, Array], list[Array]]


def none(arm: Arm, q: Array, torque: Array) -> list[Array]:
    """No correction of any joint: for each, (N, 0)."""
    return [np.empty((len(q), 0)) for _ in arm.names]


@dataclass(frozen=True)
class Fit:
    """steps: of the arm as fitted. corrections: coefficients by joint. covariance: of all parameters. noise: standard
    deviation of a position [m]. left: residuals of the rows that were fitted (M, 3) [m], in the frame of ``predict``.
    """

    arm: Arm
    steps: Array
    basis: Basis
    corrections: list[Array]
    covariance: Array
    noise: float
    left: Array

    def predict(self, q: Array) -> tuple[Array, Array]:
        """Poses (N, 4, 4), and the radius (N,) [m] that 95 % of the errors should stay below."""
        frames, columns, _ = _columns(self, q)
        variance = np.sum((columns @ self.covariance) * columns, axis=(1, 2)) / 3.0 + self.noise**2
        return frames[:, -1], np.sqrt(CHI95 * variance)


def fit(task: Task, geometry: bool = True, basis: Basis = none, learn: bool = False, width: float = 3e-4) -> Fit:
    """The fit to the readings of a task.

    geometry: free the links, else base and tool only. basis: functions of the joints that correct each joint [rad],
    whose coefficients have a prior of this width. learn: estimate the widths of all groups but base and tool.
    """
    arm, q = task.arm, task.q[task.train]
    n = len(arm.names)
    steps = _placed(task, arm, q)
    sizes = [b.shape[1] for b in basis(arm, q, _torques(arm, arm.frames(q)))]
    prior = np.r_[np.tile(np.r_[np.full(3, LENGTH), np.full(3, ANGLE)], n + 1), np.full(sum(sizes), width)]
    groups = np.r_[np.repeat([0, 1], 3), np.tile(np.repeat([2, 3], 3), n - 1), np.repeat([4, 5], 3)]
    groups = np.r_[groups, 6 + np.repeat(np.arange(n), sizes)]
    ends = np.isin(groups, (0, 1, 4, 5))
    prior[ends] = FREE
    if task.kind != "pose":
        prior[np.flatnonzero(groups == 5)] = ANGLE  # a point shows no turn of the tool
    if task.kind == "socket":
        prior[ends & (groups < 2)] = 1e-9  # nothing shows the base
    if not geometry:
        prior[np.isin(groups, (2, 3))] = 1e-9
    x, scale = np.zeros(len(prior)), np.array([1e-3, 1e-3])
    now = Fit(arm, steps, basis, [np.zeros(size) for size in sizes], np.zeros((len(prior),) * 2), 0.0, np.empty((0, 3)))
    for step in range(STEPS):
        r, J, kinds = _rows(task, now, q)
        # what the parameters' own uncertainty makes of a residual counts, or noise would fall to nothing with few rows
        spread = r**2 + np.sum((J @ now.covariance) * J, axis=1)
        scale = np.array([np.sqrt(spread[kinds == k].mean()) if (kinds == k).any() else scale[k] for k in (0, 1)])
        scale = np.maximum(scale, FINEST)
        weight = np.where(kinds == 2, 1.0, 1.0 / scale[np.minimum(kinds, 1)])
        A = (J * weight[:, None]).T @ (J * weight[:, None])
        H = A + np.diag(prior**-2.0)
        unit = 1.0 / np.sqrt(np.diag(H))  # at unit diagonal, or metres beside radians cost the inverse its digits
        C = np.linalg.inv(H * np.outer(unit, unit)) * np.outer(unit, unit)
        # a step, not the values themselves: where little is left, rounding would be larger than it
        way = C @ ((J * weight[:, None]).T @ (weight * r) - x / prior**2)
        now, x = _moved(now, way, replace(now, covariance=C)), x + way
        if learn and step > 2:
            for g in np.unique(groups[~ends]):
                at = groups == g
                if prior[at].max() > 1e-8:
                    prior[at] = np.sqrt(np.mean(x[at] ** 2 + np.diag(C)[at]))
    r, J, kinds = _rows(task, now, q)
    spent = np.trace(C @ A) * np.mean(kinds == 0)
    freedom = max((kinds == 0).sum() - spent, 0.2 * (kinds == 0).sum())
    noise = float(np.sqrt((r[kinds == 0] ** 2).sum() / freedom))
    return replace(now, noise=noise, left=r[kinds == 0].reshape(-1, 3))


def _placed(task: Task, arm: Arm, q: Array) -> Array:
    """The nominal steps with base and tool put where they suit the readings."""
    steps, T = arm.steps.copy(), arm.frames(q)[:, -1]
    if task.kind == "socket":
        return steps
    if task.kind == "pose":
        R = quaternion_rotation(task.reading[:, 3:])
        base, tool = _hand_eye(T, pose(R, task.position))
        steps[0], steps[-1] = base @ steps[0], steps[-1] @ tool
        return steps
    base, tool = align(T, task.position)
    steps[0], steps[-1] = base @ steps[0], steps[-1] @ pose(np.eye(3), tool)
    return steps


def _hand_eye(T: Array, Y: Array) -> tuple[Array, Array]:
    """Base and tool (4, 4) so that Y ≈ base T tool."""
    base, t = align(T, Y[:, :3, 3])
    turns = np.swapaxes(base[:3, :3] @ T[:, :3, :3], 1, 2) @ Y[:, :3, :3]
    U, _, V = np.linalg.svd(turns.sum(axis=0))
    return base, pose(U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V, t)


def _torques(arm: Arm, frames: Array) -> Array:
    """Torques (N, n) of a unit weight at the tip about each joint, along the base's z [m]."""
    down = -frames[0, 0, :3, 2] if len(frames) else np.array([0.0, 0.0, -1.0])
    lever = frames[:, -1:, :3, 3] - frames[:, :-1, :3, 3]
    return np.einsum("nki,nki->nk", np.cross(lever, down), frames[:, :-1, :3, 2])


def _columns(now: Fit, q: Array) -> tuple[Array, Array, Array]:
    """Frames (N, n + 1, 4, 4) of the arm as it is now, and derivatives of the tip's position and turn (N, 3, K)."""
    arm = now.arm
    basis = now.basis(arm, q, _torques(arm, arm.frames(q)))
    corrected = q + np.stack([b @ c for b, c in zip(basis, now.corrections, strict=True)], axis=1)
    frames = arm.frames(corrected, now.steps)
    R, lever = frames[..., :3, :3], frames[:, -1:, :3, 3] - frames[..., :3, 3]

    def flat(v: Array, w: Array) -> Array:
        places = np.concatenate([v, w], axis=-1).transpose(0, 2, 1, 3).reshape(len(q), 3, -1)
        return np.concatenate([places, *(w[:, k, :, 2:3] * b[:, None, :] for k, b in enumerate(basis))], axis=2)

    return frames, flat(R, -cross(lever) @ R), flat(np.zeros_like(R), R)


def _rows(task: Task, now: Fit, q: Array) -> tuple[Array, Array, Array]:
    """Residuals, their derivative, and the kind of each row: 0 positions, 1 orientations, 2 known distances."""
    frames, J, turns = _columns(now, q)
    p, k = frames[:, -1, :3, 3], J.shape[2]
    if task.kind == "socket":
        return _socket_rows(task, p, J)
    r, rows = [(task.position - p).ravel()], [J.reshape(-1, k)]
    if task.kind == "pose":
        off = quaternion_rotation(task.reading[:, 3:]) @ np.swapaxes(frames[:, -1, :3, :3], 1, 2)
        r.append(rotation_vector(off).ravel())
        rows.append(turns.reshape(-1, k))
    return np.concatenate(r), np.concatenate(rows), np.repeat(np.arange(len(r)), [part.size for part in r])


def _socket_rows(task: Task, p: Array, J: Array) -> tuple[Array, Array, Array]:
    """The same of a ball in sockets: positions about their socket's mean, and the distances of sockets."""
    frame = task.frame[task.train]
    centre = {f: (p[frame == f].mean(axis=0), J[frame == f].mean(axis=0)) for f in np.unique(frame)}
    r = np.stack([centre[f][0] for f in frame]) - p
    rows = J - np.stack([centre[f][1] for f in frame])
    far, far_rows = [], []
    for a, b in task.pairs:
        gap = centre[a][0] - centre[b][0]
        size = np.linalg.norm(gap)
        far.append((task.distance - size) / 5e-5)
        far_rows.append(gap / size @ (centre[a][1] - centre[b][1]) / 5e-5)
    kinds = np.r_[np.zeros(r.size, int), np.full(len(far), 2)]
    return np.r_[r.ravel(), far], np.concatenate([rows.reshape(-1, rows.shape[2]), np.array(far_rows)]), kinds


def _moved(old: Fit, step: Array, now: Fit) -> Fit:
    """The fit with a step of its parameters made."""
    n = len(old.steps)
    twist, rest = step[: 6 * n].reshape(n, 6), step[6 * n :]
    steps = old.steps @ pose(rotation(twist[:, 3:]), twist[:, :3])
    cuts = np.cumsum([len(c) for c in old.corrections])[:-1]
    corrections = [c + d for c, d in zip(old.corrections, np.split(rest, cuts), strict=True)]
    return replace(now, steps=steps, corrections=corrections)
