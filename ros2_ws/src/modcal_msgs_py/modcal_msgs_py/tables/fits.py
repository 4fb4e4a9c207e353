"""What columns may mean: fragments of a mapping, read by what reads mappings, with the likelihood of what that gives.

The core compares meanings by a likelihood that single bad rows do not decide, and searches for what is written down
wrongly. Here is what only a table has: joints that it counts otherwise than the robot description; a column that names
which of several targets was measured; rows that belong elsewhere.

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

from modcal_core.geometry import Array
from modcal_core.hypotheses import (
    BEYOND_DOUBT,
    COMMON,
    LENGTHS,
    Answer,
    HandEye,
    Hypothesis,
    Judged,
    SightMatch,
    explain,
    family,
    judge,
    placed,
    same_poses,
)
from modcal_core.measurements import spread_rows
from modcal_core.robots import Mechanism, forward, takes
from modcal_msgs_py.tables.columns import Body, LabelledJoints, Numbers
from modcal_msgs_py.tables.readings import MAX_RAD, joint_map, map_stated, orientations, positions

_COMPUTED = 1e-5  # m; the nominal arm misses no measurement by so little
_GOAL = 0.1  # of what goal minus deviation leaves: the nominal arm reproduces a goal, rounded as it may be


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
        """Labelled columns as a mapping reads them that states these units."""
        whole = {**stated, "columns": dict(zip(chain.own_names, numbers.keys(joints.columns), strict=True))}
        q = np.zeros((len(numbers.values), chain.n))
        q[:, chain.own] = positions(numbers.table, whole, chain.own_names)
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
class MappingCandidate:
    """Joints and readings as a mapping states them, and how well the nominal arm fits what that reads. explained: so
    well that no other is looked for.
    """

    choice: JointChoice
    stated: Mapping[str, Any]
    fit: Judged | SightMatch
    explained: bool

    @property
    def missed(self) -> str:
        """What is left, in words."""
        turned = isinstance(self.fit, Judged) and self.fit.meaning.way is not None
        turn = f" and {np.degrees(self.fit.typical_angle):.2g}°" if isinstance(self.fit, Judged) and turned else ""
        return f"{1e3 * self.fit.typical:.3g} mm{turn}"

    def beyond(self, other: MappingCandidate) -> bool:
        """Whether it is better than another beyond doubt."""
        return self.fit.score - other.fit.score > BEYOND_DOUBT

    def otherwise(self, other: MappingCandidate, word: str) -> str:
        """What another one states in place of this one's."""
        one, two = ({**each.stated, "joints": each.choice.stated} for each in (self, other))
        return "; ".join(differences(one, two, word))

    def worse(self, other: MappingCandidate) -> str:
        """By how much another one fits worse, in words."""
        by = f"{self.fit.score - other.fit.score:.0f} in log-likelihood, {BEYOND_DOUBT:.0f} decides"
        return f"worse by {by}; it leaves {other.missed}"


@dataclass(frozen=True)
class Fitted:
    """Columns with what they may mean, the likeliest first. what: they are, in words. zeros: columns that are all zero
    where nothing was read.
    """

    what: str
    found: Sequence[MappingCandidate]
    rows: np.ndarray
    columns: tuple[int, ...]
    zeros: tuple[int, ...]

    @property
    def best(self) -> MappingCandidate:
        """The likeliest meaning."""
        return self.found[0]

    @property
    def rivals(self) -> list[MappingCandidate]:
        """The meanings that the data cannot tell from the best."""
        return [other for other in self.found[1:] if not self.best.beyond(other)]

    def proved(self) -> list[str]:
        """What the data shows, with what came second."""
        best, counted = self.best, self.best.choice.counted
        out = [f"{self.what} as stated: the nominal arm misses {len(self.rows)} rows by {best.missed} (median)"]
        if counted:
            out.append(f"joints are counted otherwise than the robot description does: {counted}")
        for other in self.found[1:2]:
            out.append(f"second best, {best.worse(other)}: {best.otherwise(other, 'in place of')}")
        return out


@dataclass(frozen=True)
class FittedBody(Fitted):
    """The same of a body's positions. target: the column that tells which target was measured."""

    body: Body
    target: int | None = None

    @classmethod
    def of(
        cls,
        numbers: Numbers,
        chain: Mechanism,
        body: Body,
        choices: Sequence[JointChoice],
        rows: np.ndarray,
        target: int | None = None,
    ) -> FittedBody | None:
        """A body with what its columns may mean, in these rows; None where they can mean nothing."""
        position, turned = body.read(numbers, rows)
        ways = [] if turned is None else orientations(turned)[: 1 if body.points else None]  # as the mapping makes them
        found = judge(chain, [c.q[rows] for c in choices], position, turned, [way.rotations for way in ways])
        found = [f for f in found if not (body.points and f.meaning.inverse)]
        told = [f for f in found if f.meaning.unit == numbers.labels[body.position[0]].unit]
        found = told if any(f.explained(chain) for f in told) else found
        if not found:
            return None
        marked = {} if target is None else {"target": numbers.key(target)}
        key = "targets" if body.points else "point" if turned is None else "pose"
        some = []
        for judged in found:
            meaning = judged.meaning
            stated = {"frame": "tracker", "unit": meaning.unit, **body.stated(numbers), **marked}
            if key == "pose":
                stated |= ways[meaning.way or 0].stated(numbers.keys(body.turned or ()))
                stated |= {"inverse": True} if meaning.inverse else {}
            some.append(MappingCandidate(choices[meaning.postures], {key: stated}, judged, judged.explained(chain)))
        columns = (*body.columns, *(() if target is None else (target,)))
        return cls(f"joints and {key}", some, rows, columns, body.zeros, body, target)

    @property
    def judged(self) -> Judged:
        """How well the likeliest meaning fits."""
        assert isinstance(self.best.fit, Judged)
        return self.best.fit

    @property
    def computed(self) -> bool:
        """Whether the nominal arm says the same to some micrometres: then nobody measured it."""
        return self.judged.typical < _COMPUTED


