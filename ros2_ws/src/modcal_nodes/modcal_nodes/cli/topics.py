"""``--topic``, ``--ignore`` and ``--tf``: what a person says of the topics of a bag, on every verb that reads one."""

from __future__ import annotations

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
