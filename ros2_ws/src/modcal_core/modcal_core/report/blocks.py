"""What verbs say, as data: sentences, tables, charts, files. Terminals and pages show the same kinds of values.

A page is one file that needs nothing else: an answer, lines, and sections of blocks. The template ``page.html.j2``
knows how each block looks. On a terminal stand its tables, its answer and its lines.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from string import Formatter
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from modcal_core.geometry import Array
from modcal_core.report.charts import DARK, LIGHT

if TYPE_CHECKING:
    from jinja2 import Environment

    from modcal_core.report.charts import Chart


Tone = Literal["plain", "legend", "doubt", "good", "bad", "warn", "reason"]
_GOOD = ("at_floor", "PASS", "unchanged", "same", "within tolerance", "apply")
_BAD = ("open", "FAIL", "unexplained", "beyond tolerance", "do not apply")


def tone_of(result: str) -> Tone:
    """The tone of a status, a result or an advice."""
    return "good" if result in _GOOD else "bad" if result in _BAD else "warn"


@dataclass(frozen=True)
class SummaryLine:
    """A sentence, or some. tone: what they mean to the reader. lead: words before them that stand out on a page."""

    text: str
    tone: Tone = "plain"
    lead: str = ""

    def __str__(self) -> str:
        """As plain text."""
        return f"{self.lead} {self.text}".strip()


class _Cells(Formatter):
    """How entries of records are written: None as nothing, an interval by both ends, names as people say them."""

    def get_value(self, key: int | str, records: Sequence[Any], _: Mapping[str, Any]) -> Any:
        return records[0][key] if isinstance(records[0], Mapping) else getattr(records[0], str(key))

    def get_field(self, name: str, records: Sequence[Any], _: Mapping[str, Any]) -> Any:
        try:
            return super().get_field(name, records, _)
        except TypeError:  # an entry of None
            return None, name

    def format_field(self, value: Any, form: str) -> str:
        if value is None:
            return ""
        if form in ("words", "driver"):
            return str(value).replace("_", " ") if form == "words" else str(value).replace(":", " of ")
        if isinstance(value, list | tuple):
            return " … ".join(format(end, form) for end in value)
        return format(value, form)


written = _Cells().format


@dataclass(frozen=True)
class TableBlock:
    """A table. words: how many columns, from the left, hold words; the others hold numbers. below: words under it.
    strong: a column in bold. heading: whether its title stands over it, on a terminal in the place of the first name.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int = 1
    below: str = ""
    strong: int = -1
    heading: bool = False

    @classmethod
    def of(cls, title: str, header: str, cells: str, records: Iterable[Any], **look: Any) -> Self:
        """A row for each record. header, cells: names of the columns, and how entries stand below, between bars."""
        columns = cells.split(" | ")
        rows = tuple(tuple(written(cell, record) for cell in columns) for record in records)
        return cls(title, tuple(header.split(" | ")), rows, **look)

    @property
    def top(self) -> tuple[str, ...]:
        """The names of the columns as a terminal shows them."""
        return (self.title, *self.header[1:]) if self.heading else self.header

    def __str__(self) -> str:
        """The table as plain text, a line for each row."""
        rows = (self.top, *self.rows)
        wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(
                cell.ljust(width) if i < self.words else cell.rjust(width)
                for i, (cell, width) in enumerate(zip(row, wide, strict=True))
            ).rstrip()
            for row in rows
        ]
        return "\n".join([*lines, *([self.below] if self.below else [])])


Summary = SummaryLine | TableBlock


def legend(meanings: Mapping[str, str]) -> str:
    """What the columns of a table mean, but for those whose headings say it."""
    return "; ".join(f"{name}: {meaning}" for name, meaning in meanings.items() if meaning)


def explained(
    columns: Mapping[str, str], rows: Sequence[tuple[str, ...]], words: int = 1, title: str = ""
) -> TableBlock:
    """A table, and below it what its headings mean. columns: headings with their meanings, empty where they say it."""
    return TableBlock(title, tuple(columns), tuple(rows), words, legend(columns))


