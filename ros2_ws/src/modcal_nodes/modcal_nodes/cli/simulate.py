"""``modcal simulate``: a bag of the simulated cell, as fast as the machine makes it, with no node and no waiting."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POINT, POSE, JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.parameters import SIMULATED_CELL, Parameter
from modcal_nodes.simulation.pace import Grid
from modcal_nodes.simulation.plant import TRACKER_PHASE, Plant
from modcal_nodes.simulation.spoken import TRACKER
from modcal_nodes.simulation.switches import SWITCHES

_EXISTING = click.Path(exists=True, path_type=Path)
_OF_THE_NODE = ("urdf", "delta", "start_delay_s", "repeat", "publish_clock", "clock_rate_hz", "time_factor")
_STATIONS = 60
_TEMPERATURE_RATE = 1.0  # Hz


@click.command("simulate")
@click.argument("robot", type=_EXISTING)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder of the bag; must not exist.")
@click.option("-p", "given", multiple=True, metavar="NAME=VALUE", help="A parameter of simulated_cell. Repeatable.")
@click.option(
    "--at", "later", type=(click.FloatRange(min=0.0), str), multiple=True, metavar="S NAME=VALUE",
    help="The same, from so many seconds on: payload_kg, tool_bump_m, tracker_move_m, warm_up_m … Repeatable.",
)  # fmt: skip
def simulate_command(robot: Path, out: Path, given: tuple[str, ...], later: tuple[tuple[float, str], ...]) -> None:
    """Record an arm (URDF) or a Delta (YAML) that is not as drawn, in MuJoCo, with a tracker that looks at it.

    It visits 60 random postures (-p stations=N). What else it does that its model lacks is said with -p:
    gear_joint, joint_compliance_rad_per_nm, payload_kg, warm_up_link, repeatability_rad and others of the node.
    """
    if out.exists():
        raise BadTable(str(out), "exists", "name another folder")
    chosen = {name: parameter.default for name, parameter in SIMULATED_CELL.items()}
    chosen["stations"] = _STATIONS
    chosen["delta" if robot.suffix in (".yaml", ".yml") else "urdf"] = str(robot)
    for text in given:
        name, value = _parameter(text)
        chosen[name] = value
    plant = Plant(chosen)
    changes = sorted(((when, *_parameter(text)) for when, text in later), key=lambda change: change[0])
    recording = recorded(plant, chosen, changes)
    write_recording(recording, out)
    counts = f"{len(recording.joints[0].stamps)} joint states, {len(recording.readings[0].stamps)} readings"
    click.echo(f"{out}: {chosen['stations']} stations in {plant.end:.0f} s, {counts}")


def recorded(plant: Plant, chosen: dict[str, Any], changes: list[tuple[float, str, Any]]) -> Recording:
    """Everything the cell says until its last posture. changes: (seconds, switch, value), in order.

    Raises BadTable for a change that cannot be.
    """
    fast, slow = chosen["joint_rate_hz"], chosen["tracker_rate_hz"]
    grids = (Grid(fast), Grid(slow, TRACKER_PHASE * slow / fast), Grid(_TEMPERATURE_RATE))
    joints: list[tuple[float, Array]] = []
    readings: list[tuple[float, Array]] = []
    felt: dict[str, list[tuple[float, float]]] = {}
    for until, change in [*((when, (when, name, value)) for when, name, value in changes), (math.inf, None)]:
        stop = min(until, plant.end)
        for t in grids[0].take(stop):
            q, v, effort = plant.joints(t)
            joints.append((t, np.r_[q, v, np.full_like(q, np.nan) if effort is None else effort]))
        for t in grids[1].take(stop):
            readings.append((t, plant.read(plant.tool(t))))
        for t in grids[2].take(stop):
            if (warm := plant.temperature(t)) is not None:
                felt.setdefault(warm[0], []).append((t, warm[1]))
        if change is not None:
            _switch(plant, *change)
    first = chosen["clock_start_s"]
    t, columns = first + np.array([x for x, _ in joints]), np.array([c for _, c in joints])
    position, velocity, effort = np.split(columns, 3, axis=1)
    s = first + np.array([x for x, _ in readings])
    poses = se3.to_pose(np.array([T for _, T in readings]))
    points = chosen["measurement"] == POINT
    return Recording(
        (JointTrack(plant.chain.names, t, position, velocity, effort, t),),
        (ReadingTrack(POINT if points else POSE, TRACKER, s, poses[:, :3] if points else poses, s),),
        tuple(
            SignalTrack(f"temperature:{link}", first + np.array(rows)[:, 0], np.array(rows)[:, 1:])
            for link, rows in felt.items()
        ),
        plant.text or None,
    )


def _switch(plant: Plant, when: float, name: str, value: Any) -> None:
    if name not in SWITCHES:
        raise BadTable(f"--at {when:g} {name}", "cannot change in time", f"use one of {', '.join(SWITCHES)}, or -p")
    if when >= plant.end:
        raise BadTable(
            f"--at {when:g} {name}", f"the last posture is reached at {plant.end:.0f} s", "change it earlier"
        )
    if (reason := plant.switches.refusal({name: value})) is not None:
        raise BadTable(f"--at {when:g} {name}", reason, "set another value")
    plant.switches.set(name, value, when)


def _parameter(text: str) -> tuple[str, Any]:
    """Name and value of NAME=VALUE, of the type and within the bounds of the node's parameter."""
    name, equals, written = text.partition("=")
    if not equals or name not in SIMULATED_CELL or name in _OF_THE_NODE:
        names = ", ".join(n for n in SIMULATED_CELL if n not in _OF_THE_NODE)
        raise BadTable(f"-p {text}", "is no NAME=VALUE of the simulated cell", f"names are {names}")
    parameter = SIMULATED_CELL[name]
    value = _typed(yaml.safe_load(written), parameter)
    if value is None:
        wanted = type(parameter.default).__name__
        raise BadTable(f"-p {text}", f"is no {'list of numbers' if wanted == 'list' else wanted}", "write one")
    low, high = parameter.low, parameter.high
    if low is not None and high is not None and not low <= value <= high:
        raise BadTable(f"-p {text}", f"{low:g} to {high:g} is allowed", "choose a value between")
    return name, value


def _typed(value: Any, parameter: Parameter) -> Any:
    """The value as the type that the parameter has, None where it is of another."""
    kind = type(parameter.default)
    if kind is list:
        items = value if isinstance(value, list) else [value]
        numbers = [_number(item) for item in items]
        return None if None in numbers else numbers
    if kind is float:
        return _number(value)
    return value if type(value) is kind else None


def _number(value: Any) -> float | None:
    """A finite number; YAML takes 1e-6 for a text."""
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None
