"""A mapping for a table that has none: what its columns are, proved by the nominal arm that fits, or asked.

The text says how the file is written (:mod:`sheet`), labels and numbers which columns may be what (:mod:`labels`,
:mod:`columns`). Each is a fragment of a mapping, and the nominal arm says which is right (:mod:`fits`, :mod:`sights`);
the other columns are stated in a draft of the entry (:mod:`beside`). Where two fit alike, nothing is chosen in silence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.hypotheses import LENGTHS, MIN_ROWS, judge, likely_orders, same_poses
from modcal_core.measurements import spread_rows
from modcal_core.robots import Mechanism, is_serial_arm
from modcal_msgs_py.tables.beside import Draft, MeasuredArm, find_beside
from modcal_msgs_py.tables.columns import (
    Body,
    LabelledJoints,
    Numbers,
    bodies,
    deviation_columns,
    joint_columns,
    orthonormal,
    pool,
    rigid_bodies,
)
from modcal_msgs_py.tables.convert import ENTRY
from modcal_msgs_py.tables.fits import (
    FittedBody,
    JointChoice,
    TableRead,
    astray,
    by_target,
    choices_of,
    corrected,
    decided,
    with_deviations,
)
from modcal_msgs_py.tables.labels import MEASURED
from modcal_msgs_py.tables.moments import RowTimes, Together, find_time, stamps_of, together
from modcal_msgs_py.tables.readings import MAX_RAD
from modcal_msgs_py.tables.sights import SightColumns, find_sights, joints_alone, ray_of, sight_columns

_ORDERS = 6  # of columns without labels that are judged in full
_MAX_BODIES = 10  # that are judged where labels do not tell
_MAX = 300  # rows that meanings are judged by
_NO_ARM = "no columns are found that could be the joints of this arm and the position of a target on it"
_CHECK = "check --urdf, --base, --tip and that rows hold joints and readings of one station, or write a mapping"
_WIDTH = 116  # of comments

Watch = Callable[[str], None]


@dataclass(frozen=True)
class Proposal:
    """A proposed mapping. proved: what the data shows, with the second best. open: questions."""

    mapping: Mapping[str, Any]
    proved: tuple[str, ...]
    assumed: tuple[str, ...]
    open: tuple[str, ...]

    def text(self, source: str) -> str:
        """The mapping as YAML, with comments."""
        said = (*(f"Proved: {one}." for one in self.proved), *(f"Assumed: {one}." for one in self.assumed))
        lines = (f"Mapping for modcal import, found out from {source}. Edit it where it is wrong.", *said)
        folded = (part for line in lines for part in wrap(line, _WIDTH, subsequent_indent="  ", break_on_hyphens=False))
        return "".join(f"# {part}\n" for part in folded) + to_yaml(self.mapping)


def find(paths: Sequence[Path], arm: MeasuredArm | Mechanism, watch: Watch = lambda stage: None) -> Proposal:
    """A mapping for a file; of several, joined by a column that they share, or by their order where the arm then fits.

    Raises BadTable where no reading of the columns has to do with the arm at all.
    """
    arm = arm if isinstance(arm, MeasuredArm) else MeasuredArm(arm)
    watch(f"reading {paths[0].name}")
    ways = together(paths)
    refusals, found = list[BadTable](), list[Proposal]()
    for way in ways:
        try:
            found.append(_found(way, arm, watch))
        except BadTable as error:
            refusals.append(error)
            continue
        if not found[-1].open:
            break
    if not found:
        raise refusals[0]
    return min(found, key=lambda made: len(made.open))


def _rays_alone(way: Together, numbers: Numbers) -> Proposal | None:
    """The mapping of a table of lengths of rays without joints, as of boxes in a gripper; None for another one."""
    time = find_time(numbers, set())
    rays = [ray_of(numbers, one) for one in sight_columns(numbers, set(time.columns)) if len(one.columns) == 1]
    if not rays or len(rays) + len(time.columns) < len(numbers.usable):
        return None
    asked, rows = list[str](), list[dict[str, Any]]()
    for one in rays:
        unit = numbers.labels[one.columns[0]].unit
        asked += [] if unit else [f"cannot tell the unit of {numbers.shown(*one.columns)}: no label says"]
        rows.append(one.stated(numbers, {"unit": unit or "mm", "column": None}))
    entry = {"files": way.sheet.path.name, **way.sheet.form.entry(), "missing": "skip"}
    entry |= {"time": time.stated, "ray": rows}
    said = (time.said, "lengths without joints are rays of sensors on the gripper, for `modcal measure-object`")
    return Proposal({**({"undecided": asked} if asked else {}), "tables": [entry]}, (), said, tuple(asked))


def _found(way: Together, arm: MeasuredArm, watch: Watch) -> Proposal:
    numbers, chain = Numbers.of(way.sheet), arm.chain
    joints = joint_columns(numbers, chain.own_names)
    if not joints and (rays := _rays_alone(way, numbers)) is not None:
        return rays
    if len(numbers.values) < MIN_ROWS:
        said = f"has {len(numbers.values)} rows, {MIN_ROWS} are needed to tell what its columns are"
        raise BadTable(way.sheet.path.name, said, "write a mapping, see docs/import.md")
    sure = orthonormal(numbers)
    labelled = [j for j in joints if not set(j.columns) & sure]
    taken = {k for j in labelled for k in j.columns}
    time = find_time(numbers, taken)
    watch("comparing what columns may mean")
    search = _Search(numbers, chain, [j for j in labelled if j.role == MEASURED], set(time.columns), watch)
    away = deviation_columns(numbers, {*taken, *time.columns})
    places = with_deviations(numbers, bodies(numbers, {*taken, *away}, set(time.columns)), away)
    read = search.read(places, sight_columns(numbers, {*taken, *time.columns, *sure}), labelled)
    draft = _drafted(arm, time, way, numbers, read)
    find_beside(draft, labelled, next((part for part in read.parts if isinstance(part, FittedBody)), None))
    return _made(draft, way, read, set(time.columns))


@dataclass(frozen=True)
class _Search:
    """Likely places of the readings in a table, with what they may mean. measured: joints by their labels. time: its
    columns.
    """

    numbers: Numbers
    chain: Mechanism
    measured: Sequence[LabelledJoints]
    time: set[int]
    watch: Watch

    def read(
        self, places: Sequence[Body], instruments: Sequence[SightColumns], labelled: Sequence[LabelledJoints]
    ) -> TableRead:
        """What the rows hold. Raises BadTable where no reading of the columns has to do with the arm."""
        numbers, chain = self.numbers, self.chain
        fits = self._every_fit(places, instruments)
        if isinstance(fits, TableRead):
            return fits
        fits = self._otherwise(fits)
        if not fits and self.measured:
            read = joints_alone(numbers, chain, self.measured[0])
            told = {k for j in labelled for k in j.columns} | self.time
            left = [k for k in numbers.usable if k not in told]
            unread = f"{numbers.shown(*left)} change and are read as no measurement of the tool: see what they are"
            return replace(read, questions=(*read.questions, *[unread] * bool(left)))
        if not any(f.judged.near for f in fits):
            raise BadTable(numbers.sheet.path.name, *self._no_arm(fits))
        fits, questions = decided(numbers, fits)
        read = _decided(numbers, fits, labelled)
        return replace(read, questions=list(dict.fromkeys((*questions, *read.questions))))

    def _every_fit(self, places: Sequence[Body], instruments: Sequence[SightColumns]) -> list[FittedBody] | TableRead:
        """By labels first, by numbers where labels lead nowhere.

        Targets of one body come before any of them alone, distances, directions and heights behind labelled positions.
        """
        measured, numbers = self.measured, self.numbers
        posed = [b for b in places if b.named and b.turned]
        named = posed or [b for b in places if b.named]
        points = [b for b in places if b.turned is None]
        among = places if measured else bodies(numbers, set(), self.time)
        other = [b for b in among if not b.named and b.turned]
        fits = self._fits(rigid_bodies(numbers, places), measured) if measured else []
        tiers = ((named, False), (named, True), (other, False), (points, False), (other, True), (points, True))
        for some, search in tiers:
            if any(f.best.explained and not f.computed for f in fits):
                break
            gone = {k for f in fits if f.computed for k in (*f.body.position, *(f.body.turned or ()))}
            left = [b for b in some if not b.shares(gone)]  # no column of a pose that was computed from the joints
            if search:
                self.watch("looking for the joints' columns")
                fits += self._searched(left)
            elif measured:
                fits += self._fits(left, measured)
            chain = self.chain
            told = any(f.best.explained and not f.computed for f in fits)
            if instruments and measured and is_serial_arm(chain) and not told:
                self.watch("comparing what distances and directions may mean")
                if (sighted := find_sights(numbers, chain, measured, instruments)) is not None:
                    return sighted
                instruments = ()
        return fits

    def _fits(self, places: Sequence[Body], choices: Sequence[LabelledJoints]) -> list[FittedBody]:
        """These places with their meanings; of columns that are explained already no other place is looked for."""
        out: list[FittedBody] = []
        for body in places[:_MAX_BODIES]:
            if any(_covers(f.body, body) and f.best.explained for f in out):
                continue
            if (fitted := self._fitted(body, choices)) is not None:
                out.append(fitted)
        return out

    def _fitted(
        self, body: Body, joints: Sequence[LabelledJoints], counted: Sequence[JointChoice] = ()
    ) -> FittedBody | None:
        numbers, values = self.numbers, self.numbers.values
        used = [*body.columns, *(k for j in joints for k in j.columns)]
        rows = np.flatnonzero(np.isfinite(values[:, used]).all(axis=1))
        rows = rows[~(values[np.ix_(rows, np.array(body.zeros))] == 0.0).all(axis=1)]
        if len(rows) < MIN_ROWS:
            return None
        choices = list(counted) or [c for one in joints for c in choices_of(numbers, self.chain, one, rows)]
        return FittedBody.of(numbers, self.chain, body, choices, rows)

    def _searched(self, places: Sequence[Body]) -> list[FittedBody]:
        """Places with the joints' columns found by what they explain of the readings."""
        numbers, chain = self.numbers, self.chain
        triples = list(dict.fromkeys(body.position for body in places))
        taken = set(self.time)
        if places and places[0].named:
            taken |= {k for k, label in numbers.labels.items() if label.plainly_turned}
            taken |= {k for b in places for k in b.position}
            taken |= {k for b in places if b.turned and len(b.turned) > 3 for k in b.turned}  # by its numbers alone
        columns = pool(numbers, taken)
        used = sorted({*columns, *(k for triple in triples for k in triple)})
        whole = np.isfinite(numbers.values[:, used]).all(axis=1)
        if not triples or not whole.any() or not is_serial_arm(chain) or chain.led:  # what follows has no column
            return []
        values = np.where(np.isfinite(numbers.values), numbers.values, 0.0)[whole]
        largest = float(np.median(np.abs(values[:, columns]).max(axis=0))) if columns else 0.0
        orders = [
            order
            for scale in ((np.pi / 180.0,) if largest > MAX_RAD else (1.0, np.pi / 180.0))
            for order in likely_orders(chain, values, scale, columns, [(t[0], t[1], t[2]) for t in triples], _ORDERS)
        ]
        orders.sort(key=lambda order: order.left)
        out: list[FittedBody] = []
        for t in dict.fromkeys(order.triple for order in orders[:_ORDERS]):
            some = dict.fromkeys(order.columns for order in orders if order.triple == t)
            choices = [LabelledJoints(order, "what they explain of the readings") for order in some]
            for body in [b for b in places if b.position == triples[t]][:6]:
                free = [c for c in choices if not body.shares(set(c.columns))][:_ORDERS]
                if free and (fitted := self._fitted(body, free)) is not None:
                    out.append(fitted)
                    if fitted.best.explained and body.turned is not None:
                        return out
        return out

    def _otherwise(self, fits: list[FittedBody]) -> list[FittedBody]:
        """The same, where the arm misses by more than usual with several targets, or with joints that are counted
        otherwise, where that explains it.
        """
        if not fits or not self.measured or any(f.best.explained for f in fits):
            return fits
        self.watch("comparing how joints may be counted")
        labelled = [
            f
            for f in fits
            if f.best.choice.columns in [j.columns for j in self.measured] and not f.body.points and not f.body.away
        ]
        plain = [f for f in labelled if f.body.named] or labelled
        if not plain:
            return fits
        first = max(plain, key=lambda f: (f.judged.near, f.judged.score))
        point = next((f for f in fits if f.body == replace(first.body, turned=None)), None)
        point = point or self._fitted(replace(first.body, turned=None), self.measured) or first
        if (told := self._of_targets(point)) is not None:
            return [told]
        position = point.body.read(self.numbers, point.rows)[0]
        choices = [c for one in self.measured for c in choices_of(self.numbers, self.chain, one, point.rows)]
        unit = self.numbers.labels[point.body.position[0]].unit
        found = corrected(
            self.chain, [c.q[point.rows] for c in choices], position, [unit] if unit in LENGTHS else list(LENGTHS)
        )
        if found is None:
            return fits
        k, counted = found
        some = [choices[k].recounted(self.chain, c) for c in counted]
        alike = [f.body for f in plain if f.body.position == point.body.position]
        joints = [LabelledJoints(some[0].columns, some[0].how)]
        made = [self._fitted(b, joints, some) for b in dict.fromkeys((*alike, point.body))]
        return [f for f in made if f is not None and f.judged.near] or fits

    def _no_arm(self, fits: Sequence[FittedBody]) -> tuple[str, str]:
        """Why nothing is proposed, and what to do about it: the readings' axes, where that is proved."""
        if not fits:
            return _NO_ARM, _CHECK
        best = min(fits, key=lambda f: f.judged.typical)
        postures = [one.choice.q[best.rows] for one in best.found]
        found = judge(self.chain, postures, best.body.read(self.numbers, best.rows)[0] * [1.0, 1.0, -1.0])
        if found and found[0].explained(self.chain):
            names, left = self.numbers.shown(*best.body.position), 1e3 * found[0].typical
            said = f"are left-handed: with one of the axes turned round the nominal arm misses by {left:.3g} mm"
            return f"{names} {said}", "swap two of the columns, or change the sign of one, as the instrument's axes are"
        said = f"{_NO_ARM}; the best leave {1e3 * best.judged.typical:.0f} mm"
        return f"{said}, and no joint that is counted otherwise explains it", _CHECK

    def _of_targets(self, point: FittedBody) -> FittedBody | None:
        """The same if a column tells which of several targets was measured, else None."""
        numbers, choice = self.numbers, point.best.choice
        rows = point.rows[spread_rows(len(point.rows), _MAX)]
        free = set(range(numbers.sheet.width)) - {*point.columns, *choice.columns, *self.time}
        texts = {k: np.array([numbers.sheet.column(k)[i] for i in rows]) for k in sorted(free)}
        column = by_target(point.judged.case, texts) if "point" in point.best.stated else None
        if column is None:
            return None
        names, count = np.unique(texts[column], return_counts=True)
        most = rows[texts[column] == names[np.argmax(count)]]
        found = FittedBody.of(numbers, self.chain, point.body, [choice], most, column)
        return replace(found, rows=point.rows) if found is not None and found.judged.near else None


