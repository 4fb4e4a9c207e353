"""One place of columns with what it may mean, best first, in words and as a mapping states it, and what proves it.

The core compares meanings by a likelihood that single bad rows do not decide, and searches for what is written down
wrongly. Here is what only a table has: joints that it counts otherwise than the robot description, each as a mapping
states it; a column that names which of several targets was measured; rows that belong elsewhere.

A table may hold a goal and the deviation from it. The goal is what the nominal arm says of the joints, and no reading;
the reading is the goal plus the deviation or minus it, as *deviation* is understood. To first order every error of the
model explains both alike, with its sign reversed: no fit tells which it is. So it is asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
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
    Judged,
    explain,
    family,
    placed,
    same_poses,
)
from modcal_core.measurements import spread_rows
from modcal_core.robots import Mechanism, forward, takes
from modcal_msgs_py.tables.columns import Body, LabelledJoints, Numbers
from modcal_msgs_py.tables.readings import Orientation, joint_map, map_stated, positions

_COMPUTED = 1e-5  # m; the nominal arm misses no measurement by so little
_GOAL = 0.1  # of what goal plus or minus deviation leaves: the nominal arm reproduces a goal, rounded as it may be
MAX_RAD = 2.0 * np.pi * 1.05  # an angle of a joint beyond it is in degrees


@dataclass(frozen=True)
class JointChoice:
    """What the joints' columns are taken for. stated: the joints as a mapping states them. q: what that reads, (N, n)
    [rad, m]. how: what the columns were chosen by. counted: how they are counted otherwise than in the description.
    """

    columns: tuple[int, ...]
    stated: Mapping[str, Any]
    q: Array
    how: str
    counted: str = ""

    @classmethod
    def read(cls, numbers: Numbers, chain: Mechanism, joints: LabelledJoints, stated: Mapping[str, Any]) -> JointChoice:
        """Labelled columns as a mapping reads them that states their units, and may state how they are counted."""
        names = chain.own_names
        columns = dict(zip(names, numbers.keys(joints.columns), strict=True))
        units = {key: stated[key] for key in ("unit", "units") if key in stated}
        whole = {**units, "columns": columns, **stated}
        q = np.zeros((len(numbers.values), chain.n))
        q[:, chain.own] = positions(numbers.table, whole, names)
        return cls(joints.columns, whole, chain.followed(q), joints.how)

    def recounted(self, chain: Mechanism, counting: Counting) -> JointChoice:
        """The same columns, counted otherwise."""
        stated = {**self.stated, **map_stated(counting.M, counting.offset, chain.own_names, self.stated["unit"])}
        return replace(self, stated=stated, q=counting.applied(self.q, chain), counted=counting.words)


def choices_of(numbers: Numbers, chain: Mechanism, joints: LabelledJoints, rows: np.ndarray) -> list[JointChoice]:
    """Units that the joints may be in, of turning and of sliding ones, by their numbers in these rows."""
    turning = chain.revolute[chain.own]
    largest = float(np.abs(numbers.values[np.ix_(rows, np.array(joints.columns)[turning])]).max(initial=0.0))
    angles = ["deg"] if largest > MAX_RAD else ["rad", "deg"]
    sliding = [name for name, turns in zip(chain.own_names, turning.tolist(), strict=True) if not turns]
    stated: list[dict[str, Any]] = [{"unit": unit} for unit in (angles if turning.any() else LENGTHS)]
    if sliding and turning.any():
        stated = [{**angle, "units": dict.fromkeys(sliding, length)} for angle in stated for length in LENGTHS]
    return [JointChoice.read(numbers, chain, joints, units) for units in stated]


@dataclass(frozen=True)
class Fitted:
    """One place of columns with its meanings, best first. ways: to read its orientations. target: the column that tells
    which target was measured.
    """

    body: Body
    choices: tuple[JointChoice, ...]
    ways: tuple[Orientation, ...]
    found: tuple[Judged, ...]
    rows: np.ndarray
    target: int | None = None

    @property
    def best(self) -> Judged:
        """The likeliest meaning."""
        return self.found[0]

    @property
    def choice(self) -> JointChoice:
        """What it takes the joints for."""
        return self.choices[self.best.meaning.postures]

    @property
    def way(self) -> Orientation | None:
        """How it reads orientations, None where there are none."""
        return None if self.best.meaning.way is None else self.ways[self.best.meaning.way]

    @property
    def computed(self) -> bool:
        """Whether the nominal arm says the same to some micrometres: then nobody measured it."""
        return self.best.match.typical < _COMPUTED

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of the readings."""
        return (*self.body.columns, *(() if self.target is None else (self.target,)))

    @property
    def zeros(self) -> tuple[int, ...]:
        """Columns that are all zero where nothing was read."""
        return self.body.zeros

    def entry(self, numbers: Numbers, judged: Judged | None = None) -> dict[str, Any]:
        """Joints and readings as a mapping states them: pose, point or targets. judged: the meaning; None: the best."""
        meaning, body = (judged or self.best).meaning, self.body
        joints = self.choices[meaning.postures].stated
        reading: dict[str, Any] = {"frame": "tracker", "unit": meaning.unit, **body.stated(numbers)}
        if body.points:
            return {"targets": reading, "joints": joints}
        if self.target is not None:
            reading["target"] = numbers.key(self.target)
        if meaning.way is None or body.turned is None:
            return {"point": reading, "joints": joints}
        reading |= self.ways[meaning.way].stated(numbers.keys(body.turned))
        return {"pose": {**reading, **({"inverse": True} if meaning.inverse else {})}, "joints": joints}

    def otherwise(self, numbers: Numbers, other: Judged, word: str) -> str:
        """What a mapping of another meaning would state in place of the best one's."""
        return "; ".join(differences(self.entry(numbers), self.entry(numbers, other), word))

    def proved(self, numbers: Numbers) -> list[str]:
        """What the data shows, with what came second."""
        key, _ = self.entry(numbers)
        out = [
            f"joints and {key} as stated: the nominal arm misses {len(self.rows)} rows by {missed(self.best)} (median)"
        ]
        if self.choice.counted:
            out.append(f"joints are counted otherwise than the robot description does: {self.choice.counted}")
        for other in self.found[1:2]:
            out.append(f"second best, {worse(self.best, other)}: {self.otherwise(numbers, other, 'in place of')}")
        return out


