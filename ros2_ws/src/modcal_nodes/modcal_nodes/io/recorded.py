"""The calibration of a recording, as ``modcal calibrate`` makes one and ``modcal fleet`` many."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from modcal_core.calibration import Calibration, Cell, Move, Stated, together_stated
from modcal_core.errors import BadRecording, about
from modcal_core.files import read_yaml
from modcal_core.measurements import Samples, after, between, require_new, together
from modcal_core.public import Result, calibrate, tolerance_asked
from modcal_core.robot import Robot
from modcal_msgs_py import Bag, Topics, read_bag
from modcal_nodes.cli import described
from modcal_nodes.io.inputs import of_cell, read_cell, read_topics, stated_from
from modcal_nodes.io.options import Options, Watch, silent


@dataclass(frozen=True)
class Calibrated:
    """A result, and names and texts of the files it leaves behind."""

    result: Result
    files: dict[str, str]


def calibrate_bag(bag: Path, options: Options, more: tuple[Path, ...] = (), watch: Watch = silent) -> Calibrated:
    """The calibration of the arm in a bag, and in more bags of its cell. Raises ModcalError for unusable ones.

    watch: called with the name of each stage.
    """
    tolerance_asked(options.tolerance_mm, options.tolerance_of)
    cell = read_cell(options.cell_file, options.fixed, stated_from(asdict(options)))
    factory = None if options.factory_kinematics is None else read_yaml(options.factory_kinematics)
    topics = read_topics(options.cell_file, options.topics)
    first = opened(bag, watch, topics)
    robot = described(first.recording, options.delta, options.urdf, options.base, options.tip)
    samples = first.samples(robot, options.clock_limit)
    for at in first.recording.tool_changes:
        cell = cell.with_move(Move(at, "tool"))
    for other in more:
        with about(str(other)):
            added = opened(other, watch, topics).samples(robot, options.clock_limit)
        samples, cell = _with(samples, cell, added, other.name)
    with of_cell(options.cell_file):
        result = calibrate(
            robot,
            samples,
            options.seed,
            cell=cell,
            geometry_only=options.geometry_only,
            block=options.block,
            tolerance_mm=options.tolerance_mm,
            tolerance_of=options.tolerance_of,
            progress=watch,
        )
    if options.by_distances:
        watch("fitting distances alone")
        result = result.with_distances(options.seed)
    watch("writing the report")
    with about(str(options.factory_kinematics)) if factory is not None else nullcontext():
        return Calibrated(result, result.files(factory))


def opened(bag: Path, watch: Watch = silent, topics: Topics | None = None) -> Bag:
    """A bag, the watch being told how far it has been read."""
    return read_bag(bag, topics or Topics(), heard=lambda share: watch(f"reading {bag.name}", share))


def of_calibrated(recorded: Bag, frozen: Calibration, clock_limit: float) -> Samples:
    """The samples of a bag for the arm of a frozen calibration, which knows its base, its tip and its joints. Raises
    BadRecording, for a bag without these joints with the remedy of one who states no robot.
    """
    chain = frozen.nominal.chain
    try:
        return recorded.samples(Robot(chain), clock_limit)
    except BadRecording as error:
        missing = [name for name in chain.names if name not in recorded.joints]
        if not missing or not recorded.joints:
            raise
        raise BadRecording(
            f"joint {', '.join(missing)} of the calibration",
            f"not among the joint states ({', '.join(sorted(recorded.joints))})",
            f"give a recording of the arm that was calibrated ({chain.base} → {chain.tip}), its joints named as then",
        ) from error


def _with(samples: Samples, cell: Cell, added: Samples, name: str) -> tuple[Samples, Cell]:
    """The samples with those of another bag of the same cell behind them, and the cell with what moved between."""
    require_new(added, samples, name)
    later, late = after(added, samples)
    one, two = samples.origin, added.origin
    notes = (*one.notes, *two.notes)
    if late:
        notes = (*notes, f"{name} overlaps the recordings before it: its stamps were shifted {late:.1f} s later.")
    moment = between(samples, later)
    cell = replace(cell, between=tuple(sorted((*cell.between, moment))))
    if cell.own_in_recordings:
        cell = cell.with_move(Move(moment, cell.own_in_recordings))
    each = [Stated(instrument_mm=o.instrument_mm, instrument_deg=o.instrument_deg) for o in (one, two)]
    stated = together_stated(each)
    origin = replace(
        one,
        notes=notes,
        dropped=together([one.dropped, two.dropped]),
        doubts=(*one.doubts, *two.doubts),
        instrument_mm=stated.instrument_mm,
        instrument_deg=stated.instrument_deg,
    )
    return replace(samples.followed_by(later), origin=origin), cell
