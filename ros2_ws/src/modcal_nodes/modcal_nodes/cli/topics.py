"""``--topic``, ``--ignore`` and ``--tf``: what a person says of the topics of a bag, on every verb that reads one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

TOPICS = (
    click.option(
        "--topic", "topic", multiple=True, metavar="ROLE=NAME",
        help="The topic for a role, e.g. tracker/pose=/vrpn/tool/pose. Repeatable.",
    ),
    click.option("--ignore", "ignore", multiple=True, metavar="TOPIC", help="Leave a topic out. Repeatable."),
    click.option(
        "--tf", "tf", metavar="PARENT:CHILD",
        help="The tracker's readings are these frames in /tf, e.g. tracker:tool.",
    ),
)  # fmt: skip


def topic_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with these options; it is handed ``topic``, ``ignore`` and ``tf``."""
    for option in reversed(TOPICS):
        command = option(command)
    return command
