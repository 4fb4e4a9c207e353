"""The calibration of a recording, as ``modcal calibrate`` makes one and ``modcal fleet`` many."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import chain as chained
from pathlib import Path
from typing import cast

import numpy as np

from modcal_core.calibration.moves import Move
from modcal_core.calibration.own_statement import together_stated
from modcal_core.calibration.store import Calibration
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.loop import calibrate
from modcal_core.measurements.dropped import BETWEEN, together
from modcal_core.measurements.recording import Piece, Recording
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.sequence import after, between
from modcal_core.prepare import Prepared, prepare_pieces
from modcal_core.report.report import Report
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_core.robots.urdf_tree import document
from modcal_core.verdict.readings import COMPUTED
from modcal_core.verdict.tolerance import Asked, Statistic
from modcal_msgs_py.choosing import Topics
from modcal_msgs_py.mcap_read import read_pieces
from modcal_nodes.cli.robot import delta_of
from modcal_nodes.io.files import read_yaml
from modcal_nodes.io.inputs import read_cell, read_topics, stated_from
from modcal_nodes.io.options import Options
from modcal_nodes.io.progress import Watch, silent
from modcal_nodes.io.results import calibration_files, delta_files
from modcal_nodes.io.trace import began, trace_of

NO_TOPICS = Topics()


@dataclass(frozen=True)
class Calibrated:
    """A report, the calibration, the samples it was made from, and names and texts of the files it leaves behind.

    robot: the name that the description gives the robot. began: earliest stamp of the recording [s].
    """

    report: Report
    calibration: Calibration
    samples: Samples
    files: dict[str, str]
    robot: str
    began: float


def calibrate_bag(bag: Path, options: Options, more: tuple[Path, ...] = (), watch: Watch = silent) -> Calibrated:
    """The calibration of the arm in a bag, and in more bags of its cell. Raises ModcalError for unusable ones.

    watch: hears of the stages.
    """
    asked = tolerance_asked(options.tolerance_mm, options.tolerance_of)
    cell = read_cell(options.cell_file, options.fixed, stated_from(asdict(options)))
    factory = None if options.factory_kinematics is None else read_yaml(options.factory_kinematics)
    topics = read_topics(options.cell_file, Topics.of(options.topic, options.ignore, options.tf))
    recording, pieces = begun(bag, watch, topics)
    chain, text = delta_of(recording, options.delta, options.urdf, options.base, options.tip)
    prepared = prepare_pieces(pieces, chain, clock_limit=options.clock_limit)
    for other in more:
        added = prepare_pieces(read(other, watch, topics), chain, clock_limit=options.clock_limit)
        samples, late = after(added.samples, prepared.samples)
        if late:
            said = f"{other.name} overlaps the recordings before it in time: its stamps were put {late:.1f} s later."
            added = replace(added, notes=(*added.notes, said))
        if cell.own_in_recordings:
            cell = cell.with_move(Move(between(prepared.samples, samples), cell.own_in_recordings))
        prepared = Prepared(
            prepared.samples.followed_by(samples),
            (*prepared.notes, *added.notes),
            together([prepared.dropped, added.dropped]),
            together_stated([prepared.stated, added.stated]),
        )
    cell = replace(cell, stated=cell.stated.over(prepared.stated))
    watch("fitting the geometry")
    try:
        result = calibrate(
            prepared.samples,
            chain,
            np.random.default_rng(options.seed),
            cell,
            options.block,
            read_inertias(text, chain) if isinstance(chain, Chain) and text is not None else None,
            progress=lambda effect: watch(f"trying {effect}"),
            look_for_effects=not options.geometry_only,
        )
    except NotEnoughData as error:
        raise too_little(error, prepared) from error
    _require_measured(recording, result.report)
    watch("writing the report")
    serial = isinstance(chain, Chain) and text is not None
    robot = str(document(text).get("name") or "robot") if serial and text is not None else "delta"
    report = named(result.report, recording, prepared).with_tolerance(asked)
    report = replace(report, trace=trace_of(bag, recording, robot, prepared.samples.frames))
    if isinstance(chain, Chain) and text is not None:
        files = calibration_files(result, report, chain, text, factory)
    else:
        files = delta_files(result, report)
    return Calibrated(report, result.calibration, prepared.samples, files, robot, began(recording) or 0.0)


def tolerance_asked(mm: float | None, of: str) -> Asked | None:
    """The tolerance that options ask for; None where they ask for none. Raises BadTable."""
    return None if mm is None else Asked(mm, cast(Statistic, of))


def too_little(error: NotEnoughData, prepared: Prepared) -> NotEnoughData:
    """The refusal, with what was left out before."""
    left_out = ", ".join(f"{n} {reason}" for reason, n in prepared.dropped if reason != BETWEEN)
    return NotEnoughData(
        error.offender, f"{error.limit}; left out: {left_out}" if left_out else error.limit, error.remedy
    )


def _require_measured(recording: Recording, report: Report) -> None:
    """Raises BadRecording where a topic that nobody named turns out to hold what was computed from the joints."""
    reasons = () if report.judged is None else report.judged.open_because
    computed = [reason for reason in reasons if COMPUTED in reason]
    by_type = [reading.topic for reading in recording.readings if reading.by_type]
    if computed and by_type:
        raise BadRecording(
            f"topic {by_type[0]}",
            f"was taken for the tracker's, as the only one that can be; but {computed[0].rstrip('.')}",
            f"record a tracker, or state --topic tracker/pose={by_type[0]} if it is one",
        )


def begun(bag: Path, watch: Watch = silent, topics: Topics = NO_TOPICS) -> tuple[Recording, Iterator[Piece]]:
    """The beginning of a bag, which says whose it is, and all of it in pieces."""
    pieces = read(bag, watch, topics)
    first = next(pieces)
    return first.recording, chained([first], pieces)


def read(bag: Path, watch: Watch, topics: Topics = NO_TOPICS) -> Iterator[Piece]:
    """All of a bag in pieces, the watch being told how far it has been read."""
    return read_pieces(bag, heard=lambda share: watch(f"reading {bag.name}", share), topics=topics)


def named(report: Report, recording: Recording, prepared: Prepared) -> Report:
    """The report with the recording's name, and with what there is to know of its samples."""
    notes = (*report.notes, *prepared.notes)
    return replace(report, title=Path(recording.source).name, notes=notes, dropped=prepared.dropped)
