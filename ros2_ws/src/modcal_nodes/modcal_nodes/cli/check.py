"""``modcal check`` and ``modcal sentinel``: what has changed since a calibration, or since ordinary recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from modcal_core.calibration import Calibration
from modcal_core.checkup import Checked
from modcal_core.errors import BadTable, ModcalError, NotEnoughData, about
from modcal_core.files import read_json
from modcal_core.measurements import Recording
from modcal_core.moves import pattern_of
from modcal_core.public import check
from modcal_core.report import calibration_files, checkup_report, report_files, sentinel_report
from modcal_core.robots import is_serial_arm, read_chain, read_inertias
from modcal_core.sentinel import BagHistory, Cells, MonitoredArm, Normal, cells_of, judge_bags
from modcal_msgs_py import episodes_of, is_lerobot, read_recording
from modcal_nodes.cli.calibrate import CertifiedOptions, calibration_name, certified, frozen_samples
from modcal_nodes.cli.console import Output, saving
from modcal_nodes.cli.inputs import described
from modcal_nodes.cli.options import EXISTING, UNMET, certified_hashes, exit_code, given, particulars
from modcal_nodes.io import ChainOptions, TopicOptions, Watch, of_cell, option, repeated


@dataclass(frozen=True)
class SentinelOptions(ChainOptions, TopicOptions):
    """What is asked of a sentinel: the arm, and what is normal for it."""

    reference: tuple[str, ...] = repeated("A recording of the reference period. Repeatable.", "BAG")
    history: Path | None = option(
        "Folder that keeps all recordings of this arm; --reference adds to its reference period.",
        metavar="FOLDER", type=click.Path(file_okay=False, path_type=Path),
    )  # fmt: skip
    urdf: Path | None = option("Robot description with masses. Default: the one in the bag.")
    other_payload: tuple[str, ...] = repeated(
        "This recording carries another payload than the reference: no alarm. Repeatable.", "BAG"
    )


@click.command("sentinel")
@click.argument("bags", type=EXISTING, nargs=-1, required=True)
@given(SentinelOptions)
@saving("Folder of the results. Default: sentinel.")
def sentinel_command(bags: tuple[Path, ...], output: Output, options: SentinelOptions) -> int:
    """Say whether an arm has changed, from ordinary recordings BAGS of its work: joint states with efforts, commands
    (or a leader, --topic joint_commands=/leader/joint_states), a fixed tag seen by a camera on the hand.

    Recordings of a reference period (four at least, a minute each, of several days) show what is normal. Names joint
    zero, gear, play, friction, latency, servo, payload, camera; exit code 3 on a change. Data sets of LeRobot are read.
    """
    if not options.reference and options.history is None:
        raise NotEnoughData("sentinel", "knows of no reference period", "give --reference BAG …, or --history FOLDER")
    with output.working() as watch:
        arm, name, reference = _read([Path(bag) for bag in options.reference], options, watch, None)
        arm, name, later = _read(list(bags), options, watch, arm, name)
        assert arm is not None
        declared = {Path(bag).resolve().stem for bag in options.other_payload}
        others = {cells.name for cells in later if cells.name in declared}
        if others < declared:
            said = "is not among the recordings that are judged"
            raise BadTable(f"--other-payload {', '.join(options.other_payload)}", said, "name one of BAGS")
        judged = later
        if options.history is not None:
            kept = BagHistory(options.history, arm)
            kept.add(reference, "reference")
            reference = [cells for cells, _ in kept.read("reference")]
            now = {(cells.name, cells.began) for cells in later}
            before = [pair for pair in kept.read("later") if (pair[0].name, pair[0].began) not in now]
            others |= {cells.name for cells, other in before if other}
            judged = [*(cells for cells, _ in before), *later]
        watch("learning what is normal")
        normal = Normal.fit(reference, arm)
        watch("judging")
        found = judge_bags(normal, judged, others)
        if options.history is not None:
            for cells in later:
                kept.add([cells], "later", cells.name in others, found.sentence)
    output.saved(sentinel_report(found, name), "sentinel")
    return 0 if found.status == "unchanged" else UNMET


def _read(
    bags: list[Path], options: SentinelOptions, watch: Watch, arm: MonitoredArm | None, name: str = ""
) -> tuple[MonitoredArm | None, str, list[Cells]]:
    """The arm, its name and the cells of these recordings."""
    out = []
    for bag in bags:
        watch(f"reading {bag.name}")
        with about(str(bag)):
            for label, recording in _recordings(bag, options):
                if arm is None:
                    arm, name = _arm(recording, options)
                out.append(cells_of(recording, arm.names, label))
    return arm, name, out


def _recordings(bag: Path, options: SentinelOptions) -> list[tuple[str, Recording]]:
    if is_lerobot(bag):
        return episodes_of(bag)
    return [(bag.resolve().stem, read_recording(bag, topics=options.topics))]


def _arm(recording: Recording, options: SentinelOptions) -> tuple[MonitoredArm, str]:
    """The arm of a recording; without a description the joints that are recorded, which show no torques."""
    if options.urdf is None and recording.robot_description is None:
        track = max(recording.joints, key=lambda one: len(one.names), default=None)
        if track is None:
            raise NotEnoughData(recording.source, "holds no joint states", "record joint_states")
        return MonitoredArm(track.names), recording.source
    robot = described(recording, None, options.urdf, options.base, options.tip)
    bodies = read_inertias(robot.description or "", robot.chain)
    return MonitoredArm(robot.chain.names, robot.chain, bodies), robot.name


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
    said = particulars(options)
    frozen = Calibration.load(calibration)
    cell = options.cell
    of_core = {name: getattr(options, name) for name in ("seed", "tolerance_mm", "tolerance_of")}
    name = calibration_name(calibration)
    with output.working() as watch:
        samples = frozen_samples(frozen, bag, options, watch)
        watch("checking")
        with of_cell(options.cell_file):
            found = check(frozen, samples, cell=cell, pattern=_pattern(calibration), **of_core)
        files = _files(found, calibration, urdf, samples.origin.description)
        if said is not None:
            watch("writing the certificate")
            model: str | Path = files.get("calibration.yaml", calibration)
            hashes = certified_hashes(files.get("calibrated.urdf", samples.origin.description), model)
            files |= certified(found.report, samples, options, said, hashes, frozen)
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
