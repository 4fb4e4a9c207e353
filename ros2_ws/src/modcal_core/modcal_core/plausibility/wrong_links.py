"""One link of the description that is not the robot's: other length, turn or axis, or another module.

Orientations do not ask how long links are, so whether they agree is asked first. Where they do, they tell how base and
tool are turned, and places are linear in the offsets of all joints. Where they do not, the axis or the turn of each
joint's origin is changed until they do; among joints about parallel axes many changes do, and places, which are then
asked with and without an offset at the same joint, tell which of them it is. If none of them does, no joint is named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.calibration import base_and_tool_turns, turns_left
from modcal_core.geometry import Array, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.plausibility.agreement import ANGLE, OF_REACH, Disagreement
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

_MIN, _MAX = 40, 400  # stations; as few as tell base, tool and a link's pose, and more than these say the same
_FEW = 60  # stations to which turns are fitted
_WRONG_LENGTH = 0.02  # of the reach
_ROUNDS, _SIFTED = 12, 3  # iterations, and after how many only a joint's best starts go on
_KEPT = 2  # of the 24 turns of a cube to start from, for each joint


@dataclass(frozen=True)
class _Change:
    """Another description of one joint: how far positions miss it, and the offset before the joint, (3,) [m]."""

    what: str
    remedy: str
    missed: float
    shift: Array


def wrong_link(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """The joint of the description that does not fit poses by one offset, axis, turn or whole link; None if none does.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = most_seen(samples, chain, _MIN, _MAX)
    if part is None or not is_serial_arm(chain) or not part.is_pose.all():
        return None
    try:
        return _Links(part, chain).found()
    except np.linalg.LinAlgError:
        return None


