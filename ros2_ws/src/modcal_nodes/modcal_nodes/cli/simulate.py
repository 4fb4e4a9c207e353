"""``modcal simulate``: a bag of the simulated cell, as fast as the machine makes it, with no node and no waiting."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.errors import BadTable
from modcal_core.files import parse_yaml
from modcal_core.planning import RETURNS
from modcal_core.robots import other_tips
from modcal_msgs_py import write_recording
from modcal_nodes.cli.console import Output, speaking
from modcal_nodes.cli.inputs import chain_line
from modcal_nodes.cli.options import EXISTING, WRITTEN, Decimal, Whole
from modcal_nodes.ros import SIMULATED_CELL
from modcal_nodes.simulation import Plant, recorded

_OF_THE_NODE = (
    "urdf",
    "delta",
    "obey_limits",
    "start_delay_s",
    "min_subscribers",
    "repeat",
    "publish_clock",
    "clock_rate_hz",
    "time_factor",
)
_STATIONS = 60


@click.command("simulate")
@click.argument("robot", type=EXISTING)
@click.option("--out", required=True, type=WRITTEN, help="Folder of the bag; must not exist.")
@click.option("-p", "given", multiple=True, metavar="NAME=VALUE", help="A parameter of simulated_cell. Repeatable.")
@click.option(
    "--at", "later", type=(Decimal(min=0.0), str), multiple=True, metavar="S NAME=VALUE",
    help="The same, from the given second on: payload_kg, tool_bump_m, tracker_move_m, warm_up_m … Repeatable.",
)  # fmt: skip
@click.option(
    "--returns", type=Whole(0, 1000), default=RETURNS,
    help="Number of these postures that are visited twice, so that the noise floor is known.",
)  # fmt: skip
@speaking
def simulate_command(
    robot: Path, out: Path, given: tuple[str, ...], later: tuple[tuple[float, str], ...], returns: int, output: Output
) -> None:
    """Record an arm (URDF) or a Delta (YAML) that differs from its nominal model, in MuJoCo, with a tracker.

    The arm visits 60 random postures (-p stations=N), six of them twice, no faster than the URDF's velocity and effort
    allow. Unmodelled effects are switched on with
    -p: gear_joint, joint_compliance_rad_per_nm, payload_kg, warm_up_link, repeatability_rad and others
    of the node.
    """
    if out.exists():
        raise BadTable(str(out), "exists", "name another folder")
    chosen = {name: parameter.default for name, parameter in SIMULATED_CELL.items()}
    chosen["stations"], chosen["returns"], chosen["obey_limits"] = _STATIONS, returns, True
    chosen["delta" if robot.suffix in (".yaml", ".yml") else "urdf"] = str(robot)
    for text in given:
        name, value = parameter(text)
        chosen[name] = value
    changes = sorted(((when, *parameter(text)) for when, text in later), key=lambda change: change[0])
    with output.working() as watch:
        watch("building the cell")
        plant = Plant(chosen)
        recording = recorded(plant, chosen, changes, watch)
        write_recording(recording, out, partial(watch, f"writing {out.name}"))
    data = {
        "bag": str(out),
        "stations": plant.stops,
        "duration_s": plant.end,
        "joint_states": len(recording.joints[0].stamps),
        "readings": len(recording.readings[0].stamps),
        "overloads": list(plant.overloads),
    }
    counts = f"{data['joint_states']} joint states, {data['readings']} readings"
    chain = plant.chain
    others = () if chosen["delta"] or chosen["tip"] else other_tips(plant.text, chain.base)
    arm = chain_line(chain.base, chain.tip, chain.n, others)
    lines = [arm, *plant.overloads, f"Bag: {out}, {plant.stops} stations in {plant.end:.0f} s, {counts}"]
    output.result(data, lines)


def parameter(text: str) -> tuple[str, Any]:
    """Name and value of NAME=VALUE, of the type and within the bounds of the node's parameter."""
    name, equals, written = text.partition("=")
    if not equals or name not in SIMULATED_CELL or name in _OF_THE_NODE:
        names = ", ".join(n for n in SIMULATED_CELL if n not in _OF_THE_NODE)
        raise BadTable(f"-p {text}", "is not a NAME=VALUE of the simulated cell", f"names are {names}")
    parameter = SIMULATED_CELL[name]
    kind, value = type(parameter.default), parse_yaml(written, f"-p {name}")
    try:
        if kind is list:
            value = [float(item) for item in (value if isinstance(value, list) else [value])]
        elif kind is float and not isinstance(value, bool):
            value = float(value)
        fits = type(value) is kind and (kind in (str, bool) or bool(np.isfinite(value).all()))
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise BadTable(f"-p {text}", f"is no {'list of numbers' if kind is list else kind.__name__}", "write one")
    low, high = parameter.low, parameter.high
    if low is not None and high is not None and not low <= value <= high:
        raise BadTable(f"-p {text}", f"{low:g} to {high:g} is allowed", "choose a value between")
    return name, value
