"""What proves a reading of columns: the nominal arm that fits.

The core compares meanings by a likelihood that single bad rows do not decide, and searches for what is written down
wrongly. Here is what only a table has: joints that it counts otherwise than the robot description, each as a mapping
states it; a column that names which of several targets was measured; rows that belong elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import Any

import numpy as np

from modcal_core.geometry import Array, so3
from modcal_core.hypotheses import (
    BEYOND_DOUBT,
    COMMON,
    LENGTHS,
    Answer,
    HandEye,
    Hypothesis,
    Postures,
    explain,
    family,
    placed,
    same_poses,
    turnings,
)
from modcal_core.measurements import spread_rows
from modcal_core.robots import Mechanism, forward, takes

_HALF = 0.5  # of what is left, by which targets of their own must be better than one
_TURNS = (90.0, -90.0, 180.0)  # degrees, by which zeros differ that were set otherwise
_STEPS = 10  # iterations
_ASTRAY, _ODDS = 0.05, float(np.log(20.0))  # share of readings that may say anything; odds, by which one does
_MOST_TARGETS, _EACH = 12, 5  # targets on a tool, and rows of each
_MAX = 300  # rows that are looked at


def is_turned(values: Array) -> bool:
    """Whether columns (N, k) can be read as orientations."""
    return len(values) >= 3 and next(iter(turnings(values)), None) is not None


@dataclass(frozen=True)
class JointCounting:
    """How joints are counted otherwise than in the robot description: positions are ``M r + offset`` of what a table
    holds [rad, m]. words: the same for a person.
    """

    M: Array
    offset: Array
    words: str

    @classmethod
    def none(cls, chain: Mechanism) -> JointCounting:
        """Joints that are counted as in the robot description."""
        return cls(np.eye(chain.n), np.zeros(chain.n), "")

    def applied(self, q: Array, chain: Mechanism) -> Array:
        """Positions (N, n) [rad, m] of what a table holds."""
        return chain.followed(q @ self.M.T + self.offset)

    def then(self, other: JointCounting) -> JointCounting:
        """Both, the other applied to what this one makes of a table."""
        words = "; ".join(w for w in (self.words, other.words) if w)
        return JointCounting(other.M @ self.M, other.M @ self.offset + other.offset, words)

    def stated(self, names: Sequence[str]) -> Mapping[str, Any]:
        """The same as a mapping states it."""
        M = {name: dict(zip(names, row, strict=True)) for name, row in zip(names, self.M.tolist(), strict=True)}
        coupled = {name: {n: x for n, x in row.items() if n != name and x} for name, row in M.items()}
        every = {
            "sign": {name: row[name] for name, row in M.items() if row[name] != 1.0},
            "offset": {name: x for name, x in zip(names, self.offset.tolist(), strict=True) if x},
            "coupled": {name: others for name, others in coupled.items() if others},
        }
        return {key: value for key, value in every.items() if value}


def _corrections(chain: Mechanism) -> Iterator[JointCounting]:
    """Every joint the other way round, with another zero, and counted together with another."""
    plain, one, at = JointCounting.none(chain), np.eye(chain.n), {name: j for j, name in enumerate(chain.names)}
    turning = np.array(chain.names)[chain.own & chain.revolute].tolist()
    for name in chain.own_names:
        M = np.diag(np.where(np.arange(chain.n) == at[name], -1.0, 1.0))
        yield JointCounting(M, plain.offset, f"{name} counts the other way")
    for name in turning:
        for angle in _TURNS:
            words = f"{abs(angle):g}° are {'added to' if angle > 0.0 else 'taken from'} {name}"
            yield JointCounting(plain.M, np.radians(angle) * one[at[name]], words)
    for name, other in permutations(turning, 2):
        for factor in (1.0, -1.0):
            words = f"{name} is counted together with {other} (so {other} is {'added' if factor > 0 else 'taken off'})"
            yield JointCounting(plain.M + factor * np.outer(one[at[name]], one[at[other]]), plain.offset, words)


def _undone(counted: JointCounting, case: HandEye) -> HandEye:
    return case.moved(counted.applied(case.q, case.chain))


def corrected(
    chain: Mechanism, choices: Sequence[Postures], position: Array, units: Sequence[str]
) -> tuple[int, list[JointCounting]] | None:
    """Which choice of postures makes points (N, 3) in one of these units fit, and how joints are then counted, the
    likeliest first; None: nothing does.
    """
    rows = spread_rows(len(position), _MAX)
    parts = {c.words: c for c in _corrections(chain)}
    best: tuple[int, Answer] | None = None
    for k, choice in enumerate(choices):
        q = choice.q[rows]
        possible = [c for c in parts.values() if takes(chain, c.applied(q, chain)).all()]
        table = family(COMMON, [Hypothesis(c.words, "", partial(_undone, c), 0.0, touches="joints") for c in possible])
        for unit in units:
            case = HandEye.of_arrays(chain, q, LENGTHS[unit] * position[rows])
            answer = explain(case.read(volume=3.0 * float(np.log(LENGTHS[unit]))), table)
            if answer.gain > BEYOND_DOUBT and (best is None or answer.after.evidence > best[1].after.evidence):
                best = k, answer
    if best is None:
        return None
    k, answer = best
    said = [h.what for h in answer.said]
    ways = [said, *([*said[:i], rival, *said[i + 1 :]] for rival in answer.rivals for i in range(len(said)))]
    out = []
    for way in ways:
        counted = JointCounting.none(chain)
        for name in way:
            counted = counted.then(parts[name])
        out.append(counted)
    first, *others = (forward(chain, counted.applied(choices[k].q, chain)) for counted in out)
    # a joint between two others that turns the other way is one with half a turn added to its neighbours
    apart = [not same_poses(first, T[:, :3, :3], T[:, :3, 3]) for T in others]
    return k, [out[0], *(counted for counted, own in zip(out[1:], apart, strict=True) if own)]


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