def _covers(known: Body, body: Body) -> bool:
    turned = known.turned is None or body.turned is None or bool(set(known.turned) & set(body.turned))
    alike = known.away == body.away and bool(set(known.position) & set(body.position))
    return alike and (turned or not body.named)


def _decided(numbers: Numbers, fits: Sequence[FittedBody], labelled: Sequence[LabelledJoints]) -> TableRead:
    """The place that is proposed, what is to be asked, and what is to be said."""

    def likely(f: FittedBody) -> tuple[bool | float, ...]:
        explained = f.best.explained
        # numbers that are rotations for themselves are believed where they are near; angles may be read in many ways
        posed = f.body.posed and (explained or len(f.body.turned or ()) > 3)
        order = (f.computed, f.body.computed, not posed, not explained, not f.body.named)
        return (not f.judged.near, *order, -f.judged.score)

    chosen, *rest = sorted(fits, key=likely)
    questions, assumed, best = list[str](), list[str](), chosen.best
    if not best.explained:
        share = f"{100.0 * chosen.judged.share:.1f} % of what moves"
        said = f"the nominal arm misses by {best.missed}, {share}, more than most do"
        assumed.append(f"{said}; no other reading of the columns fits better: `modcal calibrate` says what explains it")
    if chosen.computed:
        questions.append("the nominal arm reproduces the readings to micrometres: they look computed from the joints")
    for other in [f for f in rest if f.best.explained and not _alike(chosen, f)]:
        names = [numbers.shown(*f.body.position) for f in (chosen, other)]
        if other.computed or (other.body.computed and not chosen.body.computed):
            assumed.append(f"{names[1]} look computed by the controller and are not used")
        elif set(chosen.body.position) != set(other.body.position):
            both = " and ".join(names)
            questions.append(f"{both} both move with the tool: keep the columns of the target that was measured")
    turned = [f.body.turned for f in rest if f.body.turned is not None]
    if not chosen.body.posed and any(len(t) > 3 or numbers.labels[t[0]].axis("angles") for t in turned):
        questions.append("orientations fit in no convention, positions alone do: state their form, or leave them out")
    for rival in chosen.rivals:
        questions.append(f"cannot tell {best.otherwise(rival, 'or')} ({best.worse(rival)})")
    by_labels = [j for j in labelled if j.role == MEASURED]
    if by_labels and chosen.best.choice.columns not in [j.columns for j in by_labels]:
        named = numbers.shown(*by_labels[0].columns)
        questions.append(f"labels say that the joints are {named}; the arm fits with the columns below instead")
    assumed += _astray(numbers, chosen)
    return TableRead(best.choice, chosen.rows, [chosen], questions, list(dict.fromkeys(assumed)))


