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
from functools import partial
from itertools import permutations, product
from typing import Any

import numpy as np

from modcal_core.geometry import Array, so3
from modcal_core.hypotheses import (
    BEYOND_DOUBT,
    COMMON,
    EULER,
    LENGTHS,
    MATRIX,
    QUATERNION,
    Answer,
    HandEye,
    Hypothesis,
    Judged,
    Postures,
    explain,
    family,
    placed,
    same_poses,
)
from modcal_core.measurements import spread_rows
from modcal_core.robots import Mechanism, forward, takes
from modcal_msgs_py.tables.columns import Body, LabelledJoints, Numbers

_COMPUTED = 1e-5  # m; the nominal arm misses no measurement by so little
_GOAL = 0.1  # of what goal plus or minus deviation leaves: the nominal arm reproduces a goal, rounded as it may be
MAX_RAD = 2.0 * np.pi * 1.05  # an angle of a joint beyond it is in degrees


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


@dataclass(frozen=True)
class JointChoice:
    """What the joints' columns are taken for. angle, length: unit of turning joints, and of sliding ones. counted: how
    the table counts them.
    """

    joints: LabelledJoints
    angle: str
    length: str
    counted: JointCounting

    def scales(self, chain: Mechanism) -> Array:
        """What a unit of each joint that has a column is in rad or m."""
        angle = np.pi / 180.0 if self.angle == "deg" else 1.0
        return np.where(chain.revolute[chain.own], angle, LENGTHS[self.length])

    def postures(self, chain: Mechanism, values: Array) -> Array:
        """Joint positions (N, n) [rad, m] of rows of all columns."""
        q = np.zeros((len(values), chain.n))
        q[:, chain.own] = self.scales(chain) * values[:, list(self.joints.columns)]
        return self.counted.applied(q, chain)

    def units(self, chain: Mechanism) -> str:
        """The unit of the joints, of turning ones where there are such."""
        return self.angle if np.any(chain.revolute[chain.own]) else self.length

    def entry(self, numbers: Numbers, chain: Mechanism) -> dict[str, Any]:
        """The joints as a mapping states them."""
        out: dict[str, Any] = {"unit": self.units(chain)}
        sliding = np.array(chain.names)[chain.own & ~chain.revolute].tolist()
        if 0 < len(sliding) < len(chain.own_names):
            out["units"] = dict.fromkeys(sliding, self.length)
        keys = numbers.keys(self.joints.columns)
        out["columns"] = dict(zip(chain.own_names, keys, strict=True))
        for key, value in self.counted.stated(chain.names).items():
            degrees = key == "offset" and self.angle == "deg"
            out[key] = {name: round(float(np.degrees(x)), 6) if degrees else x for name, x in value.items()}
        return out


def choices_of(chain: Mechanism, joints: LabelledJoints, values: Array) -> list[JointChoice]:
    """Units that the joints may be in, of turning and of sliding ones."""
    turning = chain.revolute[chain.own]
    largest = float(np.abs(values[:, list(joints.columns)][:, turning]).max(initial=0.0))
    angles = ["deg"] if largest > MAX_RAD else ["rad", "deg"]
    lengths = ["m"] if turning.all() else list(LENGTHS)
    pairs = product(angles if turning.any() else ["rad"], lengths)
    return [JointChoice(joints, angle, length, JointCounting.none(chain)) for angle, length in pairs]


@dataclass(frozen=True)
class Fitted:
    """One place of columns with its meanings, best first. target: the column that tells which target was measured."""

    body: Body
    choices: tuple[JointChoice, ...]
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
        """The readings as a mapping states them: pose, point or targets. judged: the meaning; None: the best."""
        meaning, body = (judged or self.best).meaning, self.body
        reading: dict[str, Any] = {"frame": "tracker", "unit": meaning.unit}
        if body.points:
            return {"targets": {**reading, "points": {name: numbers.keys(triple) for name, triple in body.points}}}
        reading["position"] = numbers.keys(body.position)
        if body.away:
            reading["plus" if body.sign > 0.0 else "minus"] = numbers.keys(body.away)
        if self.target is not None:
            reading["target"] = numbers.key(self.target)
        turning = meaning.turning
        if turning is None or body.turned is None:
            return {"point": reading}
        stated: dict[str, Any] = {"columns": numbers.keys([body.turned[i] for i in turning.order])}
        if turning.form == EULER:
            stated["sequence"] = turning.sequence
        if turning.form not in (QUATERNION, MATRIX):
            stated["unit"] = "deg" if turning.degrees else "rad"
        if turning.conjugate:
            stated["conjugate"] = True
        return {"pose": {**reading, turning.form: stated, **({"inverse": True} if meaning.inverse else {})}}

    def otherwise(self, numbers: Numbers, chain: Mechanism, other: Judged, word: str) -> str:
        """What a mapping of another meaning would state in place of the best one's."""
        one, two = (
            {**self.entry(numbers, judged), "joints": self.choices[judged.meaning.postures].entry(numbers, chain)}
            for judged in (self.best, other)
        )
        return "; ".join(differences(one, two, word))

    def proved(self, numbers: Numbers, chain: Mechanism) -> list[str]:
        """What the data shows, with what came second."""
        (key,) = self.entry(numbers)
        out = [
            f"joints and {key} as stated: the nominal arm misses {len(self.rows)} rows by {missed(self.best)} (median)"
        ]
        if self.choice.counted.words:
            out.append(f"joints are counted otherwise than the robot description does: {self.choice.counted.words}")
        for other in self.found[1:2]:
            instead = self.otherwise(numbers, chain, other, "in place of")
            out.append(f"second best, {worse(self.best, other)}: {instead}")
        return out


def missed(judged: Judged) -> str:
    """What a meaning leaves, in words."""
    turn = f" and {np.degrees(judged.match.typical_angle):.2g}°" if judged.meaning.turning is not None else ""
    return f"{1e3 * judged.match.typical:.3g} mm{turn}"


def differences(one: Mapping[str, Any], other: Mapping[str, Any], word: str) -> Iterator[str]:
    """What another mapping states differently, key by key: ``pose: unit m``, the word, ``mm``."""
    for key in dict.fromkeys((*one, *other)):
        a, b = one.get(key, "none"), other.get(key, "none")
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
    # a joint between two others that turns the other way is one with half a turn added to its neighbours: the plainest
    T, order = [forward(chain, counted.applied(choices[k].q, chain)) for counted in out], list(parts)
    same = [i for i, own in enumerate(T) if same_poses(T[0], own[:, :3, :3], own[:, :3, 3])]
    first = min(same, key=lambda i: max(order.index(name) for name in ways[i]))
    return k, [out[first], *(counted for i, counted in enumerate(out) if i not in same)]


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