class _Links:
    """The links of a description, each asked whether another in its place explains poses of one frame."""

    def __init__(self, samples: Samples, chain: Chain) -> None:
        self.samples, self.chain = samples, chain
        self.limit = OF_REACH * chain.reach()  # m that a nominal arm misses by at most

    def found(self) -> Disagreement | None:
        A = forward(self.chain, self.samples.q)
        Y, X = base_and_tool_turns(A[:, :3, :3], self.samples.R)
        agree = np.median(np.linalg.norm(turns_left(Y, A[:, :3, :3], X, self.samples.R), axis=1)) < ANGLE
        return self._length(A, Y) if agree else self._turn()

    @cached_property
    def before(self) -> Array:
        """Turns of the frames that the joints' origins are given in, (n + 1, N, 3, 3)."""
        M, N = self.chain.origins[:, :3, :3], len(self.samples)
        out = [np.broadcast_to(np.eye(3), (N, 3, 3))]
        for k in range(self.chain.n):
            turn = self.samples.q[:, k, None] * self.chain.axes[k] if self.chain.revolute[k] else np.zeros((N, 3))
            out.append(out[-1] @ M[k] @ so3.exp(turn))
        return np.stack(out)

    # --- lengths -----------------------------------------------------------------------------------------------------

    def _length(self, A: Array, Y: Array) -> Disagreement | None:
        """One joint's origin that stands elsewhere, orientations being as the description has them; or several."""
        n = self.chain.n
        h = self.samples.reading - A[:, :3, 3] @ Y.T
        known = [np.broadcast_to(np.eye(3), self.before[0].shape), Y @ A[:, :3, :3]]
        if self._placed(known, h)[0] < self.limit:
            return None
        found: list[tuple[float, int, Array]] = []
        for j in range(1, n):
            miss, solution = self._placed([*known, Y @ self.before[j]], h)
            found.append((miss, j, solution[6:]))
        miss, j, shift = min(found, key=lambda f: f[0])
        if miss < self.limit and self._plain(shift):
            name = self.chain.names[j]
            return self._said(
                f"the origin of joint {name} in the URDF looks wrong by {_millimetres(shift)}, "
                "or the link before it is different",
                f"check <origin xyz> of {name}, and whether the description is that of this robot",
            )
        miss, solution = self._placed([*known, *(Y @ self.before[j] for j in range(1, n))], h)
        shifts = solution[6:].reshape(-1, 3)
        wrong = [self.chain.names[j + 1] for j, shift in enumerate(shifts) if self._plain(shift)]
        if miss > self.limit or not wrong:
            return None
        return self._said(
            f"orientations fit the URDF and lengths do not: look at the origins of {', '.join(wrong)}",
            "give the description of this robot, not of another size",
        )

    def _plain(self, shift: Array) -> bool:
        return bool(np.linalg.norm(shift) > _WRONG_LENGTH * self.chain.reach())

    def _placed(self, columns: list[Array], h: Array) -> tuple[float, Array]:
        """Median distance that places (N, 3) miss by, as sums of these turns (N, 3, 3) times constant vectors."""
        design = np.concatenate(columns, axis=2)
        flat = design.reshape(-1, design.shape[2])
        H = flat.T @ flat
        # what the readings do not show stays nominal
        solution = np.linalg.solve(H + 1e-6 * np.trace(H) / len(H) * np.eye(len(H)), flat.T @ h.ravel())
        return float(np.median(np.linalg.norm(h - design @ solution, axis=1))), solution

    # --- turns -------------------------------------------------------------------------------------------------------

    def _turn(self) -> Disagreement | None:
        """One joint's axis, or the turn of its origin, that is another; with the places that it asks for."""
        if not self.chain.revolute.any():
            return None
        axes, turns = self._axes(), self._turns()
        for changes in (
            [c for c in (self._axis_changed(j, u) for j, u in axes) if c is not None],
            [c for c in (self._turned(j, S, offset=False) for j, S in turns) if c is not None],
            [c for c in (self._turned(j, S, offset=True) for j, S in turns) if c is not None],
        ):
            if changes:
                best = min(changes, key=lambda c: c.missed)
                return self._said(best.what, best.remedy)
        several = [(missed, j) for j, S in turns if (missed := self._lengths_missed(j, S)) < self.limit]
        if not several:
            return None
        return self._said(
            "orientations and positions fit with another turn of the origin of joint "
            f"{self.chain.names[min(several)[1]]} and other lengths of several links, so that more than one link "
            "of the URDF is different",
            "give the description of this robot; of modules, check the kind, order and turn of each",
        )

    def _axes(self) -> list[tuple[int, Array]]:
        """Joints, and axes of theirs with which orientations agree."""
        R, q, left, right, joints = self._around()
        axes = [(j, s * e) for j in joints for e in np.eye(3) for s in (1.0, -1.0) if s * e @ self.chain.axes[j] < 0.99]
        missed = _missed(np.stack([left[j] @ so3.exp(q[:, j, None] * u) @ right[j] for j, u in axes]), R)
        return [axes[k] for k in np.flatnonzero(missed < ANGLE)]

    def _turns(self) -> list[tuple[int, Array]]:
        """Joints, and the turn (3, 3) before each joint's motion with which orientations agree."""
        R, q, left, right, joints = self._around()
        starts = _cube()
        which = np.repeat(joints, len(starts))
        S = np.tile(starts, (len(joints), 1, 1))
        L = np.stack([left[j] for j in which])
        T = np.stack([so3.exp(q[:, j, None] * self.chain.axes[j]) @ right[j] for j in which])
        for r in range(_ROUNDS):
            Y, X = base_and_tool_turns(L @ S[:, None] @ T, np.broadcast_to(R, T.shape))
            seen = np.swapaxes(L, -1, -2) @ np.swapaxes(Y, -1, -2)[:, None] @ R @ np.swapaxes(X, -1, -2)[:, None]
            S = so3.nearest_rotation(np.sum(seen @ np.swapaxes(T, -1, -2), axis=1))
            if r == _SIFTED:
                missed = _missed(L @ S[:, None] @ T, R)
                of_joint = (np.flatnonzero(which == j) for j in joints)
                keep = np.concatenate([rows[np.argsort(missed[rows])[:_KEPT]] for rows in of_joint])
                which, S, L, T = which[keep], S[keep], L[keep], T[keep]
        missed = _missed(L @ S[:, None] @ T, R)
        return [(int(which[k]), self._smallest(int(which[k]), S[k])) for k in np.flatnonzero(missed < ANGLE)]

    def _smallest(self, j: int, S: Array) -> Array:
        """The smallest turn that says the same: base and tool take up what is about the first and the last axis."""
        M = self.chain.origins[j, :3, :3]
        if j == 1 and self.chain.revolute[0]:
            S = M.T @ _unwound(self.chain.axes[0], M @ S @ M.T) @ M
        if j == self.chain.n - 1:
            S = _unwound(self.chain.axes[j], S.T).T
        return S

    def _around(self) -> tuple[Array, Array, dict[int, Array], dict[int, Array], list[int]]:
        """Orientations and joint positions at some stations, and the turns before and behind each joint that turns."""
        few = spread_rows(len(self.samples), _FEW)
        A, M = forward(self.chain, self.samples.q[few])[:, :3, :3], self.chain.origins[:, :3, :3]
        joints = [j for j in range(self.chain.n) if self.chain.revolute[j]]
        left = {j: self.before[j][few] @ M[j] for j in joints}
        right = {j: np.swapaxes(self.before[j + 1][few], 1, 2) @ A for j in joints}
        return self.samples.R[few], self.samples.q[few], left, right, joints

    def _axis_changed(self, j: int, axis: Array) -> _Change | None:
        axes = self.chain.axes.copy()
        axes[j] = axis
        name = self.chain.names[j]
        return self._change(
            replace(self.chain, axes=axes),
            j,
            False,
            f"joint {name} looks as if it turned about {_vector(axis)} in its frame and not about "
            f"{_vector(self.chain.axes[j])}",
            f"check <axis> of {name} in the URDF",
        )

    def _turned(self, j: int, S: Array, offset: bool) -> _Change | None:
        origins = self.chain.origins.copy()
        origins[j, :3, :3] = origins[j, :3, :3] @ S
        name = self.chain.names[j]
        angle = np.degrees(float(np.linalg.norm(so3.log(S))))
        if not offset:
            what = f"the origin of joint {name} in the URDF looks turned by {angle:.3g}°, or its zero is different"
            remedy = f"check <origin rpy> of {name} (order, degrees, sign), and the joint's zero"
            return self._change(self.chain.with_origins(origins), j, offset, what, remedy)
        change = self._change(self.chain.with_origins(origins), j, offset, "", "")
        if change is None or not self._plain(change.shift):
            return None
        return replace(
            change,
            what=f"the link before joint {name} is another than in the URDF: its origin looks turned by "
            f"{angle:.3g}° and wrong by {_millimetres(change.shift)}",
            remedy=f"check <origin> of {name}; of modules, the kind and turn of what stands before it",
        )

    def _change(self, chain: Chain, j: int, offset: bool, what: str, remedy: str) -> _Change | None:
        """A change with which positions agree as well, with an offset before joint j or without one."""
        if offset and j == 0:  # an offset of the first joint is one of the base
            return None
        A = forward(chain, self.samples.q)
        Y, _ = base_and_tool_turns(A[:, :3, :3], self.samples.R)
        h = self.samples.reading - A[:, :3, 3] @ Y.T
        columns = [np.broadcast_to(np.eye(3), self.before[0].shape), Y @ A[:, :3, :3]]
        missed, solution = self._placed([*columns, Y @ self.before[j]] if offset else columns, h)
        return _Change(what, remedy, missed, solution[6:]) if missed < self.limit else None

    def _lengths_missed(self, j: int, S: Array) -> float:
        """What positions miss by [m] with another turn of a joint's origin and offsets before all joints."""
        origins = self.chain.origins.copy()
        origins[j, :3, :3] = origins[j, :3, :3] @ S
        other = _Links(self.samples, self.chain.with_origins(origins))
        A = forward(other.chain, self.samples.q)
        Y, _ = base_and_tool_turns(A[:, :3, :3], self.samples.R)
        columns = [np.broadcast_to(np.eye(3), A[:, :3, :3].shape), Y @ A[:, :3, :3]]
        columns += [Y @ other.before[k] for k in range(1, self.chain.n)]
        return self._placed(columns, self.samples.reading - A[:, :3, 3] @ Y.T)[0]

    def _said(self, what: str, remedy: str) -> Disagreement:
        return Disagreement(what, remedy, len(self.samples), len(self.samples))


def _missed(a: Array, R: Array) -> Array:
    """Median angles [rad], (K,), that turns (K, N, 3, 3) of the tip miss (N, 3, 3) by, base and tool being free."""
    R = np.broadcast_to(R, a.shape)
    Y, X = base_and_tool_turns(a, R)
    return np.asarray(np.median(np.linalg.norm(turns_left(Y, a, X, R), axis=-1), axis=-1))


def _unwound(axis: Array, S: Array) -> Array:
    """exp(θ axis) S (3, 3) with the θ that leaves the smallest angle: its trace is greatest, a sine in θ."""
    along = float(axis @ S @ axis)
    theta = np.arctan2(float(np.trace(so3.hat(axis) @ S)), float(np.trace(S)) - along)
    return np.asarray(so3.exp(theta * axis) @ S)


def _millimetres(shift: Array) -> str:
    return f"({', '.join(f'{1e3 * v:.0f}' for v in shift)}) mm"


def _vector(axis: Array) -> str:
    return " ".join(f"{v:g}" for v in axis + 0.0)


def _cube() -> Array:
    """The 24 turns of a cube, (24, 3, 3)."""
    return Rotation.create_group("O").as_matrix()