def _astray(numbers: Numbers, chosen: FittedBody) -> Iterator[str]:
    """Rows that fit no base and tool of the others."""
    rows = chosen.rows[spread_rows(len(chosen.rows), _MAX)]
    if chosen.target is not None or len(rows) != len(chosen.judged.position):
        return

    def line(i: int) -> str:
        name = numbers.sheet.column(0)[rows[i]]
        tells = 0 not in {*chosen.columns, *chosen.best.choice.columns} and name
        return f"line {numbers.sheet.lines[rows[i]]}{f' ({name[:20]})' if tells else ''}"

    for i, k in astray(chosen.judged.case):
        of = f"its reading belongs to another station, {line(k)} by what fits" if k is not None else "no other fits it"
        yield f"{line(i)} fits the arm in no way: {of}; it is kept, and `modcal calibrate` rejects it"


def _alike(one: FittedBody, other: FittedBody) -> bool:
    if one.body.position != other.body.position or one.body.turned is None or other.body.turned is None:
        return False
    A = se3.transform(one.judged.R, one.judged.position)
    return len(one.judged.R) == len(other.judged.R) and same_poses(A, other.judged.R, other.judged.position)


def _drafted(arm: MeasuredArm, time: RowTimes, way: Together, numbers: Numbers, read: TableRead) -> Draft:
    """What is stated of the file, its rows, joints and readings, and what was assumed."""
    sheet, chain = numbers.sheet, arm.chain
    entry: dict[str, Any] = {"files": sheet.path.name, **sheet.form.entry()}
    said = [f"the arm ends at {chain.tip}, and begins at {chain.base}", time.said]
    pairs = zip(chain.own_names, read.choice.columns, strict=True)
    shown = ", ".join(f"{name} = {numbers.shown(k)}" for name, k in pairs)
    said += [f"the joints' columns by {read.choice.how}: {shown}", *way.said]
    if not sheet.sure:
        said.append(f"the text is not UTF-8 and is read as {sheet.form.encoding}")
    if np.isnan(numbers.values[np.ix_(read.rows, np.array(read.columns, dtype=int))]).any():
        entry["missing"] = "skip"
        said.append("an instrument whose cell is empty read nothing in that row")
    if lacking := len(numbers.values) - len(read.rows):
        entry["missing"] = "skip"
        said.append(f"{lacking} of {len(numbers.values)} rows lack a number that is needed, and are left out")
    zeros = [k for part in read.parts for k in part.zeros]
    if zeros and (numbers.values[:, zeros] == 0.0).all(axis=1).any():
        entry["zeros_missing"] = numbers.keys(zeros)
        said.append("rows of zeros are rows in which nothing was read")
    if way.stated:
        entry["joined"] = list(way.stated)
    entry |= {"time": time.stated, **read.stated}
    stamps = stamps_of(numbers.table, time.stated, 0.0)[0] if time.columns else None
    used = {*read.choice.columns, *read.columns, *time.columns}
    every, asked = [*said, *read.assumed], list(read.questions)
    return Draft(numbers, arm, read.choice, entry, used, stamps, said=every, asked=asked)


