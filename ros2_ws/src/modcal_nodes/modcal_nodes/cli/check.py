"""``modcal check``: what has changed since a calibration, from a few new stations."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import click

from modcal_core.calibration import Calibration, to_data
from modcal_core.checking import pattern_of
from modcal_core.checkup import Checked
from modcal_core.errors import BadTable, ModcalError
from modcal_core.files import read_json, to_json, to_yaml
from modcal_core.public import check
from modcal_core.report import (
    calibration_files,
    checkup_data,
    checkup_html,
    checkup_summary,
    delta_files,
    report_files,
)
from modcal_core.robots import is_serial_arm, read_chain
from modcal_nodes.cli.calibrate import OUT, CertifiedOptions, calibration_name, certified, frozen_samples
from modcal_nodes.cli.certificate import certified_hashes, exit_code, particulars
from modcal_nodes.cli.console import Output, speaking
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
@OUT
@speaking
def check_command(
    calibration: Path, bag: Path, urdf: Path | None, out: Path | None, output: Output, options: CertifiedOptions
) -> int:
    """Say what has changed since CALIBRATION (a folder or calibration.yaml), from ten or more stations in BAG.

    Names base, tool, a joint's zero, a gear, a load, heat, or the tracker, says by how much and what to do, and writes
    the model with only that repaired.
    """
    said = particulars(options)
    frozen = Calibration.load(calibration)
    cell = options.cell
    of_core = {name: getattr(options, name) for name in ("seed", "tolerance_mm", "tolerance_of")}
    with output.working() as watch:
        samples = frozen_samples(frozen, bag, options, watch)
        watch("checking")
        with of_cell(options.cell_file):
            found = check(frozen, samples, cell=cell, pattern=_pattern(calibration), **of_core)
        files = check_files(found, calibration, urdf, samples.origin.description)
        if said is not None:
            watch("writing the certificate")
            model: str | Path = files.get("calibration.yaml", calibration)
            hashes = certified_hashes(files.get("calibrated.urdf", samples.origin.description), model)
            files |= certified(found.report, samples, options, said, hashes, frozen)
    name = calibration_name(calibration)
    files["check.html"] = checkup_html(found, f"{name}, checked by {bag.resolve().stem}", list(files))
    out = out or Path(f"{bag.resolve().stem}_check")
    output.saved(checkup_data(found, name), checkup_summary(found), out, files, "Check", "check.html")
    return exit_code(found.report.tolerance)


def check_files(found: Checked, calibration: Path, urdf: Path | None, recorded: str | None) -> dict[str, str]:
    """Names and texts of the files of a check, but for its page: what was found, and the repaired model."""
    name = calibration_name(calibration)
    files: dict[str, str] = {"check.json": to_json(checkup_data(found, name))}
    if len(found.advice.stations):
        stations = io.StringIO()
        writer = csv.writer(stations, lineterminator="\n")
        writer.writerow(found.joints)
        writer.writerows([f"{x:.6f}" for x in q] for q in found.advice.stations)
        files["stations.csv"] = stations.getvalue()
    repaired = found.repaired
    if repaired is None:
        return files | report_files(found.report, calibration=name)
    if not is_serial_arm(repaired.calibrated.chain):
        return files | delta_files(repaired, found.report)
    text, chain = _description(calibration, urdf, recorded, repaired)
    if text is None:
        return files | {"calibration.yaml": to_yaml(to_data(repaired))} | report_files(found.report, calibration=name)
    return files | calibration_files(repaired, found.report, chain, text)


def _description(
    calibration: Path, urdf: Path | None, recorded: str | None, repaired: Calibration
) -> tuple[str | None, Any]:
    """The robot description to write into, and the arm as it stands there; None where there is none of this arm."""
    nominal = repaired.nominal.serial
    beside = (calibration if calibration.is_dir() else calibration.parent) / "calibrated.urdf"
    texts = [urdf.read_text(encoding="utf-8")] if urdf is not None else []
    texts += [] if urdf is not None or not beside.is_file() else [beside.read_text(encoding="utf-8")]
    texts += [] if urdf is not None or recorded is None else [recorded]
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


def _pattern(calibration: Path) -> float | None:
    """The predictable share in the report beside a calibration; None where there is none, as in reports of cameras."""
    beside = (calibration if calibration.is_dir() else calibration.parent) / "report.json"
    if not beside.is_file():
        return None
    remedy = "remove it, or calibrate again"
    report = read_json(beside, remedy)
    try:
        share = report.get("predictable") if report.get("camera") else report["predictable"]
        return None if share is None else pattern_of(float(share["share"]))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadTable(str(beside), "is not a report of modcal", remedy) from error
