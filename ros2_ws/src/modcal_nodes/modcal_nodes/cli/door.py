"""``modcal door``: a simulated door opened from start to end, by the same nodes that open a real one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import click

from modcal_core.errors import BadCommand
from modcal_nodes.cli.console import Output, speaking, written
from modcal_nodes.cli.options import WRITTEN, Decimal, Whole

_NODE, _LOG, _RESULT = "door_demo", "nodes.log", "pull.json"
_DOMAINS = 100  # of them every system has ports for; 0 is the one that robots usually speak in


@click.command("door")
@click.option("--kind", type=click.Choice(["door", "drawer"]), default="door", help="What to open.")
@click.option("--seed", type=Whole(0, 2**31 - 1), default=0, help="Seed of the object, its place and the noise.")
@click.option(
    "--patience", type=Decimal(5.0, 3600.0), default=90.0, metavar="S", help="Time after which it is given up."
)
@click.option("--domain", type=Whole(0, 232), help="ROS_DOMAIN_ID of the nodes. Default: one of its own.")
@click.option("--out", type=WRITTEN, help="Folder of the results. Default: KIND_demo.")
@speaking
def door_command(kind: str, seed: int, patience: float, domain: int | None, out: Path | None, output: Output) -> None:
    """Open a simulated door or drawer from start to end, and report what was learned of it.

    Starts an arm and an object in MuJoCo, articulation_estimator and impedance_setpoint, in a ROS domain of their own,
    and pulls. The nodes are told the direction of the first pull only. Takes about half a minute. Exit code 0: it is
    open; 2: it is not, and one line says why.
    """
    out = out or Path(f"{kind}_demo")
    chosen = 1 + os.getpid() % _DOMAINS if domain is None else domain
    program = _program()
    parameters = {"kind": kind, "seed": seed, "patience_s": patience, "out": str(out.resolve())}
    out.mkdir(parents=True, exist_ok=True)
    (out / _RESULT).unlink(missing_ok=True)
    with output.working() as watch:
        watch(f"opening a {kind}; ROS_DOMAIN_ID={chosen} modcal watch shows the nodes")
        code = _opened(program, parameters, chosen, out / _LOG)
    if code or not (out / _RESULT).is_file():
        raise BadCommand(f"{kind} {seed}", _last_word(out / _LOG), f"see {out / _LOG}, or give another --seed")
    data = json.loads((out / _RESULT).read_text(encoding="utf-8"))
    names = [_LOG, _RESULT, *data["files"]]
    output.result(data, data["sentences"], written(out, names))


def _program() -> Path:
    """The executable of the demonstration. Raises ModcalError where it, or what it speaks, is not installed."""
    from ament_index_python.packages import get_package_prefix  # only where ROS is

    from modcal_nodes.ros import interface

    interface("Pull")
    try:
        return Path(get_package_prefix("modcal_nodes"), "lib", "modcal_nodes", _NODE)
    except (LookupError, OSError) as error:
        raise BadCommand("package modcal_nodes", "is not installed for ROS", "source install/setup.bash") from error


def _opened(program: Path, parameters: dict[str, Any], domain: int, log: Path) -> int:
    """The exit code of the demonstration, whose nodes write to a log."""
    given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    # whatever robot listens in this network must not be told to move
    alone = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(domain)}
    with log.open("wb") as stream:
        child = subprocess.Popen(
            [program, "--ros-args", *given], env={**os.environ, **alone}, stdout=stream, stderr=stream,
            start_new_session=True,
        )  # fmt: skip
        try:
            return child.wait()
        except BaseException:
            child.send_signal(signal.SIGINT)
            child.wait()
            raise


def _last_word(log: Path) -> str:
    """What the demonstration said in the end, in its one line for a refusal."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    refused = [line.removeprefix("modcal: ") for line in lines if line.startswith("modcal: ")]
    return refused[-1] if refused else "did not end as it should"
