"""``modcal info`` and ``modcal repair``: what is in a bag, and what can be saved of a broken one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click

from modcal_core.errors import ModcalError
from modcal_core.measurements import Recording, inspect
from modcal_core.report import Summary, SummaryLine, TableBlock
from modcal_core.robot import Robot
from modcal_msgs_py import read_recording, repair_bag
from modcal_nodes.cli.console import EXISTING, WRITTEN, Output, given, speaks
from modcal_nodes.cli.inputs import chain_line, described
from modcal_nodes.io import ChainOptions, TopicOptions, option

_MAX_SIGNALS = 8  # that are listed
_MIN_IMAGES = 4  # with the target, that a calibration can be made from


@dataclass(frozen=True)
class InfoOptions(ChainOptions, TopicOptions):
    """Of which robot a bag is, and which target its images show."""

    urdf: Path | None = option("Robot description. Default: the one in the bag.")
    delta: Path | None = option("Description of a Delta robot instead.")
    target: Path | None = option("Printed target: say what the images are good for.")
    image_topic: str | None = option("Images. Default: the only ones there are.", metavar="TOPIC")


@click.command("info")
@click.argument("bag", type=EXISTING)
@given(InfoOptions)
@speaks()
def info_command(bag: Path, output: Output, options: InfoOptions) -> None:
    """Show what is in BAG, what it can be used for, and what looks wrong."""
    arm = (options.delta, options.urdf, options.base, options.tip)
    recording = read_recording(bag, topics=options.topics)
    findings: tuple[str, ...] = ()
    try:
        robot: Robot | None = described(recording, *arm)
    except ModcalError as error:
        if any(one is not None for one in arm):
            raise
        robot, findings = None, (f"No robot: {error}.",)
    seen = inspect(recording, None if robot is None else robot.mechanism)
    images, uses = _images(bag, recording, options, () if robot is None else robot.names)
    findings = (*findings, *(() if robot is None else robot.notes), *images.get("findings", ()))
    data = {
        "bag": str(bag),
        "duration_s": recording.duration,
        "topics": [asdict(track) for track in seen.tracks],
        "listed": [asdict(one) for one in recording.listed],
        "robot": None
        if robot is None
        else {"base": robot.base, "tip": robot.tip, "joints": list(robot.names), "other_tips": list(robot.other_tips)},
        "uses": [*seen.uses, *uses],
        "images": images or None,
        "findings": [*findings, *seen.findings],
    }
    output.result(data, _shown(data, _MAX_SIGNALS if not output.verbose else len(seen.tracks)))


def _images(
    bag: Path, recording: Recording, options: InfoOptions, names: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """(what is known of the images, what they can be used for)."""
    from modcal_msgs_py import image_topics

    found = image_topics(recording.listed)
    if options.target is None:
        if not found:
            return {}, []
        there = ", ".join(f"{one.count} of {one.topic}" for one in found)
        return {"topics": [one.topic for one in found]}, [f"a calibration by camera ({there}): see with --target FILE"]
    # OpenCV, which other bags can do without
    from modcal_core.camera import read_target
    from modcal_nodes.vision import images_worth, worth_line

    worth = images_worth(bag, recording, read_target(options.target), options.image_topic, names)
    use = [f"a calibration by camera: {worth_line(worth)}"] if worth.found >= _MIN_IMAGES else []
    return {**asdict(worth), "line": worth_line(worth)}, use


def _shown(data: dict[str, Any], most: int) -> list[str | Summary]:
    """What is used first. most: signals that have a line each; of more there is one line."""
    out: list[str | Summary] = [SummaryLine(f"can be used for {use}", "good") for use in data["uses"]]
    if robot := data["robot"]:
        out.append(chain_line(robot["base"], robot["tip"], len(robot["joints"]), robot["other_tips"]))
    signals = [track for track in data["topics"] if track["what"].startswith("signal:")]
    listed = [track for track in data["topics"] if len(signals) <= most or track not in signals]
    cells = "{topic} | {what} | {count} | {rate:.4g} | {largest_gap:.3g} s"
    out.append(TableBlock.of("", "topic | what | messages | Hz | largest gap", cells, listed, words=2))
    if len(signals) > most:
        topics = len({track["topic"] for track in signals})
        out.append(f"{len(signals)} numbers of {topics} other topics, on which errors may depend: all with --verbose")
    out.append(f"duration: {data['duration_s']:.1f} s")
    for one in data["listed"]:
        if one["role"] is None and one["could"]:
            kind = one["type_name"].rpartition("/")[2]
            out.append(f"{one['topic']} ({kind}) could be {' or '.join(map(_said, one['could']))}")
    return [*out, *(SummaryLine(finding, "doubt") for finding in data["findings"])]


def _said(role: str) -> str:
    return "the tracker, by --tf PARENT:CHILD" if role == "tf" else f"{role}, by --topic"


@click.command("repair")
@click.argument("bag", type=click.Path(exists=True, path_type=Path))
@click.option("--out", type=WRITTEN, help="The new bag. Default: BAG_repaired.")
@speaks()
def repair_command(bag: Path, out: Path | None, output: Output) -> None:
    """Repair BAG, which was truncated: killed recorder, full disk, power failure.

    Every whole message is kept as it is. BAG itself is not changed; if it is intact, nothing is written.
    """
    if out is None:
        place = bag.resolve()
        out = place.parent / f"{place.stem if place.is_file() else place.name}_repaired"
    with output.working() as watch:
        done = repair_bag(bag, out, watch)
    data = {
        "bag": str(bag),
        "repaired": None if done.folder is None else str(done.folder),
        "reasons": list(done.reasons),
        "messages": dict(done.saved),
    }
    count = sum(done.saved.values())
    if done.folder is None:
        output.result(data, [f"{bag} is whole ({count} messages): nothing to repair"])
        return
    table = TableBlock("", ("topic", "messages saved"), tuple((topic, str(n)) for topic, n in done.saved.items()))
    reasons = [SummaryLine(reason, "doubt") for reason in done.reasons]
    output.result(data, [*reasons, table, SummaryLine(f"{done.folder}: {count} messages saved", "good")])
