"""Recordings of an arm at its work, judged, as ``modcal sentinel`` does for one arm and ``modcal fleet`` for many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from modcal_core.errors import BadTable, NotEnoughData, about
from modcal_core.files import read_yaml
from modcal_core.measurements import Recording
from modcal_core.robots import read_inertias
from modcal_core.sentinel import ArmJudge, ArmVerdict, BagHistory, Cells, MonitoredArm, Normal, cells_of
from modcal_msgs_py import episodes_of, is_lerobot, read_recording
from modcal_msgs_py.tables import import_tables, require_mapping
from modcal_nodes.cli import described
from modcal_nodes.io.options import ChainOptions, TopicOptions, Watch, option, repeated, silent

TABLES = (".csv", ".txt", ".tsv", ".xlsx")


@dataclass(frozen=True)
class SentinelOptions(ChainOptions, TopicOptions):
    """What is asked of a sentinel: the arm, and what is normal for it."""

    reference: tuple[str, ...] = repeated("A recording of the reference period. Repeatable.", "BAG")
    history: str | None = option(
        "Folder that keeps all recordings of this arm; --reference adds to its reference period.", metavar="FOLDER"
    )
    urdf: Path | None = option("Robot description with masses. Default: the one in the bag.")
    mapping: Path | None = option("How recordings that are tables are read, as modcal import takes it.", metavar="FILE")
    other_payload: tuple[str, ...] = repeated(
        "This recording carries another payload than the reference: no alarm. Repeatable.", "BAG"
    )


def judge_arm(bags: Sequence[Path], options: SentinelOptions, watch: Watch = silent) -> tuple[ArmVerdict, str]:
    """Whether an arm has changed, by recordings of its work, and its name. Raises ModcalError for unusable ones.

    watch: called with the name of each stage.
    """
    declared = {Path(bag).resolve() for bag in options.other_payload}
    if not declared <= {bag.resolve() for bag in bags}:
        said = "is not among the recordings that are judged"
        raise BadTable(f"--other-payload {', '.join(options.other_payload)}", said, "name one of BAGS")
    arm: MonitoredArm | None = None
    name, reference, later = "", list[Cells](), list[tuple[Cells, bool]]()
    given = [Path(bag) for bag in options.reference]
    for k, bag in enumerate((*given, *bags)):
        watch(f"reading {bag.name}")
        with about(str(bag)):
            for label, recording in _recordings(bag, options):
                if arm is None:
                    arm, name = _arm(recording, options)
                cells = cells_of(recording, arm.names, label)
                if k < len(given):
                    reference.append(cells)
                else:
                    later.append((cells, bag.resolve() in declared))
    assert arm is not None
    watch("judging")
    if options.history is None:
        judge = ArmJudge(Normal.fit(reference, arm))
        return judge.judged([judge.hear(*pair) for pair in later]), name
    kept = BagHistory(Path(options.history), arm)
    kept.add(reference, "reference")
    return kept.judged(later), name


def _recordings(bag: Path, options: SentinelOptions) -> list[tuple[str, Recording]]:
    if is_lerobot(bag):
        return episodes_of(bag)
    if bag.suffix.lower() in TABLES and options.mapping is not None:
        stated = require_mapping(read_yaml(options.mapping), options.mapping.name)
        alone = {**stated, "tables": [{**table, "files": bag.name} for table in stated["tables"]]}
        return [(bag.stem, import_tables(alone, bag.parent, options.mapping.name))]
    return [(bag.resolve().stem, read_recording(bag, topics=options.topics))]


def _arm(recording: Recording, options: SentinelOptions) -> tuple[MonitoredArm, str]:
    """The arm of a recording; without a description the joints that are recorded, which show no torques."""
    if options.urdf is None and recording.robot_description is None:
        track = max(recording.joints, key=lambda one: len(one.names), default=None)
        if track is None:
            raise NotEnoughData(recording.source, "holds no joint states", "record joint_states")
        return MonitoredArm(track.names), recording.source
    robot = described(recording, None, options.urdf, options.base, options.tip)
    return MonitoredArm(robot.chain.names, robot.chain, read_inertias(robot.description or "", robot.chain)), robot.name
