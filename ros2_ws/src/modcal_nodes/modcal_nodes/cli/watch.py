"""``modcal watch``: what the nodes of a cell report, in a terminal."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import click
from rich.console import Console
from rich.live import Live

from modcal_core.errors import BadRecording, plain
from modcal_nodes.cli.console import Terminal
from modcal_nodes.cli.options import Decimal, Whole
from modcal_nodes.ros import interrupt, joined, stopped_by
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
