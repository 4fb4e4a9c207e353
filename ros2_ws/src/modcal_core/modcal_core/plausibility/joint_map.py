"""Joint positions that are mixed, scaled or shifted: the linear map of the columns that the readings ask for.

Drivers report motors where joints are meant: sums and differences of a differential wrist, counts of another gear,
zeros of another table. With positions of the joints as M times the reported ones and c, base, tool, M and c are found
together by least squares (Levenberg-Marquardt), from the columns as they are, and from mixtures of columns and zeros
that fit best in closed form.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place, turns_left
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.plausibility.agreement import ANGLE, Disagreement, limits
from modcal_core.plausibility.mistakes import Mistake
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.plausibility.screening import most_likely
from modcal_core.robots import Chain, Mechanism, frames, is_serial_arm, spatial_jacobian

_MIN = 40  # stations; some seventy numbers are fitted to three or six of each
_MAX = 100  # the same at most
_STARTS = 4  # likeliest mixtures, and likeliest zeros, that are refined beside the columns as they are
_MAX_INNER = 5  # joints whose zeros are looked at together, 4⁵ ways
_ROUNDS = 40  # iterations
_TURNED = 4.0  # times the limit of angles that a joint must be off by at the usual station to be named
_SETTLED = 1e-3  # relative change of the cost at which a fit has settled
_SIMPLE, _WHOLE = (0.5, 1.0, 2.0), 0.02  # fractions, and by which share a coefficient may miss one that is said instead
_MAX_ODD = 4  # coefficients that are no such fraction: two motors of odd ratios have four; more fit any arm


def mixed_joints(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """Joints whose reported positions are a linear mixture of what they should be, None where that explains nothing.

    Nor where the columns as they are fit as a nominal arm does: what is left then is no column's fault.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = most_seen(samples, chain, _MIN, 10 * _MAX)
    if part is None or not is_serial_arm(chain):
        return None
    part = part.select(spread_rows(len(part), _MAX))
    moved = part.q.std(axis=0) > 0.0
    as_they_are = _Map(np.eye(chain.n), np.zeros(chain.n))
    try:
        if _explains(_placed(part, chain, as_they_are), part, chain):
            return None
        starts = [as_they_are, *_likely(part, chain)]
        fits = [fit for start in starts if (fit := _fitted(part, chain, start, moved)) is not None]
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None
    return _said(min(fits, key=lambda fit: _changed(fit, part)), part, chain) if fits else None


@dataclass(frozen=True)
class _Map:
    """Positions of the joints are ``q M.T + c`` of the reported ones."""

    M: Array
    c: Array


def _changed(fit: _Map, samples: Samples) -> int:
    """How many coefficients and zeros a map changes by more than errors of an arm."""
    least = _TURNED * ANGLE
    off = np.abs(fit.M - np.eye(len(fit.c))) * samples.q.std(axis=0) > least
    shift = samples.q.mean(axis=0) @ (fit.M - np.eye(len(fit.c))).T + fit.c
    zeros = (np.abs(np.sin(0.5 * shift)) > 0.5 * least) & ~off.any(axis=1)
    return int(off.sum() + zeros[1:-1].sum())


def _likely(samples: Samples, chain: Chain) -> list[_Map]:
    """Mixtures of columns, and zeros of other tables, that are worth a fit."""
    out: list[_Map] = []
    for some in (list(_mixtures(chain.n)), list(_zeros(chain))):
        mistakes = [
            Mistake("", str(k), lambda s, m=m: replace(s, q=s.q @ m.M.T + m.c), "joints")  # type: ignore[misc]
            for k, m in enumerate(some)
        ]
        try:
            out += [some[int(m.remedy)] for m in most_likely(samples, chain, mistakes, _STARTS)]
        except np.linalg.LinAlgError:
            continue
    return out


def _zeros(chain: Chain) -> Iterator[_Map]:
    """Quarter turns in the zeros of the joints between the first and the last, whose own are base and tool as well."""
    inner = [j for j in range(1, chain.n - 1) if chain.revolute[j]]
    if len(inner) > _MAX_INNER:
        return
    for quarters in product(range(4), repeat=len(inner)):
        c = np.zeros(chain.n)
        c[inner] = 0.5 * np.pi * np.array(quarters)
        yield _Map(np.eye(chain.n), c)