def text(blocks: Sequence[str | Summary]) -> str:
    """As plain text, a line for each row and sentence."""
    return "\n".join(map(str, blocks))


@dataclass(frozen=True)
class Listing:
    """Sentences one below the other. tone: of a line beside them. label: what they are, for those who do not see it."""

    rows: Sequence[str]
    tone: str = ""
    label: str = ""


@dataclass(frozen=True)
class HeatTable:
    """A table of shares, cells as full as they are. rows: names and shares, NaN where there is none."""

    title: str
    corner: str
    columns: Sequence[str]
    rows: Sequence[tuple[str, Sequence[float]]]


@dataclass(frozen=True)
class KeyFigures:
    """Names and values, None where one is to be filled in. look: tiles, facts, small hashes, or lines to sign."""

    rows: Sequence[tuple[str, str | None]]
    look: Literal["tiles", "facts", "facts hash", "signs"] = "tiles"


@dataclass(frozen=True)
class Figures:
    """Charts: small ones side by side, large ones one below the other."""

    charts: Sequence[Chart]

    @property
    def small(self) -> bool:
        """Whether they stand side by side."""
        return len(self.charts) > 1 and all(one.width < 300.0 for one in self.charts)


@dataclass(frozen=True)
class Scene3D:
    """What the page's script draws, all in one frame [m].

    points: of the target (N, 3). arms: polylines (k, 3) of each posture that can be chosen. shown: the point of each
    posture, indices. said: a sentence for each posture. base: name of the frame. alt: for those who do not see it.
    stages: name and misses (N, 3) [mm] by model; names: of the points, for sentences on them. route: whether the points
    are connected in order. cloud: others (M, 3). marks: named places. lines: named lines (2, 3). weights: how large a
    joint is drawn, 0 … 1. local: whether the frame's origin may be far away. slider, legend: words beside the scene.
    """

    points: Array
    arms: Sequence[Sequence[Array]]
    shown: np.ndarray
    said: Sequence[str]
    base: str
    alt: str
    stages: Sequence[tuple[str, Array]] = ()
    names: Sequence[str] = ()
    route: bool = False
    cloud: Array | None = None
    marks: Sequence[tuple[str, Array]] = ()
    lines: Sequence[tuple[str, Array]] = ()
    weights: Sequence[float] = ()
    local: bool = False
    slider: str = "Posture"
    legend: str = "The grid is the floor of the base."

    def to_data(self) -> dict[str, Any]:
        """The same as JSON has it, numbers to four digits behind the point."""
        return {one.name: _rounded(getattr(self, one.name)) for one in fields(self)}


