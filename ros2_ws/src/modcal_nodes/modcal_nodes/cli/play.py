"""``modcal play``: a bag published again, from a shell that has no ``ros2``."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path

import click
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from modcal_core.errors import BadRecording, BadTable, plain
from modcal_core.report import SummaryLine, TableBlock
from modcal_msgs_py import OfferedTopic, PackedMessage, messages_in_order, offered_topics, set_nanoseconds
from modcal_nodes.cli.console import Output, speaking
from modcal_nodes.cli.options import EXISTING, Decimal
from modcal_nodes.ros import MUTUAL, interrupt, joined, passing, stopped_by, type_of

_CLOCK = "/clock"
_DEPTH = 1000  # of what is not latched: a burst must not overwrite what a listener has not yet heard
_LISTENERS, _SETTLE = 5.0, 1.0  # s until the first listener is found at the latest, and from then on for the others
_SPIN = 0.05  # s
_ACKNOWLEDGED = 5.0  # s in which the last messages must have arrived


@click.command("play")
@click.argument("bag", type=EXISTING)
@click.option("--clock", type=Decimal(0.1, 1e4), metavar="HZ", help="Publish /clock, for nodes with use_sim_time.")
@click.option("--rate", type=Decimal(1e-3, 1e3), default=1.0, help="How many times as fast as it was recorded.")
@click.option("--start", type=Decimal(0.0), default=0.0, metavar="S", help="Begin there; what is latched is kept.")
@click.option("--topics", "chosen", multiple=True, metavar="TOPIC", help="Only this topic. Repeatable.")
@click.option("--remap", "remaps", multiple=True, metavar="A:=B", help="Publish topic A as B. Repeatable.")
@speaking
def play_command(
    bag: Path,
    clock: float | None,
    rate: float,
    start: float,
    chosen: tuple[str, ...],
    remaps: tuple[str, ...],
    output: Output,
) -> None:
    """Publish the messages of BAG (MCAP or SQLite) again: the same bytes and stamps, with the QoS of the recording.

    Commands in it are published too, and a robot that listens obeys: --topics leaves them out. Ctrl-C ends it.
    """
    offered = offered_topics(bag)
    names = _names(offered, chosen, remaps, str(bag))
    if clock is not None:
        names.pop(_CLOCK, None)
    kinds = {name: type_of(offered[name].type_name) for name in names}
    notes = [f"{name}: {offered[name].type_name} is not installed here" for name, kind in kinds.items() if kind is None]
    counts, late = {name: 0 for name, kind in kinds.items() if kind is not None}, 0.0
    if not counts:
        raise BadRecording(str(bag), "; ".join(notes) or "holds no message", "source the workspace that has the types")
    with output.working() as watch, stopped_by(interrupt), joined(passing) as (node, turn):
        publishers = {name: node.create_publisher(kinds[name], names[name], _qos(offered[name])) for name in counts}
        ticks = [node.create_publisher(Clock, _CLOCK, QoSProfile(depth=_DEPTH))] if clock is not None else []
        watch("waiting for listeners")
        _meet(turn, publishers.values())
        notes += [f"another node publishes {n} too" for n in map(names.get, counts) if node.count_publishers(n) > 1]
        for note in notes:
            click.echo(plain(f"modcal: {note}"), err=True)
        messages = messages_in_order(bag, counts, lambda share: watch("playing", share), notes.append)
        latched = {name for name in counts if offered[name].latched}
        tick = None if clock is None else round(1e9 * rate / clock)
        first: tuple[float, int] | None = None
        for due, message in _events(messages, round(1e9 * start), latched, tick):
            now = time.monotonic()
            first = first or (now, due)
            wait = first[0] + 1e-9 * (due - first[1]) / rate - now
            late = max(late, -wait)
            time.sleep(max(wait, 0.0))
            if message is not None:
                publishers[message.topic].publish(message.cdr)
                counts[message.topic] += 1
            else:
                set_nanoseconds((time_now := Clock()).clock, due)
                ticks[0].publish(time_now)
        for publisher in (*publishers.values(), *ticks):
            publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGED))
    table = TableBlock("", ("topic", "messages"), tuple((names[name], str(n)) for name, n in sorted(counts.items())))
    data = {"modcal_play": 1, "bag": str(bag), "messages": counts, "late_s": late, "notes": notes}
    shown = [*(SummaryLine(note, "doubt") for note in notes), SummaryLine(f"late by {late:.3f} s at most")]
    output.result(data, [table, *shown])


def _names(offered: Collection[str], chosen: Iterable[str], remaps: Iterable[str], bag: str) -> dict[str, str]:
    """The name under which each topic that is to be played is published. Raises BadTable for what is not there."""
    renamed = {}
    for text in remaps:
        old, _, new = text.partition(":=")
        if not new:
            raise BadTable(f"--remap {text}", "is not A:=B", "write it as /tracker/pose:=/left/tracker/pose")
        renamed[f"/{old.strip('/')}"] = f"/{new.strip('/')}"
    only = [f"/{name.strip('/')}" for name in chosen]
    for name in (*only, *renamed):
        if name not in offered:
            raise BadTable(f"topic {name}", f"has no message in {bag}", f"there are {', '.join(sorted(offered))}")
    return {name: renamed.get(name, name) for name in only or offered}


def _qos(topic: OfferedTopic) -> QoSProfile:
    return QoSProfile(
        depth=max(topic.depth, 1 if topic.latched else _DEPTH),
        reliability=ReliabilityPolicy.RELIABLE if topic.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
    )


def _meet(turn: Callable[[float], None], publishers: Collection[Publisher]) -> None:
    """Wait until whoever listens already has been found, and has found the publishers."""
    end = time.monotonic() + _LISTENERS
    found = False
    while time.monotonic() < end:
        turn(_SPIN)
        if not found and any(publisher.get_subscription_count() for publisher in publishers):
            found, end = True, time.monotonic() + _SETTLE + MUTUAL
    if not found:
        click.echo("modcal: nobody listens yet to what is played", err=True)


def _events(
    messages: Iterable[PackedMessage], start: int, latched: Collection[str], tick: int | None
) -> Iterator[tuple[int, PackedMessage | None]]:
    """(when [ns, the bag's time], message), and None every ``tick`` for the clock; what is latched also from before."""
    begin: int | None = None
    due = 0
    for message in messages:
        if begin is None:
            begin = due = message.received_ns + start
        if message.received_ns < begin and message.topic not in latched:
            continue
        now = max(message.received_ns, begin)
        while tick and due <= now:
            yield due, None
            due += tick
        yield now, message
