"""``modcal compare``: two calibrations or reports side by side."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from modcal_core.calibration import Calibration
from modcal_core.errors import BadTable
from modcal_core.files import read_json, to_json
from modcal_core.measurements import require
from modcal_core.report import Side, compare, comparison_data, comparison_summary
from modcal_nodes.cli.certificate import UNMET
from modcal_nodes.cli.console import Output, speaking
from modcal_nodes.cli.inputs import EXISTING, WRITTEN
from modcal_nodes.cli.numbers import Decimal
from modcal_nodes.cli.show import show_blocks
from modcal_nodes.io import SCHEMA


@click.command("compare")
@click.argument("first", type=EXISTING, metavar="A")
@click.argument("second", type=EXISTING, metavar="B")
@click.option(
    "--tolerance-mm", type=Decimal(min=0.0, min_open=True), metavar="MM",
    help="How far the two may differ at the tool, 95th percentile; exit code 3 if it is more, or cannot be told.",
)  # fmt: skip
@click.option("--out", type=WRITTEN, help="Folder of comparison.json.")
@speaking
def compare_command(first: Path, second: Path, tolerance_mm: float | None, out: Path | None, output: Output) -> int:
    """Compare two calibrations, or two reports: what differs between A and B, and whether it matters.

    A and B are folders of modcal calibrate or modcal evaluate, calibration.yaml files, or report.json files.
    """
    names = (first.name, second.name) if first.resolve().name != second.resolve().name else (str(first), str(second))
    with output.working() as watch:
        watch("comparing")
        sides = [_side(path, name) for path, name in zip((first, second), names, strict=True)]
        found = compare(sides[0], sides[1], tolerance_mm)
    data = comparison_data(found)
    out = out or Path(f"{first.resolve().stem}_{second.resolve().stem}_comparison")
    files = {"comparison.json": to_json(data)}
    output.saved(data, partial(show_blocks, comparison_summary(found)), out, files, "Comparison", "comparison.json")
    judged = tolerance_mm is not None and found.result in ("beyond tolerance", "cannot tell")
    return UNMET if judged else 0


def _side(path: Path, name: str) -> Side:
    """What is at a path: a calibration with the report beside it, or a report alone. Raises BadTable."""
    if path.suffix == ".json":
        return Side(name, report=_report(path))
    folder = path if path.is_dir() else path.parent
    beside = folder / "report.json"
    report = _report(beside) if beside.is_file() else None
    if path.is_dir() and not (path / "calibration.yaml").is_file():
        if report is None:
            said = "holds neither calibration.yaml nor report.json"
            raise BadTable(str(path), said, "give a folder of modcal calibrate or modcal evaluate")
        return Side(name, report=report)
    return Side(name, Calibration.load(path), report)


def _report(path: Path) -> dict[str, Any]:
    """The data of a report.json. Raises BadTable for anything else."""
    remedy = "give the report.json that modcal calibrate or modcal evaluate wrote"
    data = read_json(path, remedy)
    require(data, SCHEMA, str(path), remedy)
    return dict(data)