def _made(draft: Draft, way: Together, read: TableRead, texts: set[int]) -> Proposal:
    """The mapping that was found, with its proof and what was assumed. texts: columns that need not be numbers."""
    numbers, entry, used = draft.numbers, draft.entry, draft.used
    texts = texts | {part.target for part in read.parts if isinstance(part, FittedBody) and part.target is not None}
    if odd := sorted({text for k in used - texts for text in numbers.odd.get(k, ())}):
        entry["missing_values"] = odd
        draft.said.append(f"{', '.join(odd)} mark cells without a number")
    by = [(one["by"], Path(one["files"]).stem) for one in way.stated if one["by"] != "row"]
    keys = {key for pairs, stem in by for ours, theirs in pairs.items() for key in (ours, theirs, f"{stem}.{theirs}")}
    used = used | {k for k in range(numbers.sheet.width) if numbers.key(k) in keys}
    said = [*draft.said, *_unused(numbers, used)]
    asked = tuple(dict.fromkeys(draft.asked))
    mapping = {
        **({"undecided": list(asked)} if asked else {}),
        **draft.arm.stated,
        "tables": [{key: entry[key] for key in ENTRY if key in entry}],
    }
    proved = [said for part in read.parts for said in part.proved()]
    return Proposal(mapping, (*proved, *draft.proved), tuple(said), asked)


def _unused(numbers: Numbers, taken: set[int]) -> Iterator[str]:
    """Every column that is not used, by why."""
    reasons: dict[str, list[int]] = {"": [], " (constant)": [], " (numbers in few rows)": [], " (no numbers)": []}
    for k in sorted(set(range(numbers.sheet.width)) - taken):
        if k in numbers.filled:
            reasons["" if k in numbers.usable else " (constant)"].append(k)
        elif np.isfinite(numbers.values[:, k]).any():
            reasons[" (numbers in few rows)"].append(k)
        elif any(numbers.sheet.column(k)):
            reasons[" (no numbers)"].append(k)
    yield from (f"not used: {numbers.shown(*some)}{why}" for why, some in reasons.items() if some)
