"""Descriptions that are not the robot's: another link that is followed, a joint's axis or origin, motors for joints.

Positions of the joints are ``M q + c`` of the reported ones, and the origin of a joint may stand elsewhere: base, tool
and the values that are free are found together by robust least squares (damped Gauss-Newton) from several starts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.calibration import base_and_tool_turns, turns_left
from modcal_core.geometry import Array, descend, se3, so3
from modcal_core.hypotheses.hand_eye import ANGLE, HandEye, Placement, at, closed, points
from modcal_core.hypotheses.hypothesis import COMMON, RARE, VERY_RARE, Hypothesis, family, listed
from modcal_core.hypotheses.joint_columns import unexplained
from modcal_core.measurements import spread_rows
from modcal_core.robots import Chain, Frames, forward, frames

_FEW = 80  # stations that a description is fitted to
_ROUNDS, _SETTLED = 40, 1e-3  # iterations, and the relative change of the cost at which a fit has settled
_STARTS = 4  # likeliest mixtures, and likeliest zeros, that are refined beside the columns as they are
_SHORT, _FOLLOWED = 8, 3  # iterations after which only the likeliest are followed, and how many
_MAX_INNER = 5  # joints whose zeros are looked at together, 4⁵ ways
_SIMPLE, _WHOLE = (0.5, 1.0, 2.0), 0.02  # fractions, and by which share a coefficient may miss one that is said instead
_OFF = 4.0 * ANGLE  # rad that a joint must be off by at the usual station to be named
_AFAR = 30.0  # limits of an arm, that lengths are begun with
_LENGTH = 0.02  # of the reach, by which an origin is wrong


# --- another link ----------------------------------------------------------------------------------------------------


def other_links(case: HandEye) -> list[Hypothesis]:
    """Readings that follow another link than the tip, or the tip as seen from another link than the base."""
    chain, n = case.chain, case.chain.n
    pairs = [(a, b, i) for a, b in combinations(range(n + 1), 2) for i in (False, True) if (a, b, i) != (0, n, False)]
    pairs.remove((0, n, True))  # inverse poses are a convention

    def undone(c: HandEye, first: int, last: int, inverse: bool) -> HandEye:
        f = frames(chain, c.q)
        # the frame before joint k + 1 ends the link behind joint k, and does not turn with joint k + 1
        A = se3.inverse(f.transform(first)) @ f.transform(last)
        return replace(c, A=se3.inverse(A) if inverse else A)

    return family(
        RARE,
        [
            Hypothesis(
                *_of_link(chain, *pair),
                lambda c, p=pair: undone(c, *p),  # type: ignore[misc]
                0.0,
                touches="joints",
            )
            for pair in pairs
        ],
    )


def _of_link(chain: Chain, first: int, last: int, inverse: bool) -> tuple[str, str]:
    """What is said of readings that follow link ``last`` as seen from link ``first``, and the remedy."""
    n, names, links = chain.n, chain.names, chain.links
    before = f"{links[first]}, " if first and len(links) == n else ""
    behind = f"{links[last]}, " if last < n and len(links) == n else ""
    target = f"the link before {names[last]} ({behind}behind {names[last - 1]})" if last < n else "the tool"
    seen = f"the link behind {names[first - 1]} ({before}before {names[first]})" if first else "the base"
    still = [*names[:first], *names[last:]]
    moved = f"{listed(still)} do{'' if len(still) > 1 else 'es'} not move them"
    if inverse:
        what = f"readings look like the pose of {seen} seen from {target}"
    elif first == 0:
        what = f"readings follow {target}, and not the tool: the target is mounted there, or the topic is another's"
    elif last == n:
        what = f"readings follow the tool as seen from {seen}: the tracker or its reference is mounted there"
    else:
        what = f"readings follow {target} as seen from {seen}"
    remedy = "record the topic of the target on the tool in a frame that stands, or give --tip and --base as the links "
    return f"{what}; {moved}", f"{remedy}that carry target and tracker"


# --- axes and types -------------------------------------------------------------------------------------------------


def axes(case: HandEye) -> list[Hypothesis]:
    """Joints that turn or slide along another axis of their frame than the description says."""
    out = []
    for j, name in enumerate(case.names):
        there = case.chain.axes[j]
        for u in (s * e for e in np.eye(3) for s in (1.0, -1.0)):
            if abs(float(u @ there)) > 0.99:  # of the other sign it is a reversed joint
                continue
            what = f"joint {name} looks as if it turned about {_vector(u)} in its frame and not about {_vector(there)}"
            other = replace(case.chain, axes=np.where(np.arange(case.chain.n)[:, None] == j, u, case.chain.axes))
            out.append(_of_chain(what, f"check <axis> of {name} in the URDF", other))
    return family(RARE, out)


def types(case: HandEye) -> list[Hypothesis]:
    """Joints that slide where they turn, or the reverse."""
    out = []
    for j, name in enumerate(case.names):
        revolute, lower, upper = (x.copy() for x in (case.chain.revolute, case.chain.lower, case.chain.upper))
        revolute[j], lower[j], upper[j] = not revolute[j], -np.pi, np.pi
        written, real = ("revolute", "slide") if case.chain.revolute[j] else ("prismatic", "turn")
        what = f"joint {name} is {written} in the URDF, and the readings show it {real}"
        other = replace(case.chain, revolute=revolute, lower=lower, upper=upper)
        out.append(_of_chain(what, f'check <joint type="..."> of {name}', other))
    return family(RARE, out)


def _of_chain(what: str, remedy: str, other: Chain) -> Hypothesis:
    return Hypothesis(what, remedy, lambda c: replace(c, A=forward(other, c.q)), 0.0, touches="joints")


def _vector(axis: Array) -> str:
    return " ".join(f"{v:g}" for v in axis + 0.0)


# --- what is fitted --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FittedArm:
    """An arm whose joints are at ``M q + c`` and whose origins (n + 1, 4, 4) may be others than described."""

    chain: Chain
    M: Array
    c: Array
    origins: Array

    @classmethod
    def described(cls, chain: Chain) -> FittedArm:
        """The arm as its description has it."""
        return cls(chain, np.eye(chain.n), np.zeros(chain.n), chain.origins)

    def tip(self, q: Array) -> Array:
        """Poses of the tip, (N, 4, 4)."""
        return forward(self.chain.with_origins(self.origins), q @ self.M.T + self.c)

    def frames(self, q: Array) -> Frames:
        """Its frames at reported positions (N, n)."""
        return frames(self.chain.with_origins(self.origins), q @ self.M.T + self.c)


@dataclass(frozen=True)
class Free:
    """What is free beside base and tool: columns of M and all of c, or the origins of joints, by length or wholly."""

    columns: tuple[int, ...] = ()
    origins: tuple[int, ...] = ()
    turns: bool = False


_Fitted = tuple[FittedArm, Placement, Array, Array]  # residuals in limits, and how a step reduces them


def fitted(
    case: HandEye, start: FittedArm, free: Free, near: float = 1.0, rounds: int = _ROUNDS
) -> tuple[FittedArm, Placement]:
    """The arm, base and tool that the readings ask for, from this start. near: limits that count as little. rounds:
    iterations at most.
    """
    scale = near * np.array(case.limits)
    equations: list[Array] = []

    def look(here: _Fitted) -> float:
        *_, r, G = here
        weight = np.repeat(1.0 / (1.0 + np.sum(r**2, axis=1)), r.shape[1])  # Cauchy
        flat = G.reshape(-1, G.shape[2])
        equations[:] = (flat.T * weight) @ flat, flat.T @ (weight * r.ravel())
        return _cost(r)

    def step(here: _Fitted, damping: float) -> tuple[_Fitted, float]:
        (H, g), D = equations, np.diag(equations[0])
        change = np.asarray(np.linalg.solve(H + np.diag(damping * D + 1e-9 * D.max()), g))
        ahead = _stepped(*here[:2], free, change)
        there = (*ahead, *_rows(case, *ahead, free, scale))
        return there, _cost(there[2])

    placement = closed(replace(case, A=start.tip(case.q)))
    begin = start, placement, *_rows(case, start, placement, free, scale)
    return descend(begin, look, step, lambda _, gain, cost: gain < _SETTLED * cost, rounds).place[:2]


def _cost(r: Array) -> float:
    return float(np.sum(np.log1p(np.sum(r**2, axis=1))))


def _rows(case: HandEye, arm: FittedArm, placement: Placement, free: Free, scale: Array) -> tuple[Array, Array]:
    """Residuals (N, k) in units of what a nominal arm misses by, and how a step reduces them, (N, k, values).

    A value moves the tip by a twist (v, w) in the base; the point of the tool moves by v + w × point.
    """
    Y, X, x, t = placement.Y, placement.X, placement.x, placement.t
    f, N = arm.frames(case.q), len(case)
    A = f.transform(-1)
    a, point = A[:, :3, :3], se3.apply(A, x)
    v: list[Array] = []  # each (N, 3, values)
    w: list[Array] = []
    if free.columns or not free.origins:
        axis, p = f.axes[:-1, 2].transpose(2, 1, 0), f.p[:-1].transpose(2, 1, 0)
        turning = np.where(arm.chain.revolute, axis, 0.0)
        moving = np.where(arm.chain.revolute, np.cross(p, turning, axis=1), axis)
        reported = case.q[:, list(free.columns)]
        for out, each in ((v, moving), (w, turning)):
            out += [(each[..., None] * reported[:, None, None, :]).reshape(N, 3, -1), each]
    for j in free.origins:
        R = f.rotation(j)
        v.append(R)
        w.append(np.zeros_like(R))
        if free.turns:
            v.append(np.cross(f.p[j].T[:, :, None], R, axis=1))
            w.append(R)
    V, W = np.concatenate(v, axis=2), np.concatenate(w, axis=2)
    eye, none = np.broadcast_to(np.eye(3), (N, 3, 3)), np.zeros((N, 3, 3))
    by = Y @ (V + np.cross(W, point[:, :, None], axis=1))
    G = np.concatenate([by, -Y @ so3.hat(point), eye, Y @ a, none], axis=2) / scale[1]
    r = (case.p - (point @ Y.T + t)) / scale[1]
    if case.poses:
        to_tool = np.swapaxes(a @ X, 1, 2)
        turning = np.concatenate([to_tool @ W, to_tool, none, none, eye], axis=2) / scale[0]
        r = np.concatenate([r, turns_left(Y, a, X, case.R) / scale[0]], axis=1)
        G = np.concatenate([G, turning], axis=1)
    return r, G


def _stepped(arm: FittedArm, placement: Placement, free: Free, step: Array) -> tuple[FittedArm, Placement]:
    n, k, M, c, origins = arm.chain.n, len(free.columns), arm.M.copy(), arm.c, arm.origins.copy()
    rest = step
    if free.columns or not free.origins:
        M[:, list(free.columns)] += step[: n * k].reshape(n, k)
        c, rest = c + step[n * k : n * k + n], step[n * k + n :]
    for j in free.origins:
        B = arm.chain.joint_basis[j]  # frames have their joint's axis along z
        turn = _bounded_turn(B @ rest[3:6] if free.turns else np.zeros(3))
        origins[j] = origins[j] @ se3.transform(turn, B @ rest[:3])
        rest = rest[6 if free.turns else 3 :]
    Y, X = placement.Y @ _bounded_turn(rest[:3]), placement.X @ _bounded_turn(rest[9:])
    return replace(arm, M=M, c=c, origins=origins), Placement(Y, X, placement.x + rest[6:9], placement.t + rest[3:6])


def _bounded_turn(turn: Array) -> Array:
    return np.asarray(so3.exp(turn / max(float(np.linalg.norm(turn)), 1.0)))


def _few(case: HandEye) -> HandEye:
    return case.select(spread_rows(len(case), _FEW))


# --- links -----------------------------------------------------------------------------------------------------------


def links(case: HandEye) -> Iterator[Hypothesis]:
    """One origin of the description that stands elsewhere or otherwise, or several whose lengths are others."""
    few, chain = _few(case), case.chain
    n, described = chain.n, FittedArm.described(chain)
    starts = [(j, described) for j in range(1, n)]
    starts += [(j, _turned_origin(chain, j, S)) for j in range(1, n) for S in (_cube(few, j) if case.poses else ())]
    likely = _likeliest(few, [(start, Free(origins=(j,), turns=case.poses)) for j, start in starts])
    for _, arm, free in likely:
        what, remedy = _of_origin(chain, free.origins[0], arm.origins[free.origins[0]])
        if what:
            yield _by_arm(what, remedy, arm, RARE - float(np.log(3 * n)), 6 if case.poses else 3)
    every = tuple(range(1, n))
    afar, _ = fitted(few, described, Free(origins=every), near=_AFAR)
    arm, placement = fitted(few, afar, Free(origins=every))
    lengths = at(replace(few, A=arm.tip(few.q)), placement)
    shifts = [np.linalg.norm(arm.origins[j, :3, 3] - chain.origins[j, :3, 3]) for j in range(1, n)]
    wrong = [chain.names[j] for j, shift in enumerate(shifts, 1) if shift > _LENGTH * chain.reach()]
    if len(wrong) > 1:
        yield _by_arm(
            f"orientations fit the URDF and lengths do not: look at the origins of {', '.join(wrong)}",
            "give the description of this robot, not of another size",
            arm,
            RARE,
            3 * (n - 1),
        )
    if case.poses and likely and likely[0][0] > 1.0 and not lengths.explains:  # one link alone is not enough
        arm, _ = fitted(few, likely[0][1], Free(origins=every, turns=True))
        turned = [np.linalg.norm(so3.log(chain.origins[j, :3, :3].T @ arm.origins[j, :3, :3])) for j in range(1, n)]
        yield _by_arm(
            "orientations and positions fit with another turn of the origin of joint "
            f"{chain.names[1 + int(np.argmax(turned))]} and other lengths of several links, so that more than one link "
            "of the URDF is different",
            "give the description of this robot; of modules, check the kind, order and turn of each",
            arm,
            VERY_RARE,
            6 * (n - 1),
        )


def _by_arm(what: str, remedy: str, arm: FittedArm, price: float, values: int) -> Hypothesis:
    return Hypothesis(what, remedy, lambda c: replace(c, A=arm.tip(c.q)), price, values, "joints")


def _turned_origin(chain: Chain, j: int, S: Array) -> FittedArm:
    origins = chain.origins.copy()
    origins[j, :3, :3] = origins[j, :3, :3] @ S
    return replace(FittedArm.described(chain), origins=origins)


def _cube(few: HandEye, j: int, most: int = 2) -> list[Array]:
    """The turns of a cube before joint j, but for none, with which orientations agree best."""
    turns = [S for S in Rotation.create_group("O").as_matrix() if np.trace(S) < 2.9]
    part = few.select(spread_rows(len(few), 30))
    a = np.stack([_turned_origin(few.chain, j, S).tip(part.q)[:, :3, :3] for S in turns])
    R = np.broadcast_to(part.R, a.shape)
    Y, X = base_and_tool_turns(a, R)
    missed = np.median(np.linalg.norm(turns_left(Y, a, X, R), axis=-1), axis=-1)
    return [turns[k] for k in np.argsort(missed)[:most]]


def _of_origin(chain: Chain, j: int, origin: Array) -> tuple[str, str]:
    """What is said of the origin of joint j, and the remedy; empty texts where it is as described."""
    name, there = chain.names[j], chain.origins[j]
    S = there[:3, :3].T @ origin[:3, :3]
    if j == 1 and chain.revolute[0]:  # base and tool take up what is about the first and the last axis
        back = there[:3, :3]
        S = back.T @ _unwound(chain.axes[0], back @ S @ back.T) @ back
    if j == chain.n - 1:
        S = _unwound(chain.axes[j], S.T).T
    angle, shift = float(np.linalg.norm(so3.log(S))), origin[:3, 3] - there[:3, 3]
    longer, turned = bool(np.linalg.norm(shift) > _LENGTH * chain.reach()), angle > _OFF
    by = f"({', '.join(f'{1e3 * v:.0f}' for v in shift)}) mm"
    if turned and longer:
        what = f"the link before joint {name} is another than in the URDF: its origin looks turned by "
        remedy = f"check <origin> of {name}; of modules, the kind and turn of what stands before it"
        return f"{what}{np.degrees(angle):.3g}° and wrong by {by}", remedy
    if turned:
        what = f"the origin of joint {name} in the URDF looks turned by {np.degrees(angle):.3g}°, or its zero is "
        return f"{what}different", f"check <origin rpy> of {name} (order, degrees, sign), and the joint's zero"
    if longer:
        what = f"the origin of joint {name} in the URDF looks wrong by {by}, or the link before it is different"
        return what, f"check <origin xyz> of {name}, and whether the description is that of this robot"
    return "", ""


def _unwound(axis: Array, S: Array) -> Array:
    """exp(θ axis) S (3, 3) with the θ that leaves the smallest angle: its trace is greatest, a sine in θ."""
    along = float(axis @ S @ axis)
    theta = np.arctan2(float(np.trace(so3.hat(axis) @ S)), float(np.trace(S)) - along)
    return np.asarray(so3.exp(theta * axis) @ S)


# --- motors for joints -----------------------------------------------------------------------------------------------


def mixtures(case: HandEye) -> Iterator[Hypothesis]:
    """Joint positions that are mixed, scaled or shifted: the linear map of the columns that positions ask for."""
    few, chain = _few(case), case.chain
    free = Free(columns=tuple(np.flatnonzero(case.q.std(axis=0) > 0.0).tolist()))
    starts = [FittedArm.described(chain), *_sifted(few, list(_mixed(chain.n))), *_sifted(few, list(_zeros(chain)))]
    for left, arm, _ in _likeliest(points(few), [(start, free) for start in starts]):
        if left > 1.0:
            continue
        for other in (fitted(few, arm, free)[0], arm) if case.poses else (arm,):  # whatever orientations mean
            what, who, values = _of_map(other, case)
            if what:
                remedy = f"check how the positions of {who} get into joint_states"
                yield _by_arm(what, remedy, other, COMMON + VERY_RARE - RARE, values)


def _likeliest(few: HandEye, starts: Sequence[tuple[FittedArm, Free]]) -> list[tuple[float, FittedArm, Free]]:
    """What is left in limits of an arm, nearest first, of the starts that lead nearest in a few steps."""

    def ahead(start: FittedArm, free: Free, rounds: int) -> tuple[float, FittedArm, Free]:
        arm, placement = fitted(few, start, free, rounds=rounds)
        usual = at(replace(few, A=arm.tip(few.q)), placement).usual
        return max(a / b for a, b in zip(usual, few.limits, strict=True)), arm, free

    first = sorted((ahead(*start, _SHORT) for start in starts), key=lambda one: one[0])
    return sorted((ahead(arm, free, _ROUNDS) for _, arm, free in first[:_FOLLOWED]), key=lambda one: one[0])


def _sifted(few: HandEye, maps: Sequence[tuple[Array, Array]]) -> list[FittedArm]:
    """The maps (M, c) that leave least by a linear map of turns and places, whatever base and tool are."""
    if not maps:
        return []
    part = few.select(spread_rows(len(few), 40))
    q = np.stack([part.q @ M.T + c for M, c in maps])
    A = forward(few.chain, q)
    left = unexplained(A[..., :3, :3], A[..., :3, 3], part.p - part.p.mean(axis=0)).sum(axis=1)
    arm = FittedArm.described(few.chain)
    return [replace(arm, M=maps[k][0], c=maps[k][1]) for k in np.argsort(left)[:_STARTS]]


def _zeros(chain: Chain) -> Iterator[tuple[Array, Array]]:
    """Quarter turns in the zeros of the joints between the first and the last, whose own are base and tool as well."""
    inner = [j for j in range(1, chain.n - 1) if chain.revolute[j]]
    for quarters in product(range(4), repeat=len(inner) if len(inner) <= _MAX_INNER else 0):
        c = np.zeros(chain.n)
        c[inner[: len(quarters)]] = 0.5 * np.pi * np.array(quarters)
        yield np.eye(chain.n), c


def _mixed(n: int) -> Iterator[tuple[Array, Array]]:
    """What undoes sums, differences and means of two columns, and angles that add up along the arm."""
    none = np.zeros(n)
    for first in range(n - 2):
        for last in range(first + 3, n + 1):
            B = np.eye(n)
            B[first:last, first:last] = np.tril(np.ones((last - first, last - first)))
            yield np.asarray(np.linalg.inv(B), dtype=float), none
    for i, j in combinations(range(n), 2):
        for values in product((-1.0, 0.0, 1.0), repeat=4):
            B = np.array(values).reshape(2, 2)
            det = float(B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0])
            for scale in () if det == 0.0 else (1.0, 2.0) if abs(det) == 2.0 else (1.0,):
                M = np.eye(n)
                M[np.ix_((i, j), (i, j))] = scale * np.linalg.inv(B)
                yield M, none


def _of_map(arm: FittedArm, case: HandEye) -> tuple[str, str, int]:
    """What is said of a map, of which joints, and how many values it changes; empty for what nobody can name."""
    names, q, n = case.names, case.q, case.chain.n
    size = np.abs(arm.M - np.eye(n)) * q.std(axis=0)
    off = q @ (arm.M - np.eye(n)).T
    shift = off.mean(axis=0) + arm.c
    varies = [i for i in range(n) if off[:, i].std() > _OFF]
    # the zeros of the first and the last joint are as well base and tool
    shifted = [i for i in range(1, n - 1) if i not in varies and abs(np.sin(0.5 * shift[i])) > 0.5 * _OFF]
    odd = (size > _OFF) & ~np.vectorize(lambda v: _simple(v) is not None)(np.abs(arm.M))
    if (not varies and not shifted) or odd.sum() > 4:  # two motors of odd ratios have four; more fit any arm
        return "", "", 0
    said, mixed, count = [], False, len(shifted)
    for i in varies:
        terms = [j for j in range(n) if abs(arm.M[i, j]) * q[:, j].std() > _OFF]
        mixed |= any(j != i for j in terms)
        count += int((size[i] > _OFF).sum())
        said.append(f"{names[i]} = {_sum([(arm.M[i, j], names[j]) for j in terms])}")
    what = []
    who = listed(names[i] for i in varies)
    if varies:
        how = "mixed with each other or with others, as those of motors" if mixed else "counted in another scale"
        what.append(f"positions of {who} look {how}: {'; '.join(said)}")
    if shifted and not varies and len(shifted) == 1:
        turn = np.degrees(np.angle(np.exp(1j * shift[shifted[0]])))
        what.append(f"joint {names[shifted[0]]} reads {-turn:.1f}° too much: its zero is different")
    elif shifted:
        each = listed(f"{names[i]} by {np.degrees(np.angle(np.exp(1j * shift[i]))):.1f}°" for i in shifted)
        what.append(f"zeros of joints look different: {each}")
    return ", and ".join(what), listed(names[i] for i in sorted({*varies, *shifted})), count + int(odd.sum())


def _sum(terms: list[tuple[float, str]]) -> str:
    out = ""
    for value, name in terms:
        whole = _simple(abs(value))
        size = f"{abs(value):.3g} " if whole is None else "" if whole == 1.0 else f"{whole:.3g} "
        out += f"{('-' if value < 0 else '') if not out else ' - ' if value < 0 else ' + '}{size}{name}"
    return out or "constant"


def _simple(value: float) -> float | None:
    """The fraction that a coefficient is, None for an odd one."""
    return next((whole for whole in (0.0, *_SIMPLE) if abs(value - whole) < _WHOLE * max(whole, 1.0)), None)