def missed(judged: Judged) -> str:
    """What a meaning leaves, in words."""
    turn = f" and {np.degrees(judged.match.typical_angle):.2g}°" if judged.meaning.way is not None else ""
    return f"{1e3 * judged.match.typical:.3g} mm{turn}"


def differences(one: Mapping[str, Any], other: Mapping[str, Any], word: str) -> Iterator[str]:
    """What another mapping states differently, key by key: ``pose: unit m``, the word, ``mm``; of lists of instruments,
    which are read alike, the first.
    """
    for key in dict.fromkeys((*one, *other)):
        a, b = one.get(key, "none"), other.get(key, "none")
        if isinstance(a, list) and isinstance(b, list) and isinstance(a[0], Mapping):
            a, b = a[0], b[0]
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from (f"{key}: {said}" for said in differences(a, b, word))
        elif a != b:
            yield f"{key} {b} {word} {a}"


def worse(best: Judged, other: Judged) -> str:
    """By how much another meaning fits worse than the best, in words."""
    by = f"{best.match.score - other.match.score:.0f} in log-likelihood, {BEYOND_DOUBT:.0f} decides"
    return f"worse by {by}; it leaves {missed(other)}"


# --- Readings that a table holds as a goal and a deviation from it, as reports of accuracy tests do


def with_deviations(numbers: Numbers, places: Sequence[Body], away: tuple[int, ...]) -> list[Body]:
    """The same places, behind each labelled position in the deviation's unit its sum with the deviation, both ways."""
    out: list[Body] = []
    for body in places:
        out.append(body)
        alike = away and numbers.labels[away[0]].unit in (None, numbers.labels[body.position[0]].unit)
        if alike and body.named and body.turned is None and not body.points:
            out += [replace(body, away=away, sign=sign, computed=False) for sign in (-1.0, 1.0)]
    return out


def decided(numbers: Numbers, fits: Sequence[Fitted]) -> tuple[list[Fitted], tuple[str, ...]]:
    """Fits without the goals of deviations, or without deviations where nothing is a goal; and what is to be asked."""
    out = [f for f in fits if not f.body.away]
    for plain in [f for f in out if f.body.turned is None]:
        sums = [f for f in fits if f.body.away and f.body.position == plain.body.position]
        if len(sums) == 2 and plain.best.match.typical < _GOAL * min(f.best.match.typical for f in sums):
            minus = min(sums, key=lambda f: f.body.sign)
            goal, away = numbers.shown(*plain.body.position), numbers.shown(*minus.body.away)
            question = (
                f"{goal} are goals, for the nominal arm reproduces them; what was reached is {goal} minus {away}, or "
                "plus it, which no fit can tell: keep minus, or write plus (the wrong one doubles every error)"
            )
            rest = [f for f in out if set(f.body.position) != set(plain.body.position)]
            return [minus, *(f for f in rest if f.computed)], (question,)
    return out, ()


