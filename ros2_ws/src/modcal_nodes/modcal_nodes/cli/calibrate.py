"""``modcal calibrate`` and ``modcal evaluate``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from modcal_core.calibration import Calibration, Cell, Stated
from modcal_core.measurements import Samples
from modcal_core.outcome import Outcome
from modcal_core.public import evaluate
from modcal_core.report import Hashes, Particulars, report_files, to_json_data
from modcal_core.verdict import STATISTICS
from modcal_msgs_py import Topics
from modcal_nodes.cli.camera import OPTIONS, by_camera, calibrate_images, split_options
from modcal_nodes.cli.certificate import CERTIFICATE, certified_hashes, exit_code, particulars
from modcal_nodes.cli.console import Output, click_options, speaking, tell, with_options
from modcal_nodes.cli.inputs import EXISTING, WRITTEN, Decimal, TopicOptions, Whole, arm_line, chain_line
from modcal_nodes.cli.show import show_report
from modcal_nodes.io import (
    Options,
    Watch,
    calibrate_bag,
    of_calibrated,
    of_cell,
    opened,
    read_cell,
    read_topics,
    stated_from,
)

SEED = Whole(min=0)  # what NumPy takes
_SPLITS = click.option(
    "--block",
    type=Whole(min=1),
    help="Stations that the split keeps together; 1 splits by station. Default: blocks for dense recordings.",
)
SEED_OPTION = click.option("--seed", type=SEED, default=0, help="Seed of the split.")
CLOCK = click.option(
    "--clock-limit", type=Decimal(min=0.0), default=0.5, metavar="S",
    help="Largest offset between tracker and joint clocks that is corrected.",
)  # fmt: skip
CELL = click.option(
    "--cell",
    "cell_file",
    type=EXISTING,
    help="YAML of known distances, fixed parameters, and what is stated of arm and instrument.",
)
OUT = click.option("--out", type=WRITTEN, help="Folder of the results.")


_ROBOT = (
    click.option("--urdf", type=EXISTING, help="Robot description. Default: the one in the bag."),
    click.option("--delta", type=EXISTING, help="Description of a Delta robot, instead of a URDF."),
    click.option("--base", metavar="LINK", help="Link where the arm begins. Default: the root link."),
    click.option(
        "--tip", metavar="LINK", help="Link where it ends. Default: the link behind most recorded joints."
    ),
    click.option(
        "--fix", "fixed", multiple=True, metavar="NAME",
        help="Fix a parameter or place at its nominal value, e.g. tool. Repeatable.",
    ),
    click.option("--geometry-only", is_flag=True, help="Fit only the geometry; do not look for other effects."),
)  # fmt: skip


_POSITIVE = Decimal(min=0.0, min_open=True)
STATED = (
    click.option("--repeatability-mm", type=_POSITIVE, metavar="MM", help="Repeatability of the arm, RMS over space."),
    click.option(
        "--repeatability-iso", type=_POSITIVE, metavar="MM", help="The same as RP of ISO 9283, as data sheets give it."
    ),
    click.option(
        "--repeatability-deg", type=_POSITIVE, metavar="DEG",
        help="Repeatability of the orientation, RMS.",
    ),
    click.option(
        "--instrument-mm", type=_POSITIVE, metavar="MM", help="Error of the instrument, RMS over space."
    ),
    click.option(
        "--instrument-deg", type=_POSITIVE, metavar="DEG",
        help="Orientation error of the instrument, RMS.",
    ),
)  # fmt: skip
TOLERANCE = (
    click.option(
        "--tolerance-mm", type=_POSITIVE, metavar="MM",
        help="Allowed error: PASS, FAIL or CANNOT TELL; exit code 3 unless PASS.",
    ),
    click.option(
        "--tolerance-of", type=click.Choice(STATISTICS), default="p95",
        help="Which error of the held-out stations is compared with the tolerance.",
    ),
)  # fmt: skip


# What is asked of a frozen calibration on a recording
FROZEN = (CELL, *click_options(TopicOptions), *STATED, SEED_OPTION, CLOCK, *TOLERANCE, *CERTIFICATE, OUT)


# What is asked of a calibration, one for each field of :class:`Options` but those of its tolerance
CALIBRATION = (*_ROBOT, CELL, *click_options(TopicOptions), *STATED, _SPLITS, SEED_OPTION, CLOCK)


@dataclass(frozen=True)
class CertifiedOptions(Options):
    """The same with what is asked of a certificate, and of a frozen calibration."""

    certificate: bool = False
    serial: str | None = None
    refit_base: bool = False
    refit_tool: bool = False

    @property
    def cell(self) -> Cell:
        """What is known of the surroundings of a frozen calibration."""
        return read_cell(self.cell_file, stated=stated_from(vars(self)))


@click.command("calibrate")
@click.argument("bag", type=EXISTING, required=False)
@click.option(
    "--also", "more", type=EXISTING, multiple=True, metavar="BAG",
    help="Another recording of the same cell, tool and tracker untouched. Repeatable.",
)  # fmt: skip
@click.option(
    "--factory-kinematics",
    type=EXISTING,
    metavar="FILE",
    help="What the manufacturer's tool took from this arm: kinematics.yaml keeps its form and hash.",
)
@with_options((*CALIBRATION, *TOLERANCE, *CERTIFICATE, *OPTIONS))
@OUT
@speaking
@click.pass_context
def calibrate_command(
    ctx: click.Context,
    /,
    bag: Path | None,
    more: tuple[Path, ...],
    out: Path | None,
    output: Output,
    **options: Any,
) -> int:
    """Identify the arm from BAG, find what its model lacks, and write the corrected model and a report.

    With --target: from images of a printed target, those in BAG, or of --images with --joints and --urdf
    (docs/camera.md).
    """
    camera = split_options(options)
    images = by_camera(ctx, bag, camera)
    asked = CertifiedOptions(**options)
    said = particulars(asked)
    if images or bag is None:
        return calibrate_images(camera, asked, bag, out, output, said)
    with output.working() as watch:
        done = calibrate_bag(bag, asked, more, watch)
        files = dict(done.files)
        if said is not None:
            watch("writing the certificate")
            described = asked.delta or asked.urdf or done.result.robot.description
            hashes = certified_hashes(described, done.files["calibration.yaml"])
            files |= certified(done.result.report, done.result.samples, asked, said, hashes)
    out = out or Path(f"{bag.resolve().stem}_calibration")
    return _say(done.result.report, arm_line(done.result.robot), out, files, output)


@click.command("evaluate")
@click.argument("calibration", type=EXISTING)
@click.argument("bag", type=EXISTING)
@click.option("--refit-base", is_flag=True, help="Fit the base again: the tracker or the robot was moved.")
@click.option("--refit-tool", is_flag=True, help="Fit the tool again: it was changed.")
@with_options((*FROZEN, _SPLITS))
@speaking
def evaluate_command(calibration: Path, bag: Path, out: Path | None, output: Output, **options: Any) -> int:
    """Score the frozen CALIBRATION (a folder or calibration.yaml) on another BAG."""
    asked = CertifiedOptions(**options)
    said = particulars(asked)
    frozen = Calibration.load(calibration)
    of_core = ("refit_base", "refit_tool", "block", "seed", "tolerance_mm", "tolerance_of")
    cell = asked.cell
    with output.working() as watch:
        samples = frozen_samples(frozen, bag, asked, watch)
        watch("scoring")
        with of_cell(asked.cell_file):
            report = evaluate(frozen, samples, cell=cell, **{name: options[name] for name in of_core})
        files = report_files(report, calibration=calibration_name(calibration))
        if said is not None:
            watch("writing the certificate")
            hashes = certified_hashes(samples.origin.description, calibration)
            files |= certified(report, samples, asked, said, hashes, frozen)
    out = out or Path(f"{bag.resolve().stem}_evaluation")
    arm = chain_line(frozen.nominal.chain.base, frozen.nominal.chain.tip, frozen.nominal.chain.n)
    return _say(report, arm, out, files, output)


def frozen_samples(frozen: Calibration, bag: Path, options: Options, watch: Watch) -> Samples:
    """The samples of a bag for the arm of a frozen calibration, by the options of ``FROZEN``. Raises BadRecording."""
    topics = read_topics(options.cell_file, Topics.of(options.topic, options.ignore, options.tf))
    return of_calibrated(opened(bag, watch, topics), frozen, options.clock_limit)


def calibration_name(calibration: Path) -> str:
    """What a calibration is called: its folder, or the file where that has another name than usual."""
    path = calibration.resolve()
    return path.parent.name if path.name == "calibration.yaml" else path.stem if path.is_file() else path.name


def certified(
    report: Outcome,
    samples: Samples,
    options: CertifiedOptions,
    said: Particulars,
    hashes: Hashes,
    frozen: Calibration | None = None,
) -> dict[str, str]:
    """Name and text of the certificate's file. frozen: the calibration that is scored, where it is not a new one."""
    from modcal_core.report import certificate, certificate_html, is_made_from

    # options go before the cell file, and that before what instruments state
    own = Stated(instrument_mm=samples.origin.instrument_mm, instrument_deg=samples.origin.instrument_deg)
    stated = options.cell.stated.over(own)
    made_from = frozen is not None and is_made_from(frozen, samples)
    return {"certificate.html": certificate_html(certificate(report, stated, said, hashes, made_from))}


def _say(report: Outcome, arm: str, out: Path, files: Mapping[str, str], output: Output) -> int:
    """Write the files and show the report; returns the exit code."""

    def show(console: Console) -> None:
        tell([arm], console)
        show_report(report, console)

    output.saved(to_json_data(report), show, out, files)
    return exit_code(report.tolerance)
