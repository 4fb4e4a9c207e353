"""What verbs say, as data: sentences, tables, charts, files. Terminals and pages show the same kinds of values.

On a terminal stand :class:`SummaryLine` and :class:`TableBlock`. A page is a list of tables and the others; the
template ``page.html.j2`` knows how each of them looks.

Pages that need nothing else: one file, its style and scripts inside, nothing fetched.

A page is an answer and, below it, sections. A section holds blocks: sentences, tables, charts, the scene in three
dimensions, files. Every verb gives a list of sections; the template ``page.html.j2`` knows how each block looks.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

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
    """A sentence. tone: what it means to the reader."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True)
class TableBlock:
    """A table. words: how many columns, from the left, hold words; the others hold numbers. below: a sentence under it.
    strong: a column in bold. heading: whether its title stands over it, on a terminal in the place of the first name.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int = 1
    below: str = ""
    strong: int = -1
    heading: bool = False

    @property
    def top(self) -> tuple[str, ...]:
        """The names of the columns as a terminal shows them."""
        return (self.title, *self.header[1:]) if self.heading else self.header


Summary = SummaryLine | TableBlock


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


def legend(meanings: Mapping[str, str]) -> SummaryLine:
    """What the columns of the table above mean."""
    return SummaryLine("  " + "; ".join(f"{name}: {meaning}" for name, meaning in meanings.items()), "legend")


def explained(columns: Mapping[str, str], rows: Sequence[tuple[str, ...]], words: int = 1) -> list[Summary]:
    """A table, and below it what its headings mean. columns: headings with their meanings, empty where they say it."""
    meanings = [SummaryLine(f"  {name}: {meaning}", "legend") for name, meaning in columns.items() if meaning]
    return [TableBlock("", tuple(columns), tuple(rows), words), *meanings]


def text(blocks: Sequence[str | Summary]) -> str:
    """As plain text, a line for each row and sentence."""
    lines = []
    for block in blocks:
        said = block.text if isinstance(block, SummaryLine) else block
        lines += [said] if isinstance(said, str) else _laid_out(said)
    return "\n".join(lines)


def _laid_out(grid: TableBlock) -> list[str]:
    wide = [max(map(len, column)) for column in zip(grid.top, *grid.rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i < grid.words else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, wide, strict=True))
        ).rstrip()
        for row in (grid.top, *grid.rows)
    ]


@dataclass(frozen=True)
class Paragraph:
    """Sentences. lead: words before them in bold, in the colour of tone where that is given."""

    text: str
    lead: str = ""
    tone: str = ""
    soft: bool = False


@dataclass(frozen=True)
class Listing:
    """Sentences one below the other. tone: of a line beside them. label: what they are, for those who do not see it."""

    lines: Sequence[str]
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
class Tiles:
    """The few numbers that are wanted first: names and values."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Facts:
    """Names and values, None where one is left to be filled in. small: in small print, one a line."""

    rows: Sequence[tuple[str, str | None]]
    small: bool = False


