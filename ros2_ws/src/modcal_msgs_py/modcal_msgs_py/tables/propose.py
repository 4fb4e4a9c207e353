"""A mapping for a table that has none: what its columns are, proved by the nominal arm that fits, or asked.

The text says how the file is written (``sniff``), labels and numbers which columns may be what (``candidates``,
``labels``), and the hand-eye problem of the nominal arm which reading of them is right
(:mod:`modcal_core.hypotheses.meanings`). Where two readings fit alike, nothing is chosen in silence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3
from modcal_core.hypotheses import MATRIX, MIN_ROWS, Postures, Turning, judge, likely_orders, rivals, same_poses
from modcal_core.robots import Chain, Inertias
from modcal_msgs_py.tables.beside import OtherColumns, find_beside
from modcal_msgs_py.tables.candidates import Body, JointColumns, Numbers, bodies, joints, orthonormal, pool
from modcal_msgs_py.tables.fitted import (
    MAX_RAD,
    ColumnChoice,
    Fitted,
    decided,
    deviation_columns,
    differences,
    missed,
    scales,
    units,
    with_deviations,
    worse,
)
from modcal_msgs_py.tables.labels import MEASURED, turn_labels
from modcal_msgs_py.tables.moments import RowTimes, find_time
from modcal_msgs_py.tables.readings import rigid_bodies, rigid_poses
from modcal_msgs_py.tables.sighted import SightColumns, Sighted, find_sights, is_sight, sight_columns
from modcal_msgs_py.tables.sniff import Sniffed, sniff
from modcal_msgs_py.tables.table import Faults, Sheet, Table, join

NOT_AN_ARM = 0.05  # of the reach; columns that leave more have nothing to do with the arm
_ORDERS = 6  # of columns without labels that are judged in full
_MAX_BODIES = 10  # that are judged where labels do not tell


@dataclass(frozen=True)
class Findings:
    """Everything that was found out of a table. fitted: its readings. beside: what else it holds. questions: what the
    data cannot tell; the mapping is refused till they are answered. others: places of columns that fit as well and are
    not used.
    """

    numbers: Numbers
    chain: Chain
    time: RowTimes
    fitted: Fitted | Sighted
    questions: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()
    others: tuple[Fitted, ...] = field(default=())
    beside: OtherColumns = field(default_factory=OtherColumns)
    joined: Together | None = None


def find(
    paths: Sequence[Path],
    chain: Chain,
    watch: Callable[[str], None] = lambda stage: None,
    inertias: Inertias | None = None,
) -> Findings:
    """What the columns of a file are; of several, joined by a column that they share.

    inertias: of the chain's bodies, by which the sign of efforts is told. Raises BadTable where no reading of the
    columns has to do with the arm at all.
    """
    path = paths[0]
    watch(f"reading {path.name}")
    joined = together(paths)
    numbers = Numbers.of(joined.sniffed)
    if len(numbers.values) < MIN_ROWS:
        said = f"has {len(numbers.values)} rows, {MIN_ROWS} are needed to tell what its columns are"
        raise BadTable(path.name, said, "write a mapping, see docs/import.md")
    sure = orthonormal(numbers)
    labelled = [
        j
        for j in joints(numbers, chain.names)
        if not set(j.columns) & sure and not all(is_sight(numbers.labels[k]) for k in j.columns)
    ]
    measured = [j for j in labelled if j.role == MEASURED]
    taken = {k for j in labelled for k in j.columns}
    time = find_time(numbers, taken)
    away = deviation_columns(numbers, {*taken, *time.columns})
    places = with_deviations(numbers, bodies(numbers, {*taken, *(away or ())}, set(time.columns)), away)
    watch("comparing what columns may mean")
    instruments = sight_columns(numbers, {*taken, *time.columns, *sure})
    fits = _every_fit(numbers, chain, places, measured, set(time.columns), instruments, watch)
    if isinstance(fits, Sighted):
        found = Findings(numbers, chain, time, fits, fits.questions)
    else:
        near = min((f.best.match.typical for f in fits), default=np.inf)
        if not near <= NOT_AN_ARM * chain.reach():
            said = "no columns are found that could be the joints of this arm and the position of a target on it"
            if fits:
                said += f"; the best leave {1e3 * near:.0f} mm"
            raise BadTable(path.name, said, "check --urdf, --base and --tip, or write a mapping: docs/import.md")
        fits, asked = decided(numbers, fits)
        found = _decided(numbers, chain, time, fits, labelled)
        found = replace(found, questions=(*asked, *found.questions))
    read = found.fitted
    whole = read if isinstance(read, Fitted) else None
    beside = find_beside(numbers, chain, inertias, labelled, read.choice, read.columns, time, whole)
    questions = tuple(dict.fromkeys((*found.questions, *beside.questions)))
    return replace(found, joined=joined, beside=beside, questions=questions)


def _every_fit(
    numbers: Numbers,
    chain: Chain,
    places: Sequence[Body],
    measured: Sequence[JointColumns],
    time: set[int],
    instruments: Sequence[SightColumns],
    watch: Callable[[str], None],
) -> list[Fitted] | Sighted:
    """Likely places of the readings with their meanings: by labels first, by numbers where labels lead nowhere.

    Targets of one body come before any of them alone, distances, directions and heights behind labelled positions.
    """
    targets = rigid_bodies(numbers, places)
    posed = [b for b in places if b.named and b.turned]
    named = posed or [b for b in places if b.named]
    points = [b for b in places if b.turned is None]
    other = [b for b in (bodies(numbers, set(), time) if not measured else places) if not b.named and b.turned]
    fits: list[Fitted] = []

    def settled() -> bool:
        return any(f.best.explained(chain) and not f.computed for f in fits)

    def left(some: Sequence[Body]) -> list[Body]:
        """Bodies that share no column with a pose computed from the joints."""
        gone = {k for f in fits if f.computed for k in (*f.body.position, *(f.body.turned or ()))}
        return [b for b in some if not gone & {*b.position, *(b.turned or ())}]

    if targets and measured:
        fits += _fits(numbers, chain, targets, measured)
        if settled():
            return fits
    for some, search in ((named, False), (named, True), (other, False), (points, False), (other, True), (points, True)):
        if search:
            watch("looking for the joints' columns")
            fits += _searched(numbers, chain, left(some), time)
        elif measured:
            fits += _fits(numbers, chain, left(some), measured)
        if settled():
            break
        if instruments and measured:
            watch("comparing what distances and directions may mean")
            sighted = find_sights(numbers, chain, measured, instruments)
            instruments = ()
            if sighted is not None:
                return sighted
    return fits


def _fits(numbers: Numbers, chain: Chain, places: Sequence[Body], choices: Sequence[JointColumns]) -> list[Fitted]:
    """These places with their meanings; of columns that are explained already no other place is looked for."""
    out: list[Fitted] = []
    for body in places[:_MAX_BODIES]:
        if any(_covers(f.body, body) and f.best.explained(chain) for f in out):
            continue
        if (fitted := _fitted(numbers, chain, body, choices)) is not None:
            out.append(fitted)
    return out


def _covers(known: Body, body: Body) -> bool:
    return (
        (known.away, known.sign) == (body.away, body.sign)
        and bool(set(known.position) & set(body.position))
        and (
            known.turned is None or body.turned is None or bool(set(known.turned) & set(body.turned)) or not body.named
        )
    )


def _fitted(numbers: Numbers, chain: Chain, body: Body, joint_columns: Sequence[JointColumns]) -> Fitted | None:
    used = [*body.columns, *(k for j in joint_columns for k in j.columns)]
    rows = np.flatnonzero(np.isfinite(numbers.values[:, used]).all(axis=1))
    rows = rows[~(numbers.values[np.ix_(rows, np.array(body.zeros))] == 0.0).all(axis=1)]
    if len(rows) < MIN_ROWS:
        return None
    values = numbers.values[rows]
    choices: list[ColumnChoice] = []
    postures: list[Postures] = []
    for one in joint_columns:
        for angle, length in units(chain, values[:, list(one.columns)]):
            choices.append(ColumnChoice(one, angle, length))
            postures.append(Postures(scales(chain, angle, length) * values[:, list(one.columns)], one.how))
    turned = None if body.turned is None else values[:, list(body.turned)]
    position = values[:, list(body.position)]
    if body.away:
        position = position + body.sign * values[:, list(body.away)]
    if body.points:
        poses = rigid_poses(np.stack([values[:, list(triple)] for _, triple in body.points], axis=1))[0]
        position, turned = poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9)
    found = judge(chain, postures, position, turned)
    if body.points:  # as the mapping makes them, and no other way
        found = [f for f in found if f.meaning.turning == Turning(MATRIX, tuple(range(9))) and not f.meaning.inverse]
    return Fitted(body, tuple(choices), tuple(found), rows) if found else None


def _searched(numbers: Numbers, chain: Chain, places: Sequence[Body], time: set[int]) -> list[Fitted]:
    triples = list(dict.fromkeys(body.position for body in places))
    taken = set(time)
    if places and places[0].named:
        taken |= turn_labels(numbers.labels)
        taken |= {k for body in places for k in (*body.position, *((body.turned or ()) if _sure(body) else ()))}
    columns = pool(numbers, taken)
    used = sorted({*columns, *(k for triple in triples for k in triple)})
    whole = np.isfinite(numbers.values[:, used]).all(axis=1)
    if not triples or not whole.any():
        return []
    values = np.where(np.isfinite(numbers.values), numbers.values, 0.0)[whole]
    largest = float(np.median(np.abs(values[:, columns]).max(axis=0))) if columns else 0.0
    found = []
    for scale in (np.pi / 180.0,) if largest > MAX_RAD else (1.0, np.pi / 180.0):
        found += likely_orders(chain, values, scale, columns, triples, _ORDERS)
    found.sort(key=lambda order: order.left)
    out: list[Fitted] = []
    for t in dict.fromkeys(order.triple for order in found[:_ORDERS]):
        orders = dict.fromkeys(order.columns for order in found if order.triple == t)
        choices = [JointColumns(order, "what they explain of the readings") for order in orders]
        for body in [b for b in places if b.position == triples[t]][:6]:
            free = [c for c in choices if not set(c.columns) & {*body.position, *(body.turned or ())}][:_ORDERS]
            if free and (fitted := _fitted(numbers, chain, body, free)) is not None:
                out.append(fitted)
                if fitted.best.explained(chain) and body.turned is not None:
                    return out
    return out


def _sure(body: Body) -> bool:
    """Whether an orientation is one by its numbers alone."""
    return body.turned is not None and len(body.turned) > 3


def _decided(
    numbers: Numbers, chain: Chain, time: RowTimes, fits: list[Fitted], labelled: Sequence[JointColumns]
) -> Findings:
    """The place that is proposed, with what is to be asked and what is to be said."""
    fits.sort(
        key=lambda f: (
            not f.best.explained(chain), f.computed, f.body.computed, not f.body.posed, not f.body.named,
        )
    )  # fmt: skip
    if not fits[0].best.explained(chain):
        fits.sort(key=lambda f: -f.best.match.score)
    chosen, *rest = fits
    questions, assumed = [], []
    best = chosen.best
    if not best.explained(chain):
        questions.append(
            f"no reading of the columns makes the nominal arm fit; the best leaves {missed(best)}: check the URDF, "
            "--tip, and every line below"
        )
    if chosen.computed:
        questions.append(
            "the nominal arm reproduces the readings to some micrometres: they look computed from the joints, not "
            "measured"
        )
    others = tuple(f for f in rest if f.best.explained(chain))
    for other in others:
        if _alike(chosen, other):
            continue
        names = f"{_names(numbers, chosen.body)} and {_names(numbers, other.body)}"
        if other.computed or (other.body.computed and not chosen.body.computed):
            assumed.append(f"{_names(numbers, other.body)} look computed by the controller and are not used")
        elif set(chosen.body.position) != set(other.body.position):
            questions.append(f"{names} both move with the tool: keep the columns of the target that was measured")
    if not chosen.body.posed and any(f.body.turned for f in rest):
        questions.append(
            "columns that look like orientations fit in no convention; positions alone fit: write euler, quaternion, "
            "rotvec or matrix, or leave the orientation out"
        )
    for rival in rivals(chosen.found):
        pairs = "; ".join(f"{one} from {two}" for one, two in differences(numbers, chosen, best, rival))
        questions.append(f"cannot tell {pairs} ({worse(best, rival)})")
    by_labels = [j for j in labelled if j.role == MEASURED]
    if by_labels and chosen.choice.joints.columns not in [j.columns for j in by_labels]:
        named = ", ".join(numbers.shown(k) for k in by_labels[0].columns)
        questions.append(f"labels say that the joints are {named}; the arm fits with the columns below instead")
    return Findings(
        numbers, chain, time, chosen, tuple(dict.fromkeys(questions)), tuple(dict.fromkeys(assumed)), others
    )


def _alike(one: Fitted, other: Fitted) -> bool:
    if one.body.position != other.body.position or (one.body.turned is None) != (other.body.turned is None):
        return False
    if len(one.best.R) != len(other.best.R) or one.body.turned is None:
        return False
    return same_poses(se3.transform(one.best.R, one.best.position), other.best.R, other.best.position)


def _names(numbers: Numbers, body: Body) -> str:
    return ", ".join(numbers.shown(k) for k in body.position)


_MIN_COLUMNS = 2  # of a further file: the shared one, and one more
_SHARED = 0.5  # of the rows must have a partner
_KEYS = {
    "station",
    "id",
    "pose",
    "index",
    "nr",
    "no",
    "number",
    "point",
    "frame",
    "time",
    "timestamp",
    "stamp",
    "t",
    "sample",
}
_STEP = 0.5  # of the usual step of the finer file, by which times may differ


@dataclass(frozen=True)
class Together:
    """A file with the columns of others beside its own. stated: the entries under joined. said: how."""

    sniffed: Sniffed
    stated: tuple[dict[str, Any], ...] = ()
    said: tuple[str, ...] = ()


def together(paths: Sequence[Path]) -> Together:
    """The first file with the others joined to it. Raises BadTable where no column tells which rows belong together."""
    first = sniff(paths[0])
    out = Together(first)
    for path in paths[1:]:
        out = _joined(out, path)
    return out


def _joined(known: Together, path: Path) -> Together:
    ours, theirs = Numbers.of(known.sniffed), Numbers.of(sniff(path, _MIN_COLUMNS))
    found = _keys(ours, theirs)
    if found is None:
        said = f"shares no column of station numbers or times with {known.sniffed.path.name}"
        raise BadTable(path.name, said, "state joined: {files, by} in a mapping, see docs/import.md")
    a, b, within = found
    form = theirs.sniffed.form.entry()
    stated: dict[str, Any] = {"files": path.name, **form, "by": {ours.key(a): theirs.key(b)}}
    if within is not None:
        stated["within"] = within
    sniffed = known.sniffed
    form = {k: v for k, v in form.items() if k != "decimal"}
    sheet = Sheet(sniffed.path, sniffed.labels, sniffed.rows, list(range(len(sniffed.rows))), sniffed.form.decimal)
    table = Table(sheet, Faults(sniffed.path.name))
    # as the mapping will do it, so that names and rows are the same
    join(table, {**stated, "decimal": theirs.sniffed.form.decimal}, path.parent, sniffed.path.name)
    stated.setdefault("decimal", theirs.sniffed.form.decimal)
    width = sniffed.width
    new = list(table.joined.items())
    rows = [[*row, *[""] * (width - len(row)), *(cells[i] for _, cells in new)] for i, row in enumerate(sniffed.rows)]
    pad = [""] * (width - len(sniffed.full))
    full = {
        label: theirs.sniffed.full[k] for k, label in enumerate(theirs.sniffed.labels) if k < len(theirs.sniffed.full)
    }
    units = dict(zip(theirs.sniffed.labels, theirs.sniffed.units, strict=False))

    def plain(name: str) -> str:
        return name.removeprefix(f"{path.stem}.")

    whole = replace(
        sniffed,
        labels=(*sniffed.labels, *[""] * (width - len(sniffed.labels)), *(name for name, _ in new)),
        full=(*sniffed.full, *pad, *(full.get(plain(name), name) for name, _ in new)),
        units=(*sniffed.units, *[""] * (width - len(sniffed.units)), *(units.get(plain(name), "") for name, _ in new)),
        rows=rows,
    )
    how = f"{ours.shown(a)} of {sniffed.path.name} is {theirs.shown(b)} of {path.name}"
    how += f", the nearest within {within:g}" if within is not None else ""
    return Together(whole, (*known.stated, stated), (*known.said, how))


def _keys(ours: Numbers, theirs: Numbers) -> tuple[int, int, float | None] | None:
    """Columns by which rows belong together: same numbers, else times that are near; and how near."""
    best: tuple[float, int, int, float | None] | None = None
    for a in ours.usable():
        for b in theirs.usable():
            if not isinstance(ours.key(a), str) or not isinstance(theirs.key(b), str):
                continue
            named = bool(_KEYS & set(ours.labels[a].words)) and bool(_KEYS & set(theirs.labels[b].words))
            if not named:
                continue
            share, within = _share(ours.values[:, a], theirs.values[:, b])
            alike = ours.labels[a].words == theirs.labels[b].words
            score = share + 0.2 * alike + 0.1 * (within is None)
            if share >= _SHARED and (best is None or score > best[0]):
                best = (score, a, b, within)
    return None if best is None else best[1:]


def _share(a: Array, b: Array) -> tuple[float, float | None]:
    """Share of the rows with a partner, and how near partners are where their numbers are not the same."""
    a, b = a[np.isfinite(a)], np.sort(b[np.isfinite(b)])
    if len(a) < 3 or len(b) < 3:
        return 0.0, None
    if len(np.unique(b)) == len(b):
        same = float(np.isin(a, b).mean())
        if same >= _SHARED:
            return same, None
    if (np.diff(a) < 0.0).any():
        return 0.0, None
    step = min(float(np.median(np.diff(x))) for x in (np.unique(a), np.unique(b)))
    within = float(f"{_STEP * step:.2g}")
    gap = np.abs(a[:, None] - b[np.clip(np.searchsorted(b, a)[:, None] + np.array([-1, 0]), 0, len(b) - 1)]).min(axis=1)
    return (float((gap <= within).mean()), within) if within > 0.0 else (0.0, None)
