"""``modcal target``: a board to print, to scale, with rulers; and what somebody measured of them."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from modcal_core.errors import BadTable
from modcal_core.files import read_yaml, to_yaml, write_file, write_folder
from modcal_nodes.cli.console import WRITTEN, Output, given, speaking, written
from modcal_nodes.io import option

_PAPERS = ("A4", "A3", "A2", "letter")
_MARKER = 0.73  # of a square: as large as leaves a corner room for its own four squares


class _Pattern(click.ParamType):
    """Texts of one form. name: an example. said: the form in words. read: the value of what matches."""

    def __init__(self, name: str, pattern: str, said: str, read: Callable[[re.Match[str]], Any]) -> None:
        self.name, self._pattern, self._said, self._read = name, pattern, said, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The value of a text."""
        if not isinstance(value, str):
            return value
        if (found := re.fullmatch(self._pattern, value)) is None:
            self.fail(f"'{value}' is not {self._said}.", param, ctx)
        return self._read(found)


_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_NUMBER = r"(\d+(?:\.\d+)?)"
_COUNTS = _Pattern("7x5", r"(\d{1,4})[x×](\d{1,4})", "of the form 7x5", lambda m: (int(m[1]), int(m[2])))
_LENGTH = _Pattern("30mm", rf"{_NUMBER}\s*(mm|cm|m)", "a length such as 30mm", lambda m: float(m[1]) * _METRES[m[2]])
_LENGTHS = _Pattern(
    *("209.5x149.8", f"{_NUMBER}[x×]{_NUMBER}", "of the form 209.5x149.8 [mm]"),
    lambda m: (1e-3 * float(m[1]), 1e-3 * float(m[2])),
)


@dataclass(frozen=True)
class TargetOptions:
    """What is asked of a target, by the names of the command's options: lengths [m], counts across and down."""

    charuco: tuple[int, int] | None = option("ChArUco board of so many squares, across and down.", type=_COUNTS)
    chessboard: tuple[int, int] | None = option("Chessboard of so many squares.", type=_COUNTS)
    aruco_grid: tuple[int, int] | None = option("Grid of so many markers.", type=_COUNTS)
    tag: int | None = option("One marker with this number.", low=0, metavar="ID")
    square: float | None = option("Side of a square, or of a marker of a grid or a tag.", type=_LENGTH)
    marker: float | None = option("Side of the markers in a ChArUco board; gap in a grid.", type=_LENGTH)
    dictionary: str | None = option("Markers, as OpenCV names them.  [default: DICT_5X5_100]", metavar="NAME")
    paper: str = option("Paper to print on.", default="A4", choices=_PAPERS)
    measured: tuple[float, float] | None = option(
        "Lengths [mm] of the horizontal and the vertical ruler on the printed sheet, as you measured them.",
        type=_LENGTHS,
    )
    measured_to_mm: float | None = option("How well you did.  [default: 0.3, as with a ruler]", low=0.001, metavar="MM")

    @property
    def chosen(self) -> list[tuple[str, tuple[int, int]]]:
        """Kinds of target that are asked for, and their counts."""
        one = None if self.tag is None else (1, 1)
        kinds = {"charuco": self.charuco, "chessboard": self.chessboard, "aruco_grid": self.aruco_grid, "tag": one}
        return [(kind, count) for kind, count in kinds.items() if count is not None]


@click.command("target")
@given(TargetOptions)
@click.option("--out", type=WRITTEN, default=Path("target"), help="Folder of the results.")
@speaking
def target_command(out: Path, output: Output, options: TargetOptions) -> None:
    """Write a target to print, as PDF, and its description for calibrate --target.

    Print it at 100 %, glue it to something flat, measure both rulers, and state them: modcal target --measured
    209.5x149.8 puts them into target.yaml.
    """
    measured, square, ctx = options.measured, options.square, click.get_current_context()
    if not options.chosen and measured is not None:
        _measured(out, measured, options.measured_to_mm, output)
        return
    if len(options.chosen) != 1:
        raise click.UsageError("Give one of --charuco, --chessboard, --aruco-grid, --tag.", ctx)
    if square is None:
        raise click.UsageError("Missing option '--square'.", ctx)
    # OpenCV, which other verbs can do without
    from modcal_core.camera import CHARUCO, CHESSBOARD, TAG, PrintedTarget, target_to_data
    from modcal_nodes.vision import draw_sheet

    ((kind, (columns, rows)),) = options.chosen
    inner = {CHARUCO: _MARKER * square, CHESSBOARD: 0.0, TAG: 0.0}.get(kind, 0.25 * square)
    if options.marker is not None:
        if kind in (CHESSBOARD, TAG):
            raise click.UsageError(f"--marker does not work with --{kind}.", ctx)
        inner = options.marker
    words = "" if kind == CHESSBOARD else options.dictionary or "DICT_5X5_100"
    made = PrintedTarget(kind, columns, rows, square, round(inner, 6), words, options.tag or 0)
    sheet = draw_sheet(made, options.paper)
    data = target_to_data(made, sheet.rulers_m)
    files: dict[str, str | bytes] = {"target.pdf": sheet.pdf, "target.yaml": to_yaml(data)}
    write_folder(out, files)
    x, y = (1e3 * length for length in sheet.rulers_m)
    said = [
        f"{made.label}, to be printed at 100 % on {options.paper}.",
        f"Its rulers should measure {x:.0f} mm (horizontal) and {y:.0f} mm (vertical). What do they measure?",
        f"State what you read, for WIDTH and HEIGHT [mm]: modcal target --measured WIDTHxHEIGHT --out {out}",
    ]
    if sys.stdin.isatty() and sys.stdout.isatty() and measured is None:
        answer = click.prompt("Measured lengths [mm] as 209.5x149.8, or Enter", default="", show_default=False)
        measured = _LENGTHS.convert(answer, None, None) if answer else None
    if measured is None:
        output.result(data, said, written(out, files, "Target", "target.pdf"))
    else:
        _measured(out, measured, options.measured_to_mm, output)


def _measured(out: Path, measured: tuple[float, float], to_mm: float | None, output: Output) -> None:
    from modcal_core.camera import target_from_data

    path = out / "target.yaml" if out.is_dir() else out
    if not path.is_file():
        raise BadTable(str(path), "does not exist", "give --out the folder that modcal target wrote")
    data = read_yaml(path)
    if not isinstance(data, dict) or not isinstance(data.get("rulers"), dict):
        raise BadTable(str(path), "has no rulers", "give --out the folder that modcal target wrote")
    data["rulers"] |= {"measured_x_m": measured[0], "measured_y_m": measured[1]}
    if to_mm is not None:
        data["rulers"]["measured_std_m"] = 1e-3 * to_mm
    scale = target_from_data(data, str(path)).scale
    write_file(path, to_yaml(data))
    x, y = (100.0 * (of - 1.0) for of in (scale.x, scale.y))
    said = [f"The sheet came out {x:+.2f} % along x and {y:+.2f} % along y."]
    if scale.unsaid:
        said.append("Read both once more, and say how well with --measured-to-mm: all lengths rest on them.")
    output.result(data, said, f"Target: {path}")