@dataclass(frozen=True)
class Signatures:
    """Lines to sign: roles, and names where they are known."""

    rows: Sequence[tuple[str, str]]


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
    stages: name and misses (N, 3) by model; names: of the points, for sentences about them. route: whether the points
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
        """The same as JSON has it, misses in millimetres."""
        digits = 4 if self.local else 3
        return {
            "points": np.round(self.points, 4).tolist(),
            "stages": [{"name": name, "arrows": np.round(1e3 * miss, 4).tolist()} for name, miss in self.stages],
            "arms": [[np.round(path, digits).tolist() for path in arm] for arm in self.arms],
            "shown": self.shown.tolist(),
            "said": list(self.said),
            "names": list(self.names),
            "route": self.route,
            "cloud": [] if self.cloud is None else np.round(self.cloud, digits).tolist(),
            "marks": [{"name": name, "at": np.round(at, 3).tolist()} for name, at in self.marks],
            "lines": [{"name": name, "path": np.round(path, 4).tolist()} for name, path in self.lines],
            "weights": [round(float(weight), 4) for weight in self.weights],
            "base": self.base,
            "local": self.local,
        }


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
    blocks: Sequence[Block]
    name: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a page. name: for links, unique on the page. title: its heading. short: its name in the list of
    sections; empty: not listed.
    """

    name: str
    title: str
    blocks: Sequence[Block]
    short: str = ""

    @property
    def script(self) -> bool:
        """Whether it is empty without scripts."""
        return all(isinstance(block, Scene3D) for block in self.blocks)


Block = (
    Paragraph | Listing | TableBlock | HeatTable | Tiles | Facts | Signatures | Figures | FileList | Fold
    | Section | Scene3D
)  # fmt: skip


TINT = 50  # per cent of `after` in the fullest cell of a map; ink can be read on it


@dataclass(frozen=True)
class Page:
    """A page. heading: a word over the answer. tone: its colour (plain, good, warn, bad). kind: report, certificate."""

    title: str
    answer: str
    blocks: Sequence[Block | None]
    heading: str = "Result"
    tone: str = "plain"
    kind: str = "report"

    def html(self) -> str:
        """The page as HTML text."""
        blocks = [block for block in self.blocks if block is not None]
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
    File("report.json", "All numbers of this page, for programs.", ("python3 -m json.tool report.json",)),
    File("report.html", "The error at these stations as a page."),
    File("certificate.html", "The certificate."),
    File("camera.yaml", "The lens, in the form of camera_info."),
    File("check.json", "All numbers, for programs."),
    File("sentinel.json", "All numbers, for programs."),
    File("limits.json", "All numbers, for programs."),
    File("joint_limits.yaml", "Constant bounds in the form of MoveIt's file."),
    File("plan.yaml", "The stations and what is expected of them, for programs."),
    File("stations.csv", "Joint positions of the stations to measure, one a row."),
    File("trajectory.yaml", "The way through the stations as a JointTrajectory."),
    File("sensitivity.json", "All numbers, for programs."),
    File("single_point.csv", "Single-point indices, one row a posture."),
)


def files_section(names: Iterable[str], *more: File) -> Section | None:
    """What the files of these names beside the page are for; others are passed over. None if none is left."""
    beside = set(names)
    files = [*(file for file in FILES if file.name in beside), *more]
    if not files:
        return None
    commands = any(file.commands for file in files)
    said = [Paragraph("Commands are run in the folder of this page.", soft=True)] if commands else []
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
    if 1.0 <= abs(value) < _GROUPED[0]:
        rounded = float(f"{value:.{digits}g}")
        behind = max(digits - 1 - int(np.floor(np.log10(abs(rounded)))), 0)
        return f"{rounded:.{behind}f}".replace("-", "−")
    if _GROUPED[0] <= abs(value) < _GROUPED[1]:
        return f"{float(f'{value:.{digits}g}'):,.0f}".replace(",", "\u202f").replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def quantity_tables(quantities: Iterable[Quantity], what: str = "quantity") -> list[TableBlock]:
    """Values and standard deviations as they are read, a table for each unit. what: a word for the names."""
    found: dict[str, list[Quantity]] = {}
    for one in quantities:
        found.setdefault(one[3], []).append(one)
    out = []
    for unit in sorted(found, key=lambda u: (_FIRST.index(u) if u in _FIRST else len(_FIRST), u == "1", u)):
        end = "" if unit == "1" else f", {unit}"
        header, rows = [what, f"value{end}", f"± one standard deviation{end}"], []
        for name, value, std, _ in found[unit]:
            said = f"{value:.1f}" if unit == "s" and abs(value) > _STAMP else number(value)
            rows.append((name, said, number(std, 2) if std and np.isfinite(std) else ""))
        columns = 3 if any(row[2] for row in rows) else 2
        cells = tuple(row[:columns] for row in rows)
        title = f"{_TITLES[unit]}{end}" if unit in _TITLES else f"In {unit}"
        out.append(TableBlock(title, tuple(header[:columns]), cells))
    return out


def in_units(rows: Iterable[Quantity]) -> list[Quantity]:
    """Quantities in SI as people read them."""
    out = []
    for name, value, std, si in rows:
        unit, factor = scaled(si)
        out.append((name, factor * value, None if std is None else factor * std, unit))
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
    return quantity_tables(in_units(found))


def parameter_tables(parameters: Iterable[Quantity]) -> list[Fold]:
    """All parameters, in SI, as a folded table for each unit."""
    return [Fold(f"{t.title}: {len(t.rows)}", [t]) for t in quantity_tables(in_units(parameters), "parameter")]