def _mixtures(n: int) -> Iterator[_Map]:
    """What undoes sums, differences and means of two columns, and angles that add up along the arm."""
    for first in range(n - 2):
        for last in range(first + 3, n + 1):
            B = np.eye(n)
            B[first:last, first:last] = np.tril(np.ones((last - first, last - first)))
            yield _Map(np.asarray(np.linalg.inv(B), dtype=float), np.zeros(n))
    for i, j in combinations(range(n), 2):
        for values in product((-1.0, 0.0, 1.0), repeat=4):
            B = np.array(values).reshape(2, 2)
            det = float(B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0])
            if det == 0.0:
                continue
            for scale in (1.0, 2.0) if abs(det) == 2.0 else (1.0,):
                M = np.eye(n)
                M[np.ix_((i, j), (i, j))] = scale * np.linalg.inv(B)
                yield _Map(M, np.zeros(n))


def _fitted(samples: Samples, chain: Chain, start: _Map, moved: np.ndarray) -> _Map | None:
    """The map from this start, where a nominal arm misses by no more than its own errors with it; None otherwise."""
    poses, scale, state = bool(samples.is_pose.all()), np.array(limits(chain)), _placed(samples, chain, start)
    r, G = _rows(samples, chain, state, moved, poses, scale)
    damping, cost = 1e-3, _cost(r)
    for _ in range(_ROUNDS):
        weight = np.repeat(1.0 / (1.0 + np.sum(r**2, axis=1)), r.shape[1])  # Cauchy
        flat = G.reshape(-1, G.shape[2])
        H = (flat.T * weight) @ flat
        D = np.diag(H)
        step = np.linalg.solve(H + np.diag(damping * D + 1e-9 * D.max()), flat.T @ (weight * r.ravel()))
        moved_on = _stepped(state, step, moved)
        r_there, G_there = _rows(samples, chain, moved_on, moved, poses, scale)
        now = _cost(r_there)
        if now > cost:
            damping *= 8.0
            continue
        settled = cost - now < _SETTLED * now
        state, r, G, cost, damping = moved_on, r_there, G_there, now, max(damping / 4.0, 1e-6)
        if settled:
            break
    return _Map(state[0], state[1]) if _explains(state, samples, chain) else None


def _cost(r: Array) -> float:
    return float(np.sum(np.log1p(np.sum(r**2, axis=1))))


_State = tuple[Array, Array, Array, Array, Array, Array]


def _placed(samples: Samples, chain: Chain, start: _Map) -> _State:
    """A map with the base and the tool that it asks for, in closed form."""
    A = frames(chain, samples.q @ start.M.T + start.c).transform(-1)
    Y, X = _turns(A, samples, bool(samples.is_pose.all()))
    _, x, t = tool_and_place(Y, A, samples.reading)
    return start.M, start.c, Y, X, x, t


def _explains(state: _State, samples: Samples, chain: Chain) -> bool:
    """Whether a nominal arm misses the usual station by no more than its own errors."""
    angle, distance = limits(chain)
    turned, gap = _left(samples, chain, state, bool(samples.is_pose.all()))
    return float(np.median(gap)) <= distance and float(np.median(turned)) <= angle


def _turns(A: Array, samples: Samples, poses: bool) -> tuple[Array, Array]:
    if poses:
        Y, X = base_and_tool_turns(A[:, :3, :3], samples.R)
        return np.asarray(Y), np.asarray(X)
    return base_by_positions(A[None], samples.reading[None])[0], np.eye(3)


def _rows(
    samples: Samples, chain: Chain, state: _State, moved: np.ndarray, poses: bool, scale: Array
) -> tuple[Array, Array]:
    """Residuals (N, k) in units of what a nominal arm misses by, and how a step reduces them, (N, k, parameters)."""
    M, c, Y, X, x, t = state
    q = samples.q @ M.T + c
    f = frames(chain, q)
    A, J = f.transform(-1), spatial_jacobian(chain, q, f)
    a, N = A[:, :3, :3], len(q)
    point = se3.apply(A, x)
    gap = samples.reading - (point @ Y.T + t)
    by_joint = Y @ (J[:, :3] + np.cross(J[:, 3:], point[:, :, None], axis=1))  # (N, 3, n)
    reported = samples.q[:, moved]
    # columns: M by rows, c, turn of the base, place of the base, tool point, turn of the tool
    mixed = (by_joint[..., None] * reported[:, None, None, :]).reshape(N, 3, -1)
    eye = np.broadcast_to(np.eye(3), (N, 3, 3))
    G = np.concatenate([mixed, by_joint, -Y @ so3.hat(point), eye, Y @ a, np.zeros((N, 3, 3))], axis=2) / scale[1]
    r = gap / scale[1]
    if poses:
        turn = turns_left(Y, a, X, samples.R)
        to_tool = np.swapaxes(a @ X, 1, 2)
        by = to_tool @ J[:, 3:]
        mixed = (by[..., None] * reported[:, None, None, :]).reshape(N, 3, -1)
        none = np.zeros((N, 3, 6))
        turning = np.concatenate([mixed, by, to_tool, none, eye], axis=2) / scale[0]
        r, G = np.concatenate([r, turn / scale[0]], axis=1), np.concatenate([G, turning], axis=1)
    return r, G


