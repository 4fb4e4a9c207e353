"""``modcal sentinel``: has the arm changed? From ordinary recordings, without an instrument."""

from __future__ import annotations

from pathlib import Path

import click

from modcal_core.errors import NotEnoughData
from modcal_core.report import sentinel_report
from modcal_nodes.cli.certificate import UNMET
from modcal_nodes.cli.console import Output, saving
from modcal_nodes.cli.options import EXISTING, given
from modcal_nodes.io import SentinelOptions, judge_arm


@click.command("sentinel")
@click.argument("bags", type=EXISTING, nargs=-1, required=True)
@given(SentinelOptions)
@saving("Folder of the results. Default: sentinel.")
def sentinel_command(bags: tuple[Path, ...], output: Output, options: SentinelOptions) -> int:
    """Say whether an arm has changed, from ordinary recordings BAGS of its work: joint states with efforts, commands
    (or a leader, --topic joint_commands=/leader/joint_states), a fixed tag seen by a camera on the hand, sockets.

    Recordings of a reference period (four at least, a minute each, of several days) show what is normal. Names joint
    zero, gear, play, friction, latency, servo, payload, camera; exit code 3 on a change. Data sets of LeRobot are read.
    """
    if not options.reference and options.history is None:
        raise NotEnoughData("sentinel", "knows of no reference period", "give --reference BAG …, or --history FOLDER")
    with output.working() as watch:
        found, name = judge_arm(bags, options, watch)
    output.saved(sentinel_report(found, name), "sentinel")
    return 0 if found.status == "unchanged" else UNMET