# --- What the core's search is asked of a table

_HALF = 0.5  # of what is left, by which targets of their own must be better than one
_TURNS = (90.0, -90.0, 180.0)  # degrees, by which zeros differ that were set otherwise
_STEPS = 10  # iterations
_ASTRAY, _ODDS = 0.05, float(np.log(20.0))  # share of readings that may say anything; odds, by which one does
_MOST_TARGETS, _EACH = 12, 5  # targets on a tool, and rows of each
_MAX = 300  # rows that are looked at


@dataclass(frozen=True)
class Counting:
    """How joints are counted otherwise than in the robot description: positions are ``M r + offset`` of what a table
    holds [rad, m]. words: the same for a person.
    """

    M: Array
    offset: Array
    words: str

    def applied(self, q: Array, chain: Mechanism) -> Array:
        """Positions (N, n) [rad, m] of joints that are counted so."""
        out = np.zeros_like(q)
        out[:, chain.own] = q[:, chain.own] @ self.M.T + self.offset
        return chain.followed(out)


def _corrections(names: Sequence[str], turning: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every joint the other way round, with another zero, and counted together with another: in words, and as a mapping
    states it.
    """
    for name in names:
        yield f"{name} counts the other way", {"sign": {name: -1.0}}
    for name, angle in product(turning, _TURNS):
        added = "added to" if angle > 0.0 else "taken from"
        yield f"{abs(angle):g}° are {added} {name}", {"offset": {name: angle}}
    for (name, other), factor in product(permutations(turning, 2), (1.0, -1.0)):
        added = "added" if factor > 0.0 else "taken off"
        words = f"{name} is counted together with {other} (so {other} is {added})"
        yield words, {"coupled": {name: {other: factor}}}


def corrected(
    chain: Mechanism, choices: Sequence[Array], position: Array, units: Sequence[str]
) -> tuple[int, list[Counting]] | None:
    """Which choice of postures makes points (N, 3) in one of these units fit, and how joints are then counted, the
    likeliest first; None: nothing does.
    """
    rows, names = spread_rows(len(position), _MAX), chain.own_names
    turning = [name for name, turns in zip(names, chain.revolute[chain.own].tolist(), strict=True) if turns]
    stated = dict(_corrections(names, turning))
    parts = {w: Counting(*joint_map({"unit": "deg", **one}, names), w) for w, one in stated.items()}
    best: tuple[int, Answer] | None = None
    for k, q in enumerate(choices):
        possible = [c for c in parts.values() if takes(chain, c.applied(q[rows], chain)).all()]
        undone = [lambda case, c=c: case.moved(c.applied(case.q, chain)) for c in possible]
        some = zip(possible, undone, strict=True)
        table = family(COMMON, [Hypothesis(c.words, "", undo, 0.0, touches="joints") for c, undo in some])
        for unit in units:
            case = HandEye.of_arrays(chain, q[rows], LENGTHS[unit] * position[rows])
            answer = explain(case.read(volume=3.0 * float(np.log(LENGTHS[unit]))), table)
            if answer.gain > BEYOND_DOUBT and (best is None or answer.after.evidence > best[1].after.evidence):
                best = k, answer
    if best is None:
        return None
    k, answer = best
    said = [h.what for h in answer.said]
    ways = [said, *([*said[:i], rival, *said[i + 1 :]] for rival in answer.rivals for i in range(len(said)))]
    out = [_together([parts[name] for name in way]) for way in ways]
    # a joint between two others that turns the other way is one with half a turn added to its neighbours: the plainest
    T, order = [forward(chain, counted.applied(choices[k], chain)) for counted in out], list(parts)
    same = [i for i, own in enumerate(T) if same_poses(T[0], own[:, :3, :3], own[:, :3, 3])]
    first = min(same, key=lambda i: max(order.index(name) for name in ways[i]))
    return k, [out[first], *(counted for i, counted in enumerate(out) if i not in same)]


def _together(parts: Sequence[Counting]) -> Counting:
    """One counting after the other."""
    M, offset = np.eye(len(parts[0].M)), np.zeros(len(parts[0].M))
    for part in parts:
        M, offset = part.M @ M, part.M @ offset + part.offset
    return Counting(M, offset, "; ".join(part.words for part in parts))


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