def _stepped(state: _State, step: Array, moved: np.ndarray) -> _State:
    M, c, Y, X, x, t = state
    n, k = len(c), int(moved.sum())
    dM = np.zeros((n, n))
    dM[:, moved] = step[: n * k].reshape(n, k)
    rest = step[n * k :]
    turn, tool = (v * min(1.0, 1.0 / max(float(np.linalg.norm(v)), 1e-12)) for v in (rest[n : n + 3], rest[-3:]))
    return M + dM, c + rest[:n], Y @ so3.exp(turn), X @ so3.exp(tool), x + rest[n + 6 : n + 9], t + rest[n + 3 : n + 6]


def _left(samples: Samples, chain: Chain, state: _State, poses: bool) -> tuple[Array, Array]:
    """Angles [rad] and distances [m] that are left, (N,)."""
    M, c, Y, X, x, t = state
    A = frames(chain, samples.q @ M.T + c).transform(-1)
    gap = np.linalg.norm(samples.reading - (se3.apply(A, x) @ Y.T + t), axis=1)
    if not poses:
        return np.zeros(len(gap)), gap
    return np.linalg.norm(turns_left(Y, A[:, :3, :3], X, samples.R), axis=1), gap


def _said(fit: _Map, samples: Samples, chain: Chain) -> Disagreement | None:
    """Refusal for a joint map: the joints that it changes by more than an arm's errors, and how."""
    names, q = samples.names or chain.names, samples.q
    least = _TURNED * ANGLE
    off = q @ (fit.M - np.eye(chain.n)).T
    shift = off.mean(axis=0) + fit.c
    varies = [i for i in range(chain.n) if off[:, i].std() > least]
    # the zeros of the first and the last joint are as well base and tool
    shifted = [i for i in range(1, chain.n - 1) if i not in varies and abs(np.sin(0.5 * shift[i])) > 0.5 * least]
    odd = (np.abs(fit.M - np.eye(chain.n)) * q.std(axis=0) > least) & ~np.vectorize(_is_simple)(np.abs(fit.M))
    if (not varies and not shifted) or odd.sum() > _MAX_ODD:
        return None
    said = []
    for i in varies:
        terms = [j for j in range(chain.n) if abs(fit.M[i, j]) * q[:, j].std() > least]
        said.append(f"{names[i]} = {_sum([(fit.M[i, j], names[j]) for j in terms])}")
    mixed = [i for i in varies if any(abs(fit.M[i, j]) * q[:, j].std() > least for j in range(chain.n) if j != i)]
    who = _and([names[i] for i in varies])
    what = []
    if mixed:
        what.append(
            f"positions of {who} look mixed with each other or with others, as those of motors: {'; '.join(said)}"
        )
    elif varies:
        what.append(f"positions of {who} look counted in another scale: {'; '.join(said)}")
    if shifted:
        each = _and([f"{names[i]} by {np.degrees(np.angle(np.exp(1j * shift[i]))):.1f}°" for i in shifted])
        what.append(f"zeros of joints look different: {each}")
    remedy = f"check how the positions of {_and([names[i] for i in sorted({*varies, *shifted})])} get into joint_states"
    return Disagreement(", and ".join(what), remedy, len(samples), len(samples))


def _sum(terms: list[tuple[float, str]]) -> str:
    if not terms:
        return "constant"
    out = ""
    for value, name in terms:
        size = _simple(abs(value))
        sign = ("-" if value < 0 else "") if not out else (" - " if value < 0 else " + ")
        out += f"{sign}{size}{name}"
    return out


def _is_simple(value: float) -> bool:
    return any(abs(value - whole) < _WHOLE * max(whole, 1.0) for whole in (0.0, *_SIMPLE))


def _simple(value: float) -> str:
    value = next((whole for whole in _SIMPLE if abs(value - whole) < _WHOLE * whole), value)
    return "" if value == 1.0 else f"{value:.3g} "


def _and(names: list[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else "".join(names)
