"""Readings of which only a part agrees with the robot: which part, and what the rest looks like.

Where the model misses by far, or rejects many stations, the largest set of stations that agree on one base and one tool
is found by drawing a few stations at a time (RANSAC; Fischler & Bolles 1981). The rest is then read with each of the
:mod:`mistakes` undone, with another base or tool, and with the position of one joint taken as unknown: with the others
given, an orientation tells the angle of a joint in closed form, and the place of the tool must agree. Where no stations
agree, one joint may be wrong everywhere: then its angles, base and tool are found in turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from modcal_core.calibration.closed_form import base_and_tool_turns, base_by_positions, tool_and_place, turns_left
from modcal_core.calibration.runs import consecutive
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.plausibility.agreement import ANGLE, Disagreement, Placed, limits
from modcal_core.plausibility.mistakes import (
    Mistake,
    inverse_pose,
    of_axes,
    of_axes_of_the_pose,
    of_joints,
    of_rotations,
    of_several_joints,
    of_units,
)
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import spatial_jacobian
from modcal_core.robots.mechanism import Mechanism, forward, is_serial_arm

_CLEARLY = 2.0  # times both; what misses by less may be the arm's own error, or that of a few stations drawn
_DRAWN = 5  # stations
_DRAWS = 240  # with a third of the stations in agreement, one draw of five is all of them, 1 − (1 − 3⁻⁵)²⁴⁰ = 63 %
_LEAST = 12  # stations that must agree, and be explained
_LEAST_SHARE = 0.2  # of the stations that must agree, lest chance finds that many
_CLOSEST = 0.9  # share of angles that a circular deviation is taken of
_MOST_AGREE = 0.95  # where more do, single readings are wrong
_EXPLAINED = 0.8  # share of the rest that an explanation must bring back
_MORE = 0.3  # share of all stations that a joint's angles must bring back beyond those that agree as they are
_MOST = 160  # stations; more are thinned evenly
_STARTS, _ROUNDS = 16, 25  # of a search for one joint's angles
_FEW = 40  # stations of the rest at which two joints are looked for
_BEGIN = (0.0, 2.1, -2.1)  # rad; thirds of a turn from what is reported, from which two joints are looked for
_STEPS, _LONGEST = 12, 0.7  # iterations, and how far one goes [rad]
_STILL = 1e-9  # rad
_OTHER_UNIT = 0.02  # by which a scale must differ to be another unit, and may miss one that has a name
# of a metre
_UNITS = {"millimetres": 1e3, "centimetres": 1e2, "inches": 1.0 / 0.0254, "feet": 1.0 / 0.3048, "kilometres": 1e-3}
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


def placed_by_most(samples: Samples, chain: Chain) -> tuple[Placed | None, np.ndarray]:
    """The base and the tool that most of these stations agree on, None of too few, and which of them do, (N,)."""
    search = _Search(samples, chain)
    return search._largest(np.arange(len(samples)))


def disagreement(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """What looks wrong with the stations that do not agree with the others, None where nothing is found.

    samples: in a frame of several, that with most readings is looked at.
    """
    if not is_serial_arm(chain) or not len(samples):
        return None
    f = int(np.argmax(np.bincount(samples.frame)))
    rows = np.flatnonzero((samples.frame == f) & (samples.is_pose | (samples.kind == "point")) & ~samples.moving)
    if len(rows) < 2 * _LEAST or samples.frames[f] in samples.sockets:
        return None
    rows = rows[np.argsort(samples.stamps[rows], kind="stable")]
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MOST)).astype(int))]
    try:
        return _Search(samples.select(rows), chain).found()
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None


class _Search:
    """The stations of one frame, in order of time."""

    def __init__(self, samples: Samples, chain: Chain) -> None:
        self.samples, self.chain = samples, chain
        self.A = forward(chain, samples.q)
        self.poses = bool(samples.is_pose.all())
        self.limit = limits(chain)
        self.rng = np.random.default_rng(0)

    def found(self) -> Disagreement | None:
        everything = np.arange(len(self.samples))
        placed, agree = self._largest(everything)
        if agree.mean() > _MOST_AGREE:
            return None
        if placed is not None and agree.sum() >= max(_LEAST, _LEAST_SHARE * len(agree)):
            rest = np.flatnonzero(~self._within(placed, self.A, self.samples, _CLEARLY))
            if len(rest) >= _LEAST // 2:
                said = (
                    self._by_mistake(placed, rest, self._mistakes())
                    or self._turned(placed, rest)
                    or self._in_another_unit(placed, rest)
                    or self._elsewhere(placed, rest)
                    or self._one_joint(placed, rest)
                    or self._by_mistake(placed, rest, of_several_joints(self.samples.names))
                    or self._two_joints(placed, rest)
                )
                if said is not None:
                    return said
        return self._joint_throughout(float(agree.mean()))

    def _within(self, placed: Placed, A: Array, samples: Samples, times: float = 1.0) -> np.ndarray:
        angle, gap = placed.residual(A, samples)
        return (angle < times * self.limit[0]) & (gap < times * self.limit[1])

    def _placed(self, A: Array, samples: Samples) -> Placed:
        """Base and tool from these stations."""
        if self.poses:
            Y, X = base_and_tool_turns(A[:, :3, :3], samples.R)
        else:
            Y, X = base_by_positions(A[None], samples.reading[None])[0], np.eye(3)
        _, x, t = tool_and_place(Y, A, samples.reading)
        return Placed(Y, X, x, t)

    def _largest(self, rows: np.ndarray) -> tuple[Placed | None, np.ndarray]:
        """Base and tool that most of these stations agree on, and which of them do, (rows,)."""
        samples, A = self.samples.select(rows), self.A[rows]
        best, agree = None, np.zeros(len(rows), bool)
        drawn = _DRAWN if self.poses else _DRAWN + 3
        if len(rows) < drawn + 2:
            return best, agree
        for k in range(_DRAWS if self.poses else _DRAWS // 4):
            if k % 2:
                some = self.rng.choice(len(rows), drawn, replace=False)
            else:  # what changes at a time leaves neighbours alike
                first = int(self.rng.integers(max(len(rows) - 2 * drawn, 1)))
                some = first + self.rng.choice(min(2 * drawn, len(rows)), drawn, replace=False)
            placed = self._placed(A[some], samples.select(some))
            inside = self._within(placed, A, samples, _CLEARLY)
            if inside.sum() > agree.sum():
                best, agree = placed, inside
        for _ in range(3):
            if agree.sum() > drawn:
                best = self._placed(A[agree], samples.select(np.flatnonzero(agree)))
                agree = self._within(best, A, samples)
        return best, agree

    def _by_mistake(self, placed: Placed, rest: np.ndarray, mistakes: Iterator[Mistake]) -> Disagreement | None:
        part = self.samples.select(rest)
        best, named = _EXPLAINED, None
        for mistake in mistakes:
            undone = mistake.undone(part)
            A = forward(self.chain, undone.q) if mistake.touches == "joints" else self.A[rest]
            share = float(self._within(placed, A, undone).mean())
            if share > best:
                best, named = share, mistake
        if named is None:
            return None
        return self._said(rest, f"{named.offender} at {self._stations(rest)}, and not at the others", named.remedy)

    def _mistakes(self) -> Iterator[Mistake]:
        yield from of_units()
        yield from of_axes()
        yield from of_joints(self.samples.names)
        if self.poses:
            yield inverse_pose()
            yield from of_axes_of_the_pose()
            yield from of_rotations()

    def _turned(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """Positions of the rest that agree, and orientations that are turned by one angle about one axis."""
        if not self.poses:
            return None
        A, R = self.A[rest, :3, :3], self.samples.R[rest]
        gap = placed.residual(self.A[rest], self.samples.select(rest))[1]
        if (gap < _CLEARLY * self.limit[1]).mean() < _EXPLAINED:
            return None
        expected = placed.Y @ A @ placed.X
        best, named, about = _EXPLAINED, np.eye(3), ""
        for off, frame in (
            (R @ np.swapaxes(expected, 1, 2), "the tracker"),
            (np.swapaxes(expected, 1, 2) @ R, "the tool"),
        ):
            cosine = 0.5 * (np.einsum("nij,kij->nk", off, off) - 1.0)
            alike = (cosine > np.cos(_CLEARLY * self.limit[0])).mean(axis=1)
            k = int(np.argmax(alike))
            if alike[k] > best:
                best, named, about = float(alike[k]), off[k], frame
        if not about:
            return None
        turn = so3.log(named)
        angle = float(np.linalg.norm(turn))
        axis = ", ".join(f"{v:.2f}" for v in turn / max(angle, 1e-12) + 0.0)
        return self._said(
            rest,
            f"orientations look turned by {np.degrees(angle):.4g}° about ({axis}) of {about} "
            f"at {self._stations(rest)}, and positions agree",
            "check how orientations are computed (an angle that is folded or of which the sign is lost), and whether "
            "the target looks alike from several sides",
        )

    def _in_another_unit(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """The rest with positions that are one number times as long as they should be."""
        expected = se3.apply(self.A[rest], placed.x) @ placed.Y.T + placed.t
        seen = self.samples.reading[rest]
        factor = float(np.median(np.sum(seen * expected, axis=1) / np.sum(expected**2, axis=1)))
        if abs(factor - 1.0) < _OTHER_UNIT or abs(factor) < 1e-9:
            return None
        part = replace(self.samples.select(rest), reading=seen / factor)
        if self._within(placed, self.A[rest], part, _CLEARLY).mean() < _EXPLAINED:
            return None
        unit = next((f" ({name})" for name, size in _UNITS.items() if abs(factor / size - 1.0) < _OTHER_UNIT), "")
        return self._said(
            rest,
            f"positions look {factor:.4g} times as long as the others, in another unit{unit}, "
            f"at {self._stations(rest)}",
            "write all positions in metres",
        )

    def _elsewhere(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """The rest with a base, a tool, or both of its own."""
        other, agree = self._largest(rest)
        if other is None or agree.sum() < _LEAST // 2 or agree.mean() < _EXPLAINED:
            return None
        tool = replace(placed, Y=other.Y, t=other.t), "the base (or the tracker) is displaced"
        base = replace(placed, X=other.X, x=other.x), "the tool (or the target on it) is displaced"
        part, A = self.samples.select(rest), self.A[rest]
        said = next(
            (text for one, text in (tool, base) if self._within(one, A, part).mean() >= _EXPLAINED),
            "base and tool are both displaced",
        )
        remedy = (
            "check whether two trackers or targets publish under one name; give each part its own frame or recording"
        )
        joint = self._one_joint(placed, rest)  # a turn about its axis is as well that of the base, or of the tool
        as_well = "" if joint is None else f", or {joint.what}"
        return self._said(rest, f"{said} at {self._stations(rest)}{as_well}", remedy)

    def _one_joint(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """The rest with the position of one joint unknown."""
        part = self.samples.select(rest)
        for j in self._joints():
            q = self._solved(j, placed, part)
            share = float(self._within(placed, forward(self.chain, q), part).mean())
            if share >= _EXPLAINED:
                return self._joint_said(j, rest, part.q[:, j], q[:, j])
        return None

    def _two_joints(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """The rest with the positions of two joints unknown, which four of the six numbers of a pose then prove."""
        if not self.poses:
            return None
        few = rest[np.unique(np.linspace(0, len(rest) - 1, min(len(rest), _FEW)).astype(int))]
        part = self.samples.select(few)
        for pair in combinations(self._joints(), 2):
            q = self._solved_two(list(pair), placed, part)
            if float(self._within(placed, forward(self.chain, q), part, _CLEARLY).mean()) < _EXPLAINED:
                continue
            names = " and ".join(part.names[j] for j in pair)
            where = f" at {self._stations(rest)}" if len(rest) < len(self.samples) else ""
            stale = np.ptp(part.q[:, pair], axis=0).max() < _STILL
            what = (
                f"joints {names} keep their reported positions{where} while they move: they look stale"
                if stale
                else f"joints {names} were not where they were reported{where}"
            )
            return self._said(rest, what, f"check how the positions of {names} get into joint_states")
        return None

    def _solved_two(self, pair: list[int], placed: Placed, part: Samples) -> Array:
        """Postures with the positions of two joints that come nearest to the readings, from several starts."""
        best, q_best = np.full(len(part), np.inf), part.q.copy()
        scale = np.array(self.limit)
        for start in product(_BEGIN, repeat=2):
            q = part.q.copy()
            q[:, pair] += start
            for _ in range(_STEPS):
                A = forward(self.chain, q)
                J = spatial_jacobian(self.chain, q)[:, :, pair]
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
            angle, distance = placed.residual(forward(self.chain, q), part)
            left = np.maximum(angle / scale[0], distance / scale[1])
            better = left < best
            best[better], q_best[better] = left[better], q[better]
        return q_best

    def _joints(self) -> list[int]:
        return [j for j in range(self.chain.n) if self.chain.revolute[j]]

    def _solved(self, j: int, placed: Placed, part: Samples) -> Array:
        """Postures with the angle of joint j as the orientations tell it, or points where there are none."""
        q = part.q.copy()
        q[:, j] = 0.0
        T0 = forward(self.chain, q)
        q[:, j] = 1.0
        T1 = forward(self.chain, q)
        R0 = T0[:, :3, :3]
        turn = T1[:, :3, :3] @ np.swapaxes(R0, 1, 2)
        axis = so3.log(turn)
        if not self.poses:
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

    def _joint_throughout(self, before: float) -> Disagreement | None:
        """One joint that is off everywhere. before: share of the stations that agree as they are."""
        everything = np.arange(len(self.samples))
        best: tuple[float, int, Array] | None = None
        for j in self._joints():
            for q in self._unknown(j):
                placed = self._placed(forward(self.chain, q), self.samples)
                q = self._solved(j, placed, self.samples)
                share = float(self._within(placed, forward(self.chain, q), self.samples).mean())
                if share >= max(_EXPLAINED, before + _MORE) and (best is None or share > best[0]):
                    best = share, j, q[:, j]
        if best is None:
            return None
        _, j, seen = best
        return self._joint_said(j, everything, self.samples.q[:, j], seen)

    def _unknown(self, j: int) -> Iterator[Array]:
        """Postures with angles of joint j that the readings agree on, from several starts."""
        samples = self.samples
        for k in range(_STARTS if self.poses else _STARTS // 4):
            q = samples.q.copy()
            if k:
                q[:, j] = self.rng.uniform(-np.pi, np.pi, len(q)) * min(1.0, 0.15 * k)
            last = np.inf
            for _ in range(_ROUNDS):
                A = forward(self.chain, q)
                if self.poses:  # turns alone tell it, and are quicker
                    placed = Placed(*base_and_tool_turns(A[:, :3, :3], samples.R), np.zeros(3), np.zeros(3))
                else:
                    placed = self._placed(A, samples)
                q = self._solved(j, placed, samples)
                turned, gap = placed.residual(forward(self.chain, q), samples)
                left = float(np.median(turned if self.poses else gap))
                if left > 0.999 * last:
                    break
                last = left
            if last < self.limit[0 if self.poses else 1]:
                yield q
                return

    def _joint_said(self, j: int, rows: np.ndarray, reported: Array, seen: Array) -> Disagreement | None:
        name = self.samples.names[j]
        where = f" at {self._stations(rows)}" if len(rows) < len(self.samples) else ""
        remedy = f"check how the position of {name} gets into joint_states"
        swing = np.degrees(2.0 * _spread(seen))
        if np.ptp(self.samples.q[:, j]) < _STILL:
            what = (
                f"joint {name} is reported as standing still and moves by some {swing:.0f}°: "
                "its position is apparently never reported"
            )
            return self._said(rows, what, remedy)
        if np.ptp(reported) < _STILL:
            what = (
                f"joint {name} keeps its reported position{where} while it moves by some {swing:.0f}°: it looks stale"
            )
            return self._said(rows, what, remedy)
        if _spread(seen) < 2.0 * ANGLE:
            what = f"joint {name} moves{where} and the readings do not show it: tracker or reference move along with it"
            return self._said(rows, what, f"mount the tracker and its reference where {name} does not move them")
        off = seen - reported
        if _spread(off) < 2.0 * ANGLE:
            turn = np.degrees(np.angle(np.mean(np.exp(1j * off))))
            if abs(turn) < np.degrees(_CLEARLY * ANGLE):  # it stands as reported: what is wrong is not this joint
                return None
            return self._said(rows, f"joint {name} reads {-turn:.1f}° too much{where}: its zero is different", remedy)
        for how, factor in _FACTORS.items():
            if _spread(seen - factor * reported) < 2.0 * ANGLE:
                return self._said(rows, f"joint {name} is apparently counted {how}{where}", remedy)
        return self._said(rows, f"joint {name} was not where it was reported{where}", remedy)

    def _stations(self, rows: np.ndarray) -> str:
        bad = np.zeros(len(self.samples), bool)
        bad[rows] = True
        runs = consecutive(bad)
        if len(runs) <= 3:
            number = self.samples.station
            each = [f"{number[a]} to {number[b - 1]}" for a, b in runs]
            return f"stations {' and '.join(each)}"
        return f"{len(rows)} of {len(bad)} stations, here and there"

    def _said(self, rows: np.ndarray, what: str, remedy: str) -> Disagreement:
        return Disagreement(what, remedy, len(rows), len(self.samples))


def _spread(angle: Array) -> float:
    """Circular deviation [rad] of angles (N,), of the nine tenths that lie closest together."""
    off = np.angle(np.exp(1j * (angle - np.angle(np.mean(np.exp(1j * angle))))))
    off = np.sort(np.abs(off - np.median(off)))[: max(int(_CLOSEST * len(off)), 1)]
    return float(np.sqrt(np.mean(off**2)))
