"""``modcal watch``, ``modcal call`` and ``modcal play``: the nodes of a cell from a shell that has no ``ros2``."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import click
from rclpy.action import ActionClient
from rclpy.action.graph import get_action_server_names_and_types_by_node
from rclpy.duration import Duration
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from rich.console import Console
from rich.live import Live
from rosgraph_msgs.msg import Clock

from modcal_core.errors import BadCommand, BadRecording, BadTable, plain
from modcal_core.files import parse_yaml, to_yaml
from modcal_core.report import Summary, SummaryLine, TableBlock
from modcal_msgs_py import (
    OfferedTopic,
    PackedMessage,
    fill_message,
    message_data,
    messages_in_order,
    offered_topics,
    set_nanoseconds,
)
from modcal_nodes.cli.console import EXISTING, UNMET, Decimal, Output, Terminal, Whole, speaks
from modcal_nodes.ros import MUTUAL, interrupt, joined, passing, stopped_by, type_of
from modcal_nodes.watching import Changes, Heard, Listener, table

_PATIENCE = 8.0  # s without a word after which it says what to check
_ENOUGH = 2.5  # s: every node speaks once a second, and what it latched comes with it
_SPIN = 0.05  # s
_FOLLOW = 0.3  # s between two looks for what the nodes that were heard publish


@click.command("watch")
@click.option("--once", is_flag=True, help="Print one snapshot and exit.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line, for machines.")
@click.option(
    "--domain",
    type=Whole(0, 232),
    default=0,
    envvar="ROS_DOMAIN_ID",
    show_default=False,
    help="Default: ROS_DOMAIN_ID.",
)
@click.option("--namespace", default="", show_default=False, metavar="NAME", help="Only nodes below this namespace.")
@click.option(
    "--for",
    "lasting",
    type=Decimal(0.1),
    metavar="SECONDS",
    help="End after this time; with --once: collect messages for this time.",
)
@click.option("--every", type=Decimal(0.1, 60.0), default=1.0, help="Seconds between updates.")
def watch_command(once: bool, as_json: bool, domain: int, namespace: str, lasting: float | None, every: float) -> None:
    """Show the status of all nodes of a cell, live.

    Inputs and warnings of every node, which model is trusted, how large its error is and was, suspected
    changes, how old corrected poses are, what the gripper moves, what is recorded. Where the output is not a
    terminal, a line is written only when something gets better or worse. Ctrl-C ends it.
    """
    heard, console = Heard(namespace), Terminal(markup=False)
    with (
        contextlib.suppress(KeyboardInterrupt),
        _left_alone(),
        stopped_by(interrupt),
        _listening(heard, domain) as spin,
    ):
        if not once:
            _go_on(heard, spin, _output(as_json, console), lasting, every, (domain, namespace))
            return
        end = time.monotonic() + (lasting or _PATIENCE)
        while time.monotonic() < end and (lasting or not heard.names):
            spin(_FOLLOW)
        if heard.names:
            spin(0.0 if lasting else _ENOUGH)
            snapshot = heard.snapshot(time.monotonic())
            if as_json:
                _print_json(snapshot)
            else:
                console.print(table(snapshot))
    if once and not heard.names:
        raise BadRecording(*_nothing(domain, namespace, lasting or _PATIENCE))


def _go_on(
    heard: Heard,
    spin: Callable[[float], None],
    output: contextlib.AbstractContextManager[Callable[[dict[str, Any]], None]],
    lasting: float | None,
    every: float,
    where: tuple[int, str],
) -> None:
    """Show a snapshot every so often [s], until the time is over or somebody stops it. where: domain, namespace."""
    begun = time.monotonic()
    warned = False
    with output as show:
        while lasting is None or time.monotonic() - begun < lasting:
            spin(every)
            if heard.names:
                show(heard.snapshot(time.monotonic()))
            elif not warned and time.monotonic() - begun > _PATIENCE:
                warned = True
                click.echo("modcal: " + ": ".join(_nothing(*where, _PATIENCE)), err=True)


def _nothing(domain: int, namespace: str, seconds: float) -> tuple[str, str, str]:
    where = f"/diagnostics of domain {domain}" + (f" below /{namespace.strip('/')}" if namespace else "")
    return (
        where,
        f"no message from a modcal node in {seconds:g} s",
        "start one, or check that --domain, --namespace and ROS_AUTOMATIC_DISCOVERY_RANGE are those of the cell",
    )


@contextlib.contextmanager
def _listening(heard: Heard, domain: int) -> Iterator[Callable[[float], None]]:
    """A node in this domain, and a function that lets it listen for so many seconds."""
    with joined(partial(Listener, heard), domain) as (node, turn):

        def spin(seconds: float) -> None:
            end = time.monotonic() + seconds
            due = 0.0
            while (left := end - time.monotonic()) > 0.0:
                if time.monotonic() >= due:
                    due = time.monotonic() + _FOLLOW
                    node.follow()
                turn(min(left, _SPIN))

        yield spin


@contextlib.contextmanager
def _left_alone() -> Iterator[None]:
    """Whoever reads the other end of the pipe may go when it has enough (``| head -1``)."""
    try:
        yield
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is flushed at exit goes nowhere


@contextlib.contextmanager
def _output(as_json: bool, console: Console) -> Iterator[Callable[[dict[str, Any]], None]]:
    """What to do with each snapshot: JSON, a table that changes in place, or, in a pipe, lines of what changes."""
    if as_json:
        yield _print_json
    elif console.is_terminal:
        last: list[dict[str, Any]] = []
        with Live(console=console, screen=True, auto_refresh=False, vertical_overflow="crop") as live:

            def show(snapshot: dict[str, Any]) -> None:
                last[:] = [snapshot]
                live.update(table(snapshot), refresh=True)

            try:
                yield show
            finally:
                live.stop()
                if last:
                    console.print(table(last[0]))  # what was seen last stays
    else:
        changes = Changes()

        def log(snapshot: dict[str, Any]) -> None:
            for line in changes.lines(snapshot):
                click.echo(plain(line))

        yield log


def _print_json(snapshot: dict[str, Any]) -> None:
    click.echo(json.dumps({"time_s": round(time.time(), 3), **snapshot}, allow_nan=False))


_KNOWN = 2.0  # s without news of what a node offers, after which all of it is known
_GONE = 5.0  # s without the server, after which no answer will come
_TOLD = 2.0  # s between two lines of feedback in which only numbers have changed
_SAID = ("outcome", "message", "success")  # of a result, in the first line


@click.command("call")
@click.argument("node")
@click.argument("name", metavar="SERVICE|ACTION")
@click.option("--goal", "written", default="{}", metavar="YAML", help="Fields of the goal, or of the request.")
@click.option("--patience", type=Decimal(0.1), default=10.0, metavar="S", help="Time in which NODE must be found.")
@speaks()
def call_command(node: str, name: str, written: str, patience: float, output: Output) -> int:
    """Call a service or an action of a running NODE, and print the answer.

    A name that is both is taken for the action. Its feedback is printed on stderr, and Ctrl-C cancels the goal. Exit
    code 0: done; 3: refused, cancelled or failed; 2: there is no such node or name, or the goal does not fit its type.
    """
    fields = parse_yaml(written, "--goal") or {}
    with joined(passing) as (here, turn), stopped_by(interrupt):
        full, type_name = _found(here, turn, f"/{node.strip('/')}", name.removeprefix("~/"), patience)
        if (kind := type_of(type_name)) is None:
            remedy = "source the workspace that has it; in a clone run make build"
            raise BadCommand(full, f"its type {type_name} is not installed here", remedy)
        if "/srv/" in type_name:
            service, request = here.create_client(kind, full), fill_message(kind.Request(), fields, "--goal")
            result = _Server(turn, full, service.service_is_ready).answer(service.call_async(request))
            parts = [result, *getattr(result, "results", ()), getattr(result, "result", None)]  # of many; of one
            done = all(getattr(part, yes, True) for part in parts for yes in ("success", "successful"))
        else:
            action, goal = ActionClient(here, kind, full), fill_message(kind.Goal(), fields, "--goal")
            result, done = _performed(action, _Server(turn, full, action.server_is_ready), goal)
    names = {value: key for key, value in vars(type(result)).items() if isinstance(value, int) and "__" not in key}
    outcome = names.get(getattr(result, "outcome", -1))
    data = {"modcal_call": 1, "name": full, "type": type_name, "done": done, "outcome": outcome}
    said = ": ".join(filter(None, [outcome, getattr(result, "message", "")])) or ("done" if done else "refused")
    shown: list[str | Summary] = [SummaryLine(said, "good" if done else "bad")]
    if rest := {key: value for key, value in _news(result).items() if key not in _SAID}:
        shown.append(to_yaml(rest).rstrip())
    output.result({**data, "result": message_data(result)}, shown)
    return 0 if done else UNMET


def _found(here: Node, turn: Callable[[float], None], node: str, name: str, patience: float) -> tuple[str, str]:
    """Full name and type of what a node is asked for. Raises BadCommand where it is not there.

    Discovery tells of services and actions in any order, so a service is taken only when no action can follow.
    """
    space, _, leaf = node.rpartition("/")
    offered: dict[str, str] = {}
    end = time.monotonic() + patience
    while time.monotonic() < end and "/action/" not in offered.get(name, ""):
        turn(_SPIN)
        with suppress(NodeNameNonExistentError):
            found = here.get_service_names_and_types_by_node(leaf, space or "/")
            found += get_action_server_names_and_types_by_node(here, leaf, space or "/")
            if (now := {each.removeprefix(f"{node}/"): types[0] for each, types in found}) != offered:
                offered, end = now, time.monotonic() + _KNOWN
    if name in offered:
        return name if name.startswith("/") else f"{node}/{name}", offered[name]
    if offered:
        own = [each for each, kind in offered.items() if "/" not in each and not kind.startswith("rcl_interfaces")]
        raise BadCommand(f"{node}/{name}", "is neither a service nor an action", f"there are {', '.join(sorted(own))}")
    nodes = sorted(f"{where.rstrip('/')}/{one}" for one, where in here.get_node_names_and_namespaces())
    there = ", ".join(one for one in nodes if one != here.get_fully_qualified_name()) or "none: see ROS_DOMAIN_ID"
    raise BadCommand(node, f"no such node was found in {patience:g} s", f"there are {there}")


class _Server:
    """Who answers, as long as it is there."""

    def __init__(self, turn: Callable[[float], None], name: str, ready: Callable[[], bool]) -> None:
        """Wait for the server to be found, and to have found this node."""
        self.name, self._spin, self._ready, self._seen = name, turn, ready, time.monotonic()
        while not ready():
            self._turn()
        end = time.monotonic() + MUTUAL
        while time.monotonic() < end:
            self._turn()

    def _turn(self) -> None:
        self._spin(_SPIN)
        if self._ready():
            self._seen = time.monotonic()
        elif time.monotonic() > self._seen + _GONE:
            raise BadCommand(self.name, "its node has ended", "look at its log, and start it again")

    def answer(self, future: Future, meanwhile: Callable[[], None] = lambda: None) -> Any:
        """The result of a future. meanwhile: called at every turn. Raises BadCommand where none will come."""
        while not future.done():
            self._turn()
            meanwhile()
        return future.result()


def _performed(client: ActionClient, server: _Server, goal: Any) -> tuple[Any, bool]:
    """The result of an action, and whether it succeeded."""
    asked: list[bool] = []  # for an end; whether that was passed on
    last: tuple[float, Any] = (0.0, None)  # feedback: when, and texts in it

    def stop() -> None:
        if asked:
            interrupt()
        asked.append(False)

    def tell(message: Any) -> None:
        nonlocal last
        data, now = _news(message.feedback), time.monotonic()
        texts = [value for value in data.values() if isinstance(value, str | bool)]
        if texts != last[1] or now > last[0] + _TOLD:
            last = now, texts
            click.echo(plain(", ".join(f"{key} {value}" for key, value in data.items())), err=True)

    def cancel() -> None:
        if asked == [False]:
            asked[0] = True
            click.echo("modcal: cancelling; Ctrl-C again leaves at once", err=True)
            handle.cancel_goal_async()

    with stopped_by(stop):
        handle = server.answer(client.send_goal_async(goal, feedback_callback=tell))
        if not handle.accepted:
            raise BadCommand(server.name, "the goal is not accepted", "look at the node's log")
        ended = server.answer(handle.get_result_async(), cancel)
    from action_msgs.msg import GoalStatus  # not before rclpy is known to be there

    return ended.result, ended.status == GoalStatus.STATUS_SUCCEEDED


def _news(message: Any) -> dict[str, Any]:
    """The fields of a message in which it says more than an empty one, numbers with six digits."""

    def brief(value: Any, empty: Any) -> Any:
        if isinstance(value, dict):
            return {k: brief(v, empty and empty[k]) for k, v in value.items() if not empty or v not in (None, empty[k])}
        if isinstance(value, list):
            return [brief(one, None) for one in value]
        return float(f"{value:.6g}") if isinstance(value, float) else value

    return dict(brief(message_data(message), message_data(type(message)())))


_CLOCK = "/clock"
_DEPTH = 1000  # of what is not latched: a burst must not overwrite what a listener has not yet heard
_LISTENERS, _SETTLE = 5.0, 1.0  # s until the first listener is found at the latest, and from then on for the others
_ACKNOWLEDGED = 5.0  # s in which the last messages must have arrived


@click.command("play")
@click.argument("bag", type=EXISTING)
@click.option("--clock", type=Decimal(0.1, 1e4), metavar="HZ", help="Publish /clock, for nodes with use_sim_time.")
@click.option("--rate", type=Decimal(1e-3, 1e3), default=1.0, help="How many times as fast as it was recorded.")
@click.option("--start", type=Decimal(0.0), default=0.0, metavar="S", help="Begin there; what is latched is kept.")
@click.option("--topics", "chosen", multiple=True, metavar="TOPIC", help="Only this topic. Repeatable.")
@click.option("--remap", "remaps", multiple=True, metavar="A:=B", help="Publish topic A as B. Repeatable.")
@speaks()
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