def _rounded(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return np.round(value, 4).tolist()
    return [_rounded(one) for one in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True)
class File:
    """A file beside the page. holds: what it is for. commands: how to use it, run in the page's folder."""

    name: str
    holds: str
    commands: tuple[str, ...] = ()
    is_file: bool = True


@dataclass(frozen=True)
class FileList:
    """Files with what they are for."""

    files: Sequence[File]


@dataclass(frozen=True)
class Fold:
    """What is shown when it is asked for. name: of the part for experts, which paper leaves out."""

    title: str
    blocks: Sequence[Block | None]
    name: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a page. name: for links, unique. title: its heading. short: in the list of sections, if it is there."""

    name: str
    title: str
    blocks: Sequence[Block]
    short: str = ""

    @property
    def script(self) -> bool:
        """Whether it is empty without scripts."""
        return all(isinstance(block, Scene3D) for block in self.blocks)


Block = SummaryLine | Listing | TableBlock | HeatTable | KeyFigures | Figures | FileList | Fold | Section | Scene3D


_CONTENT = ("rows", "charts", "files")


def filled(block: Block | None) -> bool:
    """Whether there is anything in a block; a page shows no other ones."""
    if isinstance(block, Section | Fold):
        return any(map(filled, block.blocks))
    return block is not None and all(len(getattr(block, name)) > 0 for name in _CONTENT if hasattr(block, name))


TINT = 50  # per cent of `after` in the fullest cell of a map; ink can be read on it


@dataclass(frozen=True)
class VerbResult:
    """What a verb leaves. data: for programs. said: for a terminal. files: contents by name. first: the file to look
    at; what: a word for it.
    """

    data: Mapping[str, Any]
    said: Sequence[str | Summary]
    files: Mapping[str, str]
    what: str = "Report"
    first: str = "report.html"


@dataclass(frozen=True)
class Page:
    """A page. heading: a word over the answer. tone: its colour (plain, good, warn, bad). kind: report, certificate.
    lines: sentences below the answer. said: the answer as a terminal has it, where that is another.
    """

    title: str
    answer: str
    blocks: Sequence[Block | None]
    heading: str = "Result"
    tone: Tone = "plain"
    kind: str = "report"
    lines: Sequence[str | SummaryLine] = ()
    said: str = ""

    def result(
        self,
        data: Mapping[str, Any],
        files: Mapping[str, str],
        tables: Sequence[TableBlock] = (),
        what: str = "Report",
        first: str = "report.html",
    ) -> VerbResult:
        """What a verb leaves: on a terminal these tables, the answer and the lines, and the page among the files."""
        page = replace(self, blocks=[*self.blocks, files_section(files)])
        name = first if first.endswith(".html") else "report.html"
        lines = (SummaryLine(line) if isinstance(line, str) else line for line in self.lines)
        shown = [table for table in tables if filled(table)]
        said: list[str | Summary] = [*shown, SummaryLine(self.said or self.answer, self.tone), *lines]
        return VerbResult(data, said, {**files, name: page.html()}, what, first)

    def html(self) -> str:
        """The page as HTML text."""
        blocks = [block for block in (Listing([str(line) for line in self.lines]), *self.blocks) if filled(block)]
        parts = [k for k, block in enumerate(blocks) if isinstance(block, Section | Fold)]
        begin = parts[0] if parts else len(blocks)
        listed = [b for b in blocks if isinstance(b, Section | Fold) and b.name]
        links = [(b.name, b.short if isinstance(b, Section) else "Expert") for b in listed]
        return str(
            _environment()
            .get_template("page.html.j2")
            .render(
                page=self,
                lead=blocks[:begin],
                sections=blocks[begin:],
                links=[link for link in links if link[1]],
                scene=any(isinstance(b, Scene3D) for s in blocks if isinstance(s, Section) for b in s.blocks),
                light=LIGHT,
                dark=DARK,
                tint=TINT,
            )
        )


@cache
def _environment() -> Environment:
    """The templates."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("modcal_core.report", "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    made.tests["filled"] = filled
    made.filters |= {"kind": lambda block: type(block).__name__, "script_data": as_script_data}
    return made


def as_script_data(data: Any) -> str:
    """JSON that can stand inside a script element."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


FILES = (
    File(
        "calibration.yaml",
        "Everything needed for prediction: nominal and calibrated arm, effects, base frames, tool, covariance.",
        (
            "modcal evaluate calibration.yaml OTHER_BAG --out check",
            'ros2 launch modcal_nodes correct.launch.py calibration:="$PWD"',
        ),
    ),
    File(
        "calibrated.urdf",
        "The robot description with corrected origins, every other byte as it was: geometry, no effects.",
        ("ros2 run robot_state_publisher robot_state_publisher calibrated.urdf",),
    ),
    File("kinematics.yaml", "The same numbers in the manufacturer's format, or by joint name."),
    File(
        "calibrated_delta.yaml",
        "The Delta's constants and the identified tool.",
        ("modcal calibrate OTHER_BAG --delta calibrated_delta.yaml --out again",),
    ),
    File("object.urdf", "The object as a robot description: a link that moves as the handle did."),
    File("report.html", "The error at these stations as a page."),
    File("certificate.html", "The certificate."),
    File("camera.yaml", "The lens, in the form of camera_info."),
    File("joint_limits.yaml", "Constant bounds in the form of MoveIt's file."),
    File("plan.yaml", "The stations and what is expected of them, for programs."),
    File("stations.csv", "Joint positions of the stations to measure, one a row."),
    File("trajectory.yaml", "The way through the stations as a JointTrajectory."),
    File("single_point.csv", "Single-point indices, one row a posture."),
)


def files_section(names: Collection[str], *more: File) -> Section:
    """What the files of these names beside the page are for; others are passed over."""
    beside = set(names)
    data = [File(n, "All numbers, for programs.", (f"python3 -m json.tool {n}",)) for n in names if n.endswith("json")]
    files = [*(file for file in FILES if file.name in beside), *data, *more]
    commands = any(file.commands for file in files)
    said = [SummaryLine("Commands are run in the folder of this page.", "legend")] if commands else []
    title = "Files, and what to do with them" if commands else "Files"
    return Section("files", title, [*said, FileList(files)], short="Files")


_FIRST = ("mrad", "°", "mm")  # then the others by name, numbers without a unit last
_TITLES = {"mm": "Lengths", "mrad": "Angles", "°": "Angles", "1": "Numbers without a unit"}
_GROUPED = (1e4, 1e7)  # numbers between are written in full, their thousands apart
_STAMP = 1e8  # s; larger ones are moments, of which every second counts

Quantity = tuple[str, float, float | None, str]  # name, value, standard deviation, unit


def scaled(unit: str) -> tuple[str, float]:
    """The unit that a person reads for one of SI, and what values are multiplied by."""
    for si, shown in (("rad", "mrad"), ("m", "mm")):
        if unit == si or unit.startswith(f"{si}/"):
            return shown + unit.removeprefix(si), 1e3
    return unit, 1.0


def number(value: float, digits: int = 4) -> str:
    """A number with a few digits; large ones in full."""
    text = f"{value:.{digits}g}"
    if 1.0 <= abs(value) < _GROUPED[0]:
        rounded = float(text)
        text = f"{rounded:.{max(digits - 1 - int(np.floor(np.log10(abs(rounded)))), 0)}f}"
    elif _GROUPED[0] <= abs(value) < _GROUPED[1]:
        text = f"{float(text):,.0f}".replace(",", "\u202f")
    return text.replace("-", "−")


def quantity_tables(quantities: Iterable[Quantity], what: str = "quantity") -> list[TableBlock]:
    """Values and standard deviations, from SI to what people read, a table a unit. what: a word for the names."""
    found: dict[str, list[tuple[str, ...]]] = {}
    for name, value, std, si in quantities:
        unit, factor = scaled(si)
        said = f"{value:.1f}" if unit == "s" and abs(value) > _STAMP else number(factor * value)
        known = number(factor * std, 2) if std and np.isfinite(std) else ""
        found.setdefault(unit, []).append((name, said, known))
    out = []
    for unit in sorted(found, key=lambda u: (_FIRST.index(u) if u in _FIRST else len(_FIRST), u == "1", u)):
        end = "" if unit == "1" else f", {unit}"
        header = (what, f"value{end}", f"± one standard deviation{end}")
        columns = 3 if any(row[2] for row in found[unit]) else 2
        title = f"{_TITLES[unit]}{end}" if unit in _TITLES else f"In {unit}"
        out.append(TableBlock(title, header[:columns], tuple(row[:columns] for row in found[unit])))
    return out


def size_tables(effects: Sequence[Mapping[str, Any]]) -> list[TableBlock]:
    """Sizes of effects as ``report.json`` has them; of effects with one name the later ones are numbered."""
    names = [f"{e['family'].replace('_', ' ')} at {e['place']}, {e['direction']}" for e in effects]
    found = []
    for i, (name, effect) in enumerate(zip(names, effects, strict=True)):
        count = names[:i].count(name) + 1
        numbered = name if count == 1 else f"{name} ({count})"
        for quantity, size in effect["parameters"].items():
            found.append((f"{numbered}: {quantity.replace('_', ' ')}", size["value"], size["std"], str(size["unit"])))
    return quantity_tables(found)


def parameter_tables(parameters: Iterable[Quantity]) -> list[Fold]:
    """All parameters, in SI, as a folded table for each unit."""
    return [Fold(f"{t.title}: {len(t.rows)}", [t]) for t in quantity_tables(parameters, "parameter")]
