"""What verbs say, as data: sentences, tables, charts, files. Terminals and pages show the same kinds of values.

On a terminal stand :class:`SummaryLine` and :class:`TableBlock`. A page is a list of tables and the others; the
template ``page.html.j2`` knows how each of them looks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from modcal_core.geometry import Array

if TYPE_CHECKING:
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
