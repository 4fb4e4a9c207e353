"""``modcal check``: what has changed since a calibration, from a few new stations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from modcal_core.calibration import Calibration
from modcal_core.checkup import Checked
from modcal_core.errors import ModcalError, refusing
from modcal_core.files import read_json
from modcal_core.moves import pattern_of
from modcal_core.public import check
from modcal_core.report import calibration_files, checkup_report, report_files
from modcal_core.robots import is_serial_arm, read_chain
from modcal_nodes.cli.calibrate import calibration_name, frozen_samples
from modcal_nodes.cli.certificate import CertifiedOptions, exit_code
from modcal_nodes.cli.console import Output, saving
from modcal_nodes.cli.options import EXISTING, given
from modcal_nodes.io import of_cell


@click.command("check")
@click.argument("calibration", type=EXISTING)
@click.argument("bag", type=EXISTING)
@click.option(
    "--urdf", type=EXISTING,
    help="Robot description to write the repaired one from. Default: that of the calibration's folder, or in BAG.",
)  # fmt: skip
@given(CertifiedOptions)
@saving()
def check_command(calibration: Path, bag: Path, urdf: Path | None, output: Output, options: CertifiedOptions) -> int:
    """Say what has changed since CALIBRATION (a folder or calibration.yaml), from ten or more stations in BAG.

    Names base, tool, a joint's zero, a gear, a load, heat, or the tracker, says by how much and what to do, and writes
    the model with only that repaired.
    """
    options.particulars()
    frozen = Calibration.load(calibration)
    cell = options.cell
    of_core = {name: getattr(options, name) for name in ("seed", "tolerance_mm", "tolerance_of")}
    name, beside = calibration_name(calibration), _folder(calibration) / "report.json"
    pattern = _pattern(beside, str(beside)) if beside.is_file() else None
    with output.working() as watch:
        samples = frozen_samples(frozen, bag, options, watch)
        watch("checking")
        with of_cell(options.cell_file):
            found = check(frozen, samples, cell=cell, pattern=pattern, **of_core)
        files = _files(found, calibration, urdf, samples.origin.description)
        described = files.get("calibrated.urdf", samples.origin.description)
        model: str | Path = files.get("calibration.yaml", calibration)
        files |= options.certified(found.report, samples, described, model)
    recording = bag.resolve().stem
    output.saved(checkup_report(found, name, recording, files), f"{recording}_check")
    return exit_code(found.report.tolerance)


def _files(found: Checked, calibration: Path, urdf: Path | None, recorded: str | None) -> dict[str, str]:
    """Names and texts of a report of the model as it is now, and of the model where it was repaired."""
    repaired = found.repaired
    if repaired is None:
        return report_files(found.report, calibration=calibration_name(calibration))
    if not is_serial_arm(repaired.calibrated.chain):
        return calibration_files(repaired, found.report)
    text, chain = _description(calibration, urdf, recorded, repaired)
    return calibration_files(repaired, found.report, chain, text)


def _description(
    calibration: Path, urdf: Path | None, recorded: str | None, repaired: Calibration
) -> tuple[str | None, Any]:
    """The robot description to write into, and the arm as it stands there; None where there is none of this arm."""
    nominal, beside = repaired.nominal.serial, _folder(calibration) / "calibrated.urdf"
    if urdf is not None:
        texts = [urdf.read_text(encoding="utf-8")]
    else:
        texts = [beside.read_text(encoding="utf-8")] if beside.is_file() else []
        texts += [] if recorded is None else [recorded]
    for text in texts:
        try:
            chain = read_chain(text, nominal.base, nominal.tip)
        except ModcalError:
            if urdf is not None:
                raise
            continue
        if chain.names == nominal.names:
            return text, chain
    return None, None


def _folder(calibration: Path) -> Path:
    return calibration if calibration.is_dir() else calibration.parent


@refusing
def _pattern(report: Path, _: str) -> float | None:
    """The predictable share in a report; None where it has none, as in those of cameras. Raises BadTable."""
    data = read_json(report, "remove it, or calibrate again")
    share = data.get("predictable") if data.get("camera") else data["predictable"]
    return None if share is None else pattern_of(float(share["share"]))
