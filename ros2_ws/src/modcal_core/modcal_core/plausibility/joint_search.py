"""The position of a joint as the readings tell it, where it was not as reported.

With the other joints given, an orientation tells the angle of a joint in closed form, and the place of the tool must
agree; of points, the turn about the joint's axis does. Two joints are solved for by Gauss-Newton steps. Where one joint
is wrong everywhere, its angles, base and tool are found in turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product

import numpy as np

from modcal_core.calibration import base_and_tool_turns, turns_left
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.plausibility.agreement import ANGLE, Disagreement, Placed
from modcal_core.plausibility.consensus import CLEARLY, Consensus
from modcal_core.robots import forward, spatial_jacobian

EXPLAINED = 0.8  # share of the rest that an explanation must bring back
_CLOSEST = 0.9  # share of angles that a circular deviation is taken of
_MORE = 0.3  # share of all stations that a joint's angles must bring back beyond those that agree as they are
_STARTS, _ROUNDS = 16, 25  # of a search for one joint's angles
_FEW = 40  # stations of the rest at which two joints are looked for
_BEGIN = (0.0, 2.1, -2.1)  # rad; thirds of a turn from what is reported, from which two joints are looked for
_STEPS, _LONGEST = 12, 0.7  # iterations, and how far one goes [rad]
_STILL = 1e-9  # rad
# What drivers publish instead of radians at the joint
_FACTORS = {
    "the other way round": -1.0,
    "in revolutions": 2.0 * np.pi,
    "in degrees": np.pi / 180.0,
    "twice as far": 0.5,
    "half as far": 2.0,
    "at the motor, before a gear of 100": 0.01,
    "at the motor, before a gear of 50": 0.02,
}


class JointSearch:
    """What joints were, by the stations of a consensus."""

    def __init__(self, among: Consensus) -> None:
        self._among = among

    def one(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """The rest with the position of one joint unknown."""
        part = self._among.samples.select(rest)
        for j in self._joints():
            q = self._solved(j, placed, part)
            share = float(self._among.within(placed, forward(self._among.chain, q), part).mean())
            if share >= EXPLAINED:
                return self._joint_said(j, rest, part.q[:, j], q[:, j])
        return None

    def two(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """The rest with the positions of two joints unknown, which four of the six numbers of a pose then prove."""
        if not self._among.poses:
            return None
        few = rest[spread_rows(len(rest), _FEW)]
        part = self._among.samples.select(few)
        for pair in combinations(self._joints(), 2):
            q = self._solved_two(list(pair), placed, part)
            if float(self._among.within(placed, forward(self._among.chain, q), part, CLEARLY).mean()) < EXPLAINED:
                continue
            names = " and ".join(part.names[j] for j in pair)
            where = f" at {self._among.stations(rest)}" if len(rest) < len(self._among.samples) else ""
            stale = np.ptp(part.q[:, pair], axis=0).max() < _STILL
            what = (
                f"joints {names} keep their reported positions{where} while they move: they look stale"
                if stale
                else f"joints {names} were not where they were reported{where}"
            )
            return self._among.said(rest, what, f"check how the positions of {names} get into joint_states")
        return None

    def throughout(self, before: float) -> Disagreement | None:
        """One joint that is off everywhere. before: share of the stations that agree as they are."""
        everything = np.arange(len(self._among.samples))
        best: tuple[float, int, Array] | None = None
        for j in self._joints():
            for q in self._unknown(j):
                placed = self._among.placed(forward(self._among.chain, q), self._among.samples)
                q = self._solved(j, placed, self._among.samples)
                share = float(self._among.within(placed, forward(self._among.chain, q), self._among.samples).mean())
                if share >= max(EXPLAINED, before + _MORE) and (best is None or share > best[0]):
                    best = share, j, q[:, j]
        if best is None:
            return None
        _, j, seen = best
        return self._joint_said(j, everything, self._among.samples.q[:, j], seen)

    def _joints(self) -> list[int]:
        return [j for j in range(self._among.chain.n) if self._among.chain.revolute[j]]

    def _solved(self, j: int, placed: Placed, part: Samples) -> Array:
        """Postures with the angle of joint j as the orientations tell it, or points where there are none."""
        q = part.q.copy()
        q[:, j] = 0.0
        T0 = forward(self._among.chain, q)
        q[:, j] = 1.0
        T1 = forward(self._among.chain, q)
        R0 = T0[:, :3, :3]
        turn = T1[:, :3, :3] @ np.swapaxes(R0, 1, 2)
        axis = so3.log(turn)
        if not self._among.poses:
            # a place on the axis, for the joint turns all behind it by one radian about it
            off = T1[:, :3, 3] - np.einsum("nij,nj->ni", turn, T0[:, :3, 3])
            on = np.einsum("nij,nj->ni", np.linalg.pinv(np.eye(3) - turn, rcond=1e-6), off)
            at, seen = se3.apply(T0, placed.x) - on, (part.reading - placed.t) @ placed.Y - on
            along = np.einsum("ni,ni->n", axis, at) * np.einsum("ni,ni->n", axis, seen)
            cross = np.einsum("ni,ni->n", axis, np.cross(at, seen))
            q[:, j] = np.arctan2(cross, np.einsum("ni,ni->n", at, seen) - along)
            return q
        B = R0 @ placed.X @ np.swapaxes(part.R, 1, 2) @ placed.Y
        along = np.einsum("ni,nij,nj->n", axis, B, axis)
        cross = np.einsum("nij,nji->n", so3.hat(axis), B)
        q[:, j] = np.arctan2(cross, np.trace(B, axis1=1, axis2=2) - along)
        return q

    def _solved_two(self, pair: list[int], placed: Placed, part: Samples) -> Array:
        """Postures with the positions of two joints that come nearest to the readings, from several starts."""
        best, q_best = np.full(len(part), np.inf), part.q.copy()
        scale = np.array(self._among.limit)
        for start in product(_BEGIN, repeat=2):
            q = part.q.copy()
            q[:, pair] += start
            for _ in range(_STEPS):
                A = forward(self._among.chain, q)
                J = spatial_jacobian(self._among.chain, q)[:, :, pair]
                point = se3.apply(A, placed.x)
                gap = part.reading - (point @ placed.Y.T + placed.t)
                turn = turns_left(placed.Y, A[:, :3, :3], placed.X, part.R)
                by_gap = placed.Y @ (J[:, :3] + np.cross(J[:, 3:], point[:, :, None], axis=1))
                by_turn = np.swapaxes(A[:, :3, :3] @ placed.X, 1, 2) @ J[:, 3:]
                G = np.concatenate([by_turn / scale[0], by_gap / scale[1]], axis=1)
                r = np.concatenate([turn / scale[0], gap / scale[1]], axis=1)
                H = np.swapaxes(G, 1, 2) @ G
                H += 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(2)
                step = np.linalg.solve(H, np.swapaxes(G, 1, 2) @ r[..., None])[..., 0]
                q[:, pair] += np.clip(step, -_LONGEST, _LONGEST)
            angle, distance = placed.residual(forward(self._among.chain, q), part)
            left = np.maximum(angle / scale[0], distance / scale[1])
            better = left < best
            best[better], q_best[better] = left[better], q[better]
        return q_best

    def _unknown(self, j: int) -> Iterator[Array]:
        """Postures with angles of joint j that the readings agree on, from several starts."""
        samples = self._among.samples
        for k in range(_STARTS if self._among.poses else _STARTS // 4):
            q = samples.q.copy()
            if k:
                q[:, j] = self._among.rng.uniform(-np.pi, np.pi, len(q)) * min(1.0, 0.15 * k)
            last = np.inf
            for _ in range(_ROUNDS):
                A = forward(self._among.chain, q)
                if self._among.poses:  # turns alone tell it, and are quicker
                    placed = Placed(*base_and_tool_turns(A[:, :3, :3], samples.R), np.zeros(3), np.zeros(3))
                else:
                    placed = self._among.placed(A, samples)
                q = self._solved(j, placed, samples)
                turned, gap = placed.residual(forward(self._among.chain, q), samples)
                left = float(np.median(turned if self._among.poses else gap))
                if left > 0.999 * last:
                    break
                last = left
            if last < self._among.limit[0 if self._among.poses else 1]:
                yield q
                return

    def _joint_said(self, j: int, rows: np.ndarray, reported: Array, seen: Array) -> Disagreement | None:
        name = self._among.samples.names[j]
        where = f" at {self._among.stations(rows)}" if len(rows) < len(self._among.samples) else ""
        remedy = f"check how the position of {name} gets into joint_states"
        swing = np.degrees(2.0 * _spread(seen))
        if np.ptp(self._among.samples.q[:, j]) < _STILL:
            what = (
                f"joint {name} is reported as standing still and moves by some {swing:.0f}°: "
                "its position is apparently never reported"
            )
            return self._among.said(rows, what, remedy)
        if np.ptp(reported) < _STILL:
            what = (
                f"joint {name} keeps its reported position{where} while it moves by some {swing:.0f}°: it looks stale"
            )
            return self._among.said(rows, what, remedy)
        if _spread(seen) < 2.0 * ANGLE:
            what = f"joint {name} moves{where} and the readings do not show it: tracker or reference move along with it"
            return self._among.said(rows, what, f"mount the tracker and its reference where {name} does not move them")
        off = seen - reported
        if _spread(off) < 2.0 * ANGLE:
            turn = np.degrees(np.angle(np.mean(np.exp(1j * off))))
            if abs(turn) < np.degrees(CLEARLY * ANGLE):  # it stands as reported: what is wrong is not this joint
                return None
            return self._among.said(
                rows, f"joint {name} reads {-turn:.1f}° too much{where}: its zero is different", remedy
            )
        for how, factor in _FACTORS.items():
            if _spread(seen - factor * reported) < 2.0 * ANGLE:
                return self._among.said(rows, f"joint {name} is apparently counted {how}{where}", remedy)
        return self._among.said(rows, f"joint {name} was not where it was reported{where}", remedy)


def _spread(angle: Array) -> float:
    """Circular deviation [rad] of the nine tenths of angles (N,) that are closest together."""
    off = np.angle(np.exp(1j * (angle - np.angle(np.mean(np.exp(1j * angle))))))
    off = np.sort(np.abs(off - np.median(off)))[: max(int(_CLOSEST * len(off)), 1)]
    return float(np.sqrt(np.mean(off**2)))