@dataclass(frozen=True)
class TableRead:
    """What a table's rows hold: joints, and readings where there are any. questions, assumed: for a person."""

    choice: JointChoice
    rows: np.ndarray
    parts: Sequence[Fitted]
    questions: Sequence[str] = ()
    assumed: Sequence[str] = ()

    @property
    def columns(self) -> list[int]:
        """Columns of the readings."""
        return [k for part in self.parts for k in part.columns]

    @property
    def stated(self) -> dict[str, Any]:
        """Joints and readings as a mapping states them."""
        found: dict[str, Any] = {}
        for key, each in (pair for part in self.parts for pair in part.best.stated.items()):
            found[key] = [*found.get(key, ()), *each] if isinstance(each, list) else each
        one = {key: each[0] if isinstance(each, list) and len(each) == 1 else each for key, each in found.items()}
        return {"joints": dict(self.choice.stated), **one}


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


# --- Readings that a table holds as a goal and a deviation from it, as reports of accuracy tests do


def with_deviations(numbers: Numbers, places: Sequence[Body], away: tuple[int, ...]) -> list[Body]:
    """The same places, behind each labelled position in the deviation's unit the same less the deviation."""
    out: list[Body] = []
    for body in places:
        out.append(body)
        alike = away and numbers.labels[away[0]].unit in (None, numbers.labels[body.position[0]].unit)
        if alike and body.named and body.turned is None and not body.points:
            out.append(replace(body, away=away, computed=False))
    return out


def decided(numbers: Numbers, fits: Sequence[FittedBody]) -> tuple[list[FittedBody], list[str]]:
    """Fits without the goals of deviations, or without deviations where nothing is a goal; and what is to be asked."""
    out = [f for f in fits if not f.body.away]
    for plain in [f for f in out if f.body.turned is None]:
        reached = next((f for f in fits if f.body.away and f.body.position == plain.body.position), None)
        if reached is not None and plain.judged.typical < _GOAL * reached.judged.typical:
            goal, away = numbers.shown(*plain.body.position), numbers.shown(*reached.body.away)
            question = (
                f"{goal} are goals, for the nominal arm reproduces them; what was reached is {goal} minus {away}, or "
                "plus it, which no fit can tell: keep minus, or write plus (the wrong one doubles every error)"
            )
            rest = [f for f in out if set(f.body.position) != set(plain.body.position)]
            return [reached, *(f for f in rest if f.computed)], [question]
    return out, []


# --- What the core's search is asked of a table

_HALF = 0.5  # of what is left, by which targets of their own must be better than one
_TURNS = (90.0, -90.0, 180.0)  # degrees, by which zeros differ that were set otherwise
_STEPS = 3  # iterations
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


def by_target(case: HandEye, columns: Mapping[int, np.ndarray]) -> int | None:
    """The column whose texts (N,) tell which of several targets the case's points are of, beyond doubt; None: none."""
    plain, found = placed(case), list[tuple[float, int]]()
    for k, texts in columns.items():
        names, of, count = np.unique(texts, return_inverse=True, return_counts=True)
        if 2 <= len(names) <= _MOST_TARGETS and count.min() >= _EACH:
            told = placed(_of_one_target(case, of))
            gain = told.evidence - 1.5 * (len(names) - 1) * np.log(len(case)) - plain.evidence
            if gain > BEYOND_DOUBT and told.usual[1] < _HALF * plain.usual[1]:
                found.append((gain, k))
    return max(found)[1] if found else None


def _of_one_target(case: HandEye, of: np.ndarray) -> HandEye:
    """The case with all readings as if of the first target. of: which target each row is of, (N,).

    Base and target are those of the target with most rows, and then of all rows; every other target is where the median
    of its readings lies in the tip's frame.
    """
    R, most = case.A[:, :3, :3], of == np.argmax(np.bincount(of))
    known = case.select(np.flatnonzero(most))
    for _ in range(_STEPS):
        placement = placed(known).placement
        tip = (case.p - placement.t) @ placement.Y - case.A[:, :3, 3]
        inside = (np.swapaxes(R, 1, 2) @ tip[..., None])[..., 0]
        x = np.array([np.median(inside[of == k], axis=0) for k in range(int(of.max()) + 1)])
        known = case.read(case.p - (R @ (x[of] - x[0])[..., None])[..., 0] @ placement.Y.T)
    return known


def astray(case: HandEye) -> list[tuple[int, int | None]]:
    """Rows whose points fit no base and tool of the others, each with the row that it seems to be of."""
    case = HandEye.of_arrays(case.chain, case.q, case.p)
    fit = placed(case)
    expected = fit.placement.expected(case.A)[1]
    square = max(case.scale.position**2, float(np.median(fit.gap**2)) / 2.366)
    inside = np.log1p(-_ASTRAY) - 0.5 * fit.gap**2 / square - 1.5 * np.log(2.0 * np.pi * square)
    bad = np.log(_ASTRAY) - case.scale.volume - inside > _ODDS
    out: list[tuple[int, int | None]] = []
    for i in np.flatnonzero(bad).tolist():
        away = np.linalg.norm(case.p[i] - expected, axis=1)
        k = int(np.argmin(away))
        out.append((i, k if k != i and away[k] < case.limits[1] else None))
    return out
