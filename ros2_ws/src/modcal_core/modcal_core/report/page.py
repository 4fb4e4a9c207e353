"""Pages that need nothing else: one file, its style and scripts inside, nothing fetched.

A page is an answer and, below it, sections. A section holds blocks: sentences, tables, charts, the scene in three
dimensions, files. Every verb gives a list of sections; the template ``page.html.j2`` knows how each block looks.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.report.blocks import Block, File, FileList, Fold, Paragraph, Scene3D, Section, TableBlock
from modcal_core.report.charts import DARK, LIGHT

if TYPE_CHECKING:
    from jinja2 import Environment

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
