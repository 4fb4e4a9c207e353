"""Joint positions that are not what the joints did: of one joint or two, at some stations or at all of them.

With the other joints given, an orientation tells the angle of a joint in closed form; of points, the turn about the
joint's axis does. Two joints are solved for by Gauss-Newton steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from modcal_core.calibration import turns_left
from modcal_core.geometry import Array, se3, so3
from modcal_core.hypotheses.hand_eye import SPREAD, HandEye, HandEyeFit, Placement, at, closed
from modcal_core.hypotheses.hypothesis import COMMON, RARE, VERY_RARE, Hypothesis, cost_of_rows, where
from modcal_core.hypotheses.joint_columns import likely_orders
from modcal_core.hypotheses.rows import astray
from modcal_core.measurements import spread_rows
from modcal_core.robots import Chain, forward, frames, spatial_jacobian

_STILL = 1e-9  # rad
_WITHIN = 1e-5  # m that base and tool are found to before a joint's angles are, in turn
_ORDERS = 6  # that are fitted
_SIGNS = 6  # joints, up to which all orders are asked with one of them reversed as well
_CLOSEST = 0.9  # share of angles that a circular deviation is taken of
_FREE = float(np.log(2.0 * np.pi / (SPREAD[0] * np.sqrt(2.0 * np.pi * np.e))))  # nats for an angle that may be anything
_STARTS, _ROUNDS = 16, 25  # of a search for one joint's angles
_TRIED, _HOPELESS = 4, 30.0  # rounds, after which what misses by so many limits of an arm leads nowhere
_HELD = 4  # stations that agree with base and tool, from which these say where two joints were
_FEW = 12  # stations at which two joints are looked for; six times as many at which one is
_BEGIN = (0.0, 2.1, -2.1)  # rad; thirds of a turn from what is reported, from which two joints are looked for
_STEPS, _LONGEST = 10, 0.7  # iterations, and how far one goes [rad]


def of_one(fit: HandEyeFit) -> Iterator[Hypothesis]:
    """One joint that was not where it was reported, at the stations that do not agree."""
    rest = astray(fit)
    if len(rest) < 3:
        return
    part = fit.case.select(rest)
    for j in _turning(fit.case.chain):
        q = solved(j, fit.placement, part)
        good = at(part.moved(q), fit.placement).agree(2.0)
        if good.sum() >= 3:
            yield from _of_joint(fit.case, j, rest[good], q[good, j], COMMON)


def throughout(case: HandEye) -> Iterator[Hypothesis]:
    """One joint that is off at all stations: its angles, base and tool are found in turn, from several starts."""
    rng, few = np.random.default_rng(0), case.select(spread_rows(len(case), 6 * _FEW))
    count, limits = (_STARTS if case.poses else _STARTS // 4), np.array(case.limits)
    width = np.pi * np.minimum(1.0, 0.15 * np.arange(1.0, count))
    for j in _turning(case.chain):
        joint, last = OneJoint.of(few, j), np.full(count, np.inf)
        angle = np.concatenate([few.q[None, :, j], rng.uniform(-1.0, 1.0, (count - 1, len(few))) * width[:, None]])
        found, nearest = None, 1.0
        for round in range(_ROUNDS):
            placement = closed(joint.turned(angle), _WITHIN)
            angle = joint.angles(placement)
            each = np.linalg.norm(placement.left(joint.turned(angle)), axis=3)
            left = (np.median(each, axis=2) / limits[:, None]).max(axis=0)
            kept = (left <= 0.999 * last) & ((round != _TRIED) | (left <= _HOPELESS))
            if left.min() < nearest:
                best = int(np.argmin(left))
                found = Placement(*(x[best] for x in (placement.Y, placement.X, placement.x, placement.t)))
                nearest = left[best]
                kept &= left == nearest  # the others are not needed
            if not kept.any():
                break
            angle, last = angle[kept], left[kept]
        if found is not None:
            q = solved(j, found, case)
            yield from _of_joint(case, j, np.arange(len(case)), q[:, j], COMMON)


def of_two(fit: HandEyeFit) -> Iterator[Hypothesis]:
    """Two joints that were not where they were reported, which four of the six numbers of a pose then prove."""
    rest = astray(fit)
    if not 3 <= len(rest) <= len(fit.case) - _HELD or not fit.case.poses:  # a placement that few agree with proves none
        return
    few = fit.case.select(rest[spread_rows(len(rest), _FEW)])
    found: list[tuple[float, tuple[int, int]]] = []
    for pair in combinations(_turning(fit.case.chain), 2):
        q = solved_two(pair, fit.placement, few)
        found.append((float(at(few.moved(q), fit.placement).agree(2.0).mean()), pair))
    share, pair = max(found, default=(0.0, (0, 0)))
    if share < 0.5:
        return
    part = fit.case.select(rest)
    q = solved_two(pair, fit.placement, part)
    good = at(part.moved(q), fit.placement).agree(2.0)
    rows, q = rest[good], q[good]
    names, at_rows = " and ".join(fit.case.names[j] for j in pair), where(fit.case, rows)
    stale = float(np.ptp(fit.case.q[rows][:, list(pair)], axis=0).max(initial=0.0)) < _STILL
    what = f"joints {names} were not where they were reported{at_rows}"
    if stale:
        what = f"joints {names} keep their reported positions{at_rows} while they move: they look stale"
    yield _replaced(fit.case, list(pair), rows, q[:, list(pair)], what, names, RARE - 2.0 * _FREE * len(rows))


def _turning(chain: Chain) -> list[int]:
    return [j for j in range(chain.n) if chain.revolute[j]]


def _of_joint(case: HandEye, j: int, rows: np.ndarray, seen: Array, price: float) -> Iterator[Hypothesis]:
    """What was wrong with a joint whose angles the readings tell at some rows, the plainest first."""
    name, reported, N = case.names[j], case.q[rows, j], len(case)
    at_rows, n = where(case, rows), case.chain.n
    price -= float(np.log(n))
    off = seen - reported
    turn = float(np.angle(np.mean(np.exp(1j * off))))
    least = 2.0 * case.limits[0]
    if np.ptp(reported) < _STILL and _spread(seen) > least:
        still = np.ptp(case.q[:, j]) < _STILL
        swing = f"by some {np.degrees(2.0 * _spread(seen)):.0f}°"
        what = f"joint {name} keeps its reported position{at_rows} while it moves {swing}: it looks stale"
        if still:
            what = f"joint {name} is reported as standing still and moves {swing}: its position is apparently never "
            what += "reported"
        yield _replaced(case, [j], rows, seen[:, None], what, name, price - _FREE * len(rows))
        return
    if _spread(off) < least and abs(turn) > least:
        what = f"joint {name} reads {-np.degrees(turn):.1f}° too much{at_rows}: its zero is different"
        yield _replaced(case, [j], rows, (reported + turn)[:, None], what, name, price, 1)
    if _spread(seen) < least and _spread(reported) > least:
        what = f"joint {name} moves{at_rows} and the readings do not show it: tracker or reference move along with it"
        stands = np.full((len(rows), 1), float(np.angle(np.mean(np.exp(1j * seen)))))
        yield _replaced(case, [j], rows, stands, what, name, price, 1)
        return
    what = f"joint {name} was not where it was reported{at_rows}"
    if len(rows) < N or _spread(off) > least:
        yield _replaced(case, [j], rows, seen[:, None], what, name, price + VERY_RARE - _FREE * len(rows))


def _replaced(
    case: HandEye, joints: list[int], rows: np.ndarray, seen: Array, what: str, name: str, price: float, values: int = 0
) -> Hypothesis:
    """Positions of joints at rows as the readings tell them."""
    q = case.q.copy()
    q[rows[:, None], joints] = seen
    remedy = f"check how the position{'s' if len(joints) > 1 else ''} of {name} gets into joint_states"
    if "do not show it" in what:
        remedy = f"mount the tracker and its reference where {name} does not move them"
    price -= cost_of_rows(rows, len(case)) if len(rows) < len(case) else 0.0
    return Hypothesis(what, remedy, lambda c: c.moved(q), price, values, "joints", len(rows))


def _spread(angle: Array) -> float:
    """Circular deviation [rad] of the nine tenths of angles (N,) that are closest together."""
    off = np.angle(np.exp(1j * (angle - np.angle(np.mean(np.exp(1j * angle))))))
    off = np.sort(np.abs(off - np.median(off)))[: max(int(_CLOSEST * len(off)), 1)]
    return float(np.sqrt(np.mean(off**2)))


@dataclass(frozen=True)
class OneJoint:
    """Stations at any angle of one joint: tip poses at zero (N, 4, 4) turn about axes (N, 3) through points (N, 3)."""

    case: HandEye
    zero: Array
    axis: Array
    on: Array

    @classmethod
    def of(cls, case: HandEye, j: int) -> OneJoint:
        """A joint of a case, its number counted from zero."""
        q = case.q.copy()
        q[:, j] = 0.0
        f = frames(case.chain, q)
        return cls(case, f.transform(-1), f.axes[j, 2].T, f.p[j].T)

    def turned(self, angle: Array) -> HandEye:
        """The stations with tips (K, N, 4, 4) at angles (K, N)."""
        S = so3.exp(angle[..., None] * self.axis)
        p = self.on + (S @ (self.zero[:, :3, 3] - self.on)[..., None])[..., 0]
        return replace(self.case, A=se3.transform(S @ self.zero[:, :3, :3], p), mixed=None)

    def angles(self, by: Placement) -> Array:
        """Angles (…, N) as orientations tell them by each placement, or points where there are none."""
        R0, Y = self.zero[:, :3, :3], by.Y[..., None, :, :]
        if not self.case.poses:
            here = (R0 @ by.x[..., None, :, None])[..., 0] + self.zero[:, :3, 3] - self.on
            seen = (self.case.p - by.t[..., None, :]) @ by.Y - self.on
            along = np.sum(self.axis * here, axis=-1) * np.sum(self.axis * seen, axis=-1)
            cross = np.sum(self.axis * np.cross(here, seen), axis=-1)
            return np.asarray(np.arctan2(cross, np.sum(here * seen, axis=-1) - along))
        B = R0 @ by.X[..., None, :, :] @ np.swapaxes(self.case.R, 1, 2) @ Y
        along = np.einsum("ni,...nij,nj->...n", self.axis, B, self.axis)
        cross = np.einsum("nij,...nji->...n", so3.hat(self.axis), B)
        return np.asarray(np.arctan2(cross, np.trace(B, axis1=-2, axis2=-1) - along))


def solved(j: int, placement: Placement, part: HandEye) -> Array:
    """Postures with the angle of joint j as the orientations tell it, or points where there are none."""
    q = part.q.copy()
    q[:, j] = OneJoint.of(part, j).angles(placement)
    return q


def solved_two(pair: tuple[int, int], placement: Placement, part: HandEye) -> Array:
    """Postures with the positions of two joints that come nearest to the readings, from several starts."""
    columns, scale = list(pair), np.array(part.limits)
    best, q_best = np.full(len(part), np.inf), part.q.copy()
    for begin in product(_BEGIN, repeat=2):
        q = part.q.copy()
        q[:, columns] += begin
        for _ in range(_STEPS):
            A = forward(part.chain, q)
            J = spatial_jacobian(part.chain, q)[:, :, columns]
            point = se3.apply(A, placement.x)
            gap = part.p - (point @ placement.Y.T + placement.t)
            turn = turns_left(placement.Y, A[:, :3, :3], placement.X, part.R)
            by_gap = placement.Y @ (J[:, :3] + np.cross(J[:, 3:], point[:, :, None], axis=1))
            by_turn = np.swapaxes(A[:, :3, :3] @ placement.X, 1, 2) @ J[:, 3:]
            G = np.concatenate([by_turn / scale[0], by_gap / scale[1]], axis=1)
            r = np.concatenate([turn / scale[0], gap / scale[1]], axis=1)
            H = np.swapaxes(G, 1, 2) @ G
            H += 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(2)
            step = np.linalg.solve(H, np.swapaxes(G, 1, 2) @ r[..., None])[..., 0]
            q[:, columns] += np.clip(step, -_LONGEST, _LONGEST)
        fit = at(part.moved(q), placement)
        left = np.maximum(fit.turn / scale[0], fit.gap / scale[1])
        better = left < best
        best[better], q_best[better] = left[better], q[better]
    return q_best


# --- columns under other names ------------- --------------------------------------------------------------------------


def orders(case: HandEye) -> list[Hypothesis]:
    """The likeliest orders of the joints' columns, with one reversed beside it."""
    n, out, explained = case.chain.n, list[tuple[float, Hypothesis]](), False
    for back in (None, *range(n if n <= _SIGNS else 0)):
        if explained:
            break
        sign = np.where(np.arange(n) == (-1 if back is None else back), -1.0, 1.0)
        table = np.c_[case.q * sign, case.p]
        for order in likely_orders(case.chain, table, 1.0, range(n), [(n, n + 1, n + 2)], 3):
            shuffled = [k for k in range(n) if order.columns[k] != k]
            explained |= order.explains  # with fewer mistakes it is likelier
            if not shuffled:
                continue
            by = next((min(s, n - s) for s in range(1, n) if order.columns == tuple((k + s) % n for k in range(n))), 0)
            how = f", all by {by} place{'s' if by > 1 else ''} (a list counted from another number)" if by else ""
            each = ", ".join(f"{case.names[k]} under the name {case.names[order.columns[k]]}" for k in shuffled)
            beside = "" if back is None else f", and {case.names[back]} reversed"
            h = Hypothesis(
                f"joints stand in another order than they are named{how}: {each}{beside}",
                "correct the names in joint_states, or the order of the columns",
                lambda c, o=list(order.columns), s=sign: c.moved((c.q * s)[:, o]),  # type: ignore[misc]
                VERY_RARE,
                len(shuffled) - 1 + (back is not None),
                "joints",
            )
            out.append((order.left, h))
    return [h for _, h in sorted(out, key=lambda one: one[0])[:_ORDERS]]
