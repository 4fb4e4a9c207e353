"""``modcal calibrate`` and ``modcal evaluate``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain as chained
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from modcal_core.calibration.store import Calibration, fingerprint
from modcal_core.errors import ModcalError
from modcal_core.loop import calibrate, evaluate
from modcal_core.measurements.recording import Piece, Recording
from modcal_core.prepare import Prepared, prepare_pieces
from modcal_core.report.report import Report
from modcal_core.robots.chain import Chain
from modcal_core.robots.delta import Delta
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_msgs_py.mcap_read import read_pieces
from modcal_nodes.cli.robot import delta_of
from modcal_nodes.cli.show import show_report
from modcal_nodes.files import write_folder
from modcal_nodes.inputs import read_calibration, read_cell
from modcal_nodes.results import calibration_files, delta_files, report_files

EXISTING = click.Path(exists=True, path_type=Path)
_SPLITS = click.option(
    "--block",
    type=click.IntRange(min=1),
    default=None,
    help="Stations that the split keeps together; 1 splits by station. Default: blocks for dense recordings.",
)
_SEED = click.option("--seed", type=int, default=0, show_default=True, help="Of the split.")
_CLOCK = click.option(
    "--clock-limit", type=click.FloatRange(min=0.0), default=0.5, show_default=True, metavar="S",
    help="Largest offset between tracker and joint clocks that is corrected.",
)  # fmt: skip
_CELL = click.option(
    "--cell", "cell_file", type=EXISTING, default=None, help="YAML of known distances and fixed parameters."
)
_OUT = click.option("--out", type=click.Path(path_type=Path), default=None, help="Folder of the results.")


@click.command("calibrate")
@click.argument("bag", type=EXISTING)
@click.option("--urdf", type=EXISTING, default=None, help="Robot description. Default: the one in the bag.")
@click.option("--delta", type=EXISTING, default=None, help="Description of a Delta robot, in the URDF's place.")
@click.option("--base", default=None, metavar="LINK", help="Where the arm begins. Default: the root link.")
@click.option(
    "--tip", default=None, metavar="LINK", help="Where it ends. Default: the link behind most recorded joints."
)
@click.option(
    "--fix", "fixed", multiple=True, metavar="NAME", help="Keep a parameter or place as it is, e.g. tool. Repeatable."
)
@click.option("--geometry-only", is_flag=True, help="Look for no other effects: only the geometry is fitted.")
@click.option(
    "--also", "more", type=EXISTING, multiple=True, metavar="BAG",
    help="Another recording of the same cell, tool and tracker untouched. Repeatable.",
)  # fmt: skip
@_CELL
@_SPLITS
@_SEED
@_CLOCK
@_OUT
def calibrate_command(
    bag: Path,
    geometry_only: bool,
    more: tuple[Path, ...],
    urdf: Path | None,
    delta: Path | None,
    base: str | None,
    tip: str | None,
    fixed: tuple[str, ...],
    cell_file: Path | None,
    block: int | None,
    seed: int,
    clock_limit: float,
    out: Path | None,
) -> None:
    """Identify the arm from BAG, find what its model lacks, and write the corrected model and a report."""
    cell = read_cell(cell_file, fixed)
    recording, pieces = _begun(bag)
    chain, text = delta_of(recording, delta, urdf, base, tip)
    prepared = prepare_pieces(pieces, chain, clock_limit=clock_limit)
    for other in more:
        added = prepare_pieces(read_pieces(other), chain, clock_limit=clock_limit)
        prepared = Prepared(prepared.samples.followed_by(added.samples), (*prepared.notes, *added.notes))
    result = calibrate(
        prepared.samples,
        chain,
        np.random.default_rng(seed),
        cell,
        block,
        read_inertias(text, chain) if isinstance(chain, Chain) and text is not None else None,
        look_for_effects=not geometry_only,
    )
    report = _named(result.report, recording, prepared)
    out = out or Path(f"{bag.resolve().stem}_calibration")
    if isinstance(chain, Chain) and text is not None:
        files = calibration_files(result, report, chain, text)
    else:
        files = delta_files(result, report)
    write_folder(out, files)
    show_report(report, Console(emoji=False))
    click.echo(f"Report: {out / 'report.html'}")


@click.command("evaluate")
@click.argument("calibration", type=EXISTING)
@click.argument("bag", type=EXISTING)
@click.option("--refit-base", is_flag=True, help="Find the base again: the tracker or the robot was moved.")
@click.option("--refit-tool", is_flag=True, help="Find the tool again: it was changed.")
@_CELL
@_SPLITS
@_SEED
@_CLOCK
@_OUT
def evaluate_command(
    calibration: Path,
    bag: Path,
    refit_base: bool,
    refit_tool: bool,
    cell_file: Path | None,
    block: int | None,
    seed: int,
    clock_limit: float,
    out: Path | None,
) -> None:
    """Score the frozen CALIBRATION (a folder or calibration.yaml) on another BAG."""
    frozen = read_calibration(calibration)
    recording, pieces = _begun(bag)
    prepared = prepare_pieces(pieces, frozen.nominal.chain, clock_limit=clock_limit)
    rng = np.random.default_rng(seed)
    report = evaluate(frozen, prepared.samples, rng, refit_base, refit_tool, read_cell(cell_file), block)
    report = _named(report, recording, prepared)
    report = replace(report, notes=(*report.notes, *_other_robot(frozen, recording)))
    out = out or Path(f"{bag.resolve().stem}_evaluation")
    write_folder(out, report_files(report))
    show_report(report, Console(emoji=False))
    click.echo(f"Report: {out / 'report.html'}")


def _begun(bag: Path) -> tuple[Recording, Iterator[Piece]]:
    """The beginning of a bag, which says whose it is, and all of it in pieces."""
    pieces = read_pieces(bag)
    first = next(pieces)
    return first.recording, chained([first], pieces)


def _named(report: Report, recording: Recording, prepared: Prepared) -> Report:
    return replace(report, title=Path(recording.source).name, notes=(*report.notes, *prepared.notes))


def _other_robot(frozen: Calibration, recording: Recording) -> tuple[str, ...]:
    """A sentence when the recording describes a robot other than the one that was calibrated."""
    nominal, calibrated = frozen.nominal.chain, frozen.calibrated.chain
    if recording.robot_description is None or isinstance(calibrated, Delta):
        return ()
    try:
        described = fingerprint(read_chain(recording.robot_description, nominal.base, nominal.tip))
    except ModcalError as error:
        return (f"The recording's robot description was not compared: {error}.",)
    if described in (frozen.robot, fingerprint(calibrated)):
        return ()
    return ("The recording's robot description has other kinematics than the one that was calibrated.",)
