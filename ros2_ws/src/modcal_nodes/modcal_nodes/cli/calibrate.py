"""``modcal calibrate``, ``modcal evaluate`` and ``modcal check``: an arm from a recording, and what has changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from modcal_core.calibration import Calibration
from modcal_core.checkup import Checked
from modcal_core.errors import ModcalError, refusing
from modcal_core.files import read_json
from modcal_core.measurements import Samples
from modcal_core.moves import pattern_of
from modcal_core.outcome import Outcome
from modcal_core.public import check, evaluate
from modcal_core.report import VerbResult, calibration_files, checkup_report, report_files, summary, to_json_data
from modcal_core.robots import is_serial_arm, read_chain
from modcal_nodes.cli.camera_input import CameraOptions, by_camera, calibrate_images
from modcal_nodes.cli.certificate import CertifiedOptions, exit_code
from modcal_nodes.cli.console import EXISTING, Output, given, saving
from modcal_nodes.cli.inputs import arm_line, chain_line
from modcal_nodes.io import (
    FrozenOptions,
    Options,
    SplitOptions,
    Watch,
    calibrate_bag,
    of_calibrated,
    of_cell,
    opened,
    option,
    read_topics,
)


@dataclass(frozen=True)
class CalibrateOptions(CertifiedOptions, Options):
    """What ``modcal calibrate`` is asked for."""


@dataclass(frozen=True)
class EvaluateOptions(CertifiedOptions, SplitOptions):
    """What ``modcal evaluate`` is asked for."""

    refit_base: bool = option("Fit the base again: the tracker or the robot was moved.", default=False)
    refit_tool: bool = option("Fit the tool again: it was changed.", default=False)


@click.command("calibrate")
@click.argument("bag", type=EXISTING, required=False)
@click.option(
    "--also", "more", type=EXISTING, multiple=True, metavar="BAG",
    help="Another recording of the same cell, tool and tracker untouched. Repeatable.",
)  # fmt: skip
@given(CalibrateOptions)
@given(CameraOptions, "camera")
@saving()
@click.pass_context
def calibrate_command(
    ctx: click.Context,
    /,
    bag: Path | None,
    more: tuple[Path, ...],
    output: Output,
    options: CalibrateOptions,
    camera: CameraOptions,
) -> int:
    """Identify the arm from BAG, find what its model lacks, and write the corrected model and a report.

    With --target: from images of a printed target, those in BAG, or of --images with --joints and --urdf
    (docs/camera.md).
    """
    images = by_camera(ctx, bag, camera)
    said = options.particulars()
    if images or bag is None:
        return calibrate_images(camera, options, bag, output, said)
    with output.working() as watch:
        done = calibrate_bag(bag, options, more, watch)
        report, robot = done.result.report, done.result.robot
        described = options.delta or options.urdf or robot.description
        page = options.certified(report, done.result.samples, described, done.files["calibration.yaml"])
    return _say(report, arm_line(robot), f"{bag.resolve().stem}_calibration", {**done.files, **page}, output)


@click.command("evaluate")
@click.argument("calibration", type=EXISTING)
@click.argument("bag", type=EXISTING)
@given(EvaluateOptions)
@saving()
def evaluate_command(calibration: Path, bag: Path, output: Output, options: EvaluateOptions) -> int:
    """Score the frozen CALIBRATION (a folder or calibration.yaml) on another BAG."""
    options.particulars()
    frozen = Calibration.load(calibration)
    of_core = ("refit_base", "refit_tool", "block", "seed", "tolerance_mm", "tolerance_of")
    cell = options.cell
    with output.working() as watch:
        samples = frozen_samples(frozen, bag, options, watch)
        watch("scoring")
        with of_cell(options.cell_file):
            report = evaluate(frozen, samples, cell=cell, **{name: getattr(options, name) for name in of_core})
        files = report_files(report, calibration=calibration_name(calibration))
        files |= options.certified(report, samples, samples.origin.description, calibration)
    arm = chain_line(frozen.nominal.chain.base, frozen.nominal.chain.tip, frozen.nominal.chain.n)
    return _say(report, arm, f"{bag.resolve().stem}_evaluation", files, output)


def frozen_samples(frozen: Calibration, bag: Path, options: FrozenOptions, watch: Watch) -> Samples:
    """The samples of a bag for the arm of a frozen calibration. Raises BadRecording."""
    topics = read_topics(options.cell_file, options.topics)
    return of_calibrated(opened(bag, watch, topics), frozen, options.clock_limit)


def calibration_name(calibration: Path) -> str:
    """What a calibration is called: its folder, or the file where that has another name than usual."""
    path = calibration.resolve()
    return path.parent.name if path.name == "calibration.yaml" else path.stem if path.is_file() else path.name


def _say(report: Outcome, arm: str, folder: str, files: Mapping[str, str], output: Output) -> int:
    """Write the files and show the report; returns the exit code."""
    output.saved(VerbResult(to_json_data(report), summary(report), files), folder, arm)
    return exit_code(report.tolerance)


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
