"""What proves a reading of columns: the nominal arm that fits.

The core compares meanings by a likelihood that single bad rows do not decide. Here are the hypotheses that only a
table has: joints that it counts otherwise than the robot description, each as a mapping states it; a column that names
which of several targets was measured; rows that belong elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from modcal_core.geometry import Array, so3
from modcal_core.hypotheses import BEYOND_DOUBT, HandEye, Judged, Postures, judge, placed, rivals, same_poses, turnings
from modcal_core.measurements import spread_rows
from modcal_core.robots import Mechanism, forward, takes
from modcal_msgs_py.tables.readings import joint_map

_ROUNDS = 3  # mistakes in how joints are counted that are looked for, one after the other
_HALF = 0.5  # of what is left, by which the reading that is meant must be better
_TURNS = (90.0, -90.0, 180.0)  # degrees, by which zeros differ that were set otherwise
_STEPS = 10  # iterations
_ASTRAY, _ODDS = 0.05, float(np.log(20.0))  # share of readings that may say anything; odds, by which one does
_MOST_TARGETS, _EACH = 12, 5  # targets on a tool, and rows of each
_ROWS, _MAX = 60, 300  # rows that are looked at for the likeliest ways, and judged
_COEFFICIENTS, _TRIED = 13, 8  # of a coordinate; ways that are judged


def is_turned(values: Array) -> bool:
    """Whether columns (N, k) can be read as orientations."""
    return len(values) >= 3 and next(iter(turnings(values)), None) is not None


@dataclass(frozen=True)
class JointCounting:
    """How joints are counted otherwise than the robot description does: as a mapping states it, and in words."""

    stated: Mapping[str, Any]
    words: str

    def applied(self, q: Array, chain: Mechanism) -> Array:
        """Positions (N, n) [rad, m] of what a table holds."""
        M, offset = joint_map({"unit": "rad", **self.stated}, chain.names)
        return chain.followed(q @ M.T + offset)

    def joined(self, other: JointCounting) -> JointCounting:
        """Both."""
        merged: dict[str, Any] = {key: dict(value) for key, value in self.stated.items()}
        for key, value in other.stated.items():
            merged[key] = {**merged.get(key, {}), **value}
        return JointCounting(merged, "; ".join(w for w in (self.words, other.words) if w))


def _corrections(chain: Mechanism) -> Iterator[JointCounting]:
    """Every joint the other way round, with another zero, and counted together with another."""
    names = np.array(chain.names)[chain.own & chain.revolute].tolist()
    for name in chain.own_names:
        yield JointCounting({"sign": {name: -1.0}}, f"{name} counts the other way")
    for name in names:
        for angle in _TURNS:
            words = f"{abs(angle):g}° are {'added to' if angle > 0.0 else 'taken from'} {name}"
            yield JointCounting({"offset": {name: float(np.radians(angle))}}, words)
    for name, other in permutations(names, 2):
        for factor in (1.0, -1.0):
            words = f"{name} is counted together with {other} (so {other} is {'added' if factor > 0 else 'taken off'})"
            yield JointCounting({"coupled": {name: {other: factor}}}, words)


_Way = tuple[int, JointCounting]  # number of the choice of postures, and how it counts joints


def corrected(
    chain: Mechanism, choices: Sequence[Postures], position: Array
) -> tuple[int, JointCounting, list[JointCounting]] | None:
    """Which choice of postures, counted how, makes points (N, 3) fit, and what fits as well; None: nothing does.

    One mistake after the other, each beyond doubt and of half of what is left.
    """
    ways: list[_Way] = [(k, JointCounting({}, "")) for k in range(len(choices))]
    best = next(iter(_all(chain, choices, ways, position)), None)
    alike = list[JointCounting]()
    for _ in range(_ROUNDS):
        if best is None or best.explained(chain):
            break
        tried = [(k, counted.joined(c)) for k, counted in ways for c in _corrections(chain)]
        tried = [(k, c) for k, c in tried if takes(chain, c.applied(choices[k].q, chain)).all()]
        tried = _likeliest(chain, choices, tried, position)
        found = _all(chain, choices, tried, position)
        top = found[0] if found else best
        if top.match.score - best.match.score <= BEYOND_DOUBT or top.share > _HALF * best.share:
            break
        k = tried[top.meaning.postures][0]
        same = [j for j in (top, *rivals(found)) if j.meaning.unit == top.meaning.unit]
        counted = [tried[j.meaning.postures][1] for j in same if tried[j.meaning.postures][0] == k]
        best, (first, *alike) = top, _distinct(chain, counted, choices[k].q)
        ways = [(k, first)]
    (k, counted_so), *others = ways
    return (k, counted_so, alike) if counted_so.stated and not others and best is not None and best.near else None


def _distinct(chain: Mechanism, counted: Sequence[JointCounting], q: Array) -> list[JointCounting]:
    """The same without those that are the first one said otherwise, of which the plainest is kept.

    A joint between two others that turns the other way is one with half a turn added to its neighbours.
    """
    T = [forward(chain, c.applied(q, chain)) for c in counted]
    same = [c for c, other in zip(counted, T, strict=True) if same_poses(T[0], other[:, :3, :3], other[:, :3, 3])]
    plainest = [c.words for c in _corrections(chain)]
    first = min(same, key=lambda c: next((i for i, w in enumerate(plainest) if c.words.endswith(w)), 0))
    return [first, *(c for c in counted if c not in same)]


def _likeliest(chain: Mechanism, choices: Sequence[Postures], tried: list[_Way], position: Array) -> list[_Way]:
    """The ways of counting that leave least of the positions, whatever base, tool and unit are.

    A coordinate of a point of the tool is linear in the tip's turn, its place and 1.
    """
    rows = spread_rows(len(position), _ROWS)
    if len(rows) < 2 * _COEFFICIENTS:
        return tried
    left = []
    for k, counted in tried:
        T = forward(chain, counted.applied(choices[k].q[rows], chain))
        design = np.c_[T[:, :3].reshape(-1, 12), np.ones(len(rows))]
        fit = design @ np.linalg.lstsq(design, position[rows], rcond=1e-9)[0]
        left.append(float(np.median(np.linalg.norm(position[rows] - fit, axis=1))))
    return [tried[i] for i in np.argsort(left, kind="stable")[:_TRIED]]


def _all(chain: Mechanism, choices: Sequence[Postures], ways: Sequence[_Way], position: Array) -> list[Judged]:
    """The meanings of points, of these postures counted in these ways, best first."""
    rows = spread_rows(len(position), _MAX)
    postures = [Postures(c.applied(choices[k].q[rows], chain), choices[k].name) for k, c in ways]
    return judge(chain, postures, position[rows], None)


def by_target(chain: Mechanism, q: Array, position: Array, columns: Mapping[int, Sequence[str]]) -> int | None:
    """The column whose texts tell which of several targets points (N, 3) [m] are of, beyond doubt; None: no column."""
    case = HandEye.of_arrays(chain, q, position)
    plain = placed(case)
    found: list[tuple[float, int]] = []
    for k, texts in columns.items():
        names, of, count = np.unique(np.array(texts), return_inverse=True, return_counts=True)
        if 2 <= len(names) <= _MOST_TARGETS and count.min() >= _EACH:
            told = placed(_of_one_target(case, of))
            gain = told.evidence - 1.5 * (len(names) - 1) * np.log(len(case)) - plain.evidence
            if gain > BEYOND_DOUBT and told.usual[1] < _HALF * plain.usual[1]:
                found.append((gain, k))
    return max(found)[1] if found else None


def _of_one_target(case: HandEye, of: np.ndarray) -> HandEye:
    """The case with all readings as if of the first target. of: which target each row is of, (N,).

    Robust Newton steps of the base's turn and place, and of a place of each target on the tool.
    """
    at = placed(case).placement
    Y, t, x = at.Y, at.t, np.tile(at.x, (int(of.max()) + 1, 1))
    R, N = case.A[:, :3, :3], len(case)
    for _ in range(_STEPS):
        point = (R @ x[of][..., None])[..., 0] + case.A[:, :3, 3]
        gaps = case.p - (point @ Y.T + t)
        G = np.zeros((N, 3, 6 + x.size))
        G[:, :, :3], G[:, :, 3:6] = -Y @ so3.hat(point), np.eye(3)
        for k in range(len(x)):
            G[of == k, :, 6 + 3 * k : 9 + 3 * k] = Y @ R[of == k]
        square = np.sum(gaps**2, axis=1)
        weight = 1.0 / (max(float(np.median(square)) / 2.366, case.scale.position**2) + square)  # Cauchy
        H = np.einsum("n,nij,nik->jk", weight, G, G)
        held = 1e-9 * np.diag(np.maximum(np.diag(H), 1e-300))
        step = np.linalg.solve(H + held, np.einsum("n,nij,ni->j", weight, G, gaps))
        step = step / max(float(np.linalg.norm(step[:3])), 1.0)
        Y, t, x = Y @ so3.exp(step[:3]), t + step[3:6], x + step[6:].reshape(-1, 3)
    return case.read(case.p - (R @ (x[of] - x[0])[..., None])[..., 0] @ Y.T)


def astray(chain: Mechanism, q: Array, position: Array) -> list[tuple[int, int | None]]:
    """Rows of points (N, 3) [m] that fit no base and tool of the others, each with the row that it seems to be of."""
    case = HandEye.of_arrays(chain, q, position)
    fit = placed(case)
    expected = fit.placement.expected(case.A)[1]
    square = max(case.scale.position**2, float(np.median(fit.gap**2)) / 2.366)
    inside = np.log1p(-_ASTRAY) - 0.5 * fit.gap**2 / square - 1.5 * np.log(2.0 * np.pi * square)
    bad = np.log(_ASTRAY) - case.scale.volume - inside > _ODDS
    out: list[tuple[int, int | None]] = []
    for i in np.flatnonzero(bad).tolist():
        away = np.linalg.norm(position[i] - expected, axis=1)
        k = int(np.argmin(away))
        out.append((i, k if k != i and away[k] < case.limits[1] else None))
    return out
