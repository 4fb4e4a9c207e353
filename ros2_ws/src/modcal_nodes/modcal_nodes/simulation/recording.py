"""Everything a simulated cell says, as a recording, as fast as the machine makes it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3
from modcal_core.measurements import POINT, POSE, JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_nodes.io import Watch, silent
from modcal_nodes.simulation.plant import SWITCHES, TRACKER, TRACKER_PHASE, Grid, Plant

_TEMPERATURE_RATE = 1.0  # Hz
_MANY = 100  # moments between two words of how far it is


def recorded(
    plant: Plant, chosen: dict[str, Any], changes: list[tuple[float, str, Any]], watch: Watch = silent
) -> Recording:
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
        for i, t in enumerate(grids[0].take(stop)):
            if i % _MANY == 0:
                watch("moving the arm", t / plant.end)
            q, v, effort = plant.joints(t)
            joints.append((t, np.r_[q, v, np.full_like(q, np.nan) if effort is None else effort]))
        for i, t in enumerate(grids[1].take(stop)):
            if i % _MANY == 0:
                watch("reading the tracker", t / plant.end)
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
    at = f"--at {when:g} {name}"
    if name not in SWITCHES:
        raise BadTable(at, "cannot change in time", f"use one of {', '.join(SWITCHES)}, or -p")
    if when >= plant.end:
        raise BadTable(at, f"the last posture is reached at {plant.end:.0f} s", "change it earlier")
    if (reason := plant.switches.refusal({name: value})) is not None:
        raise BadTable(at, reason, "set another value")
    plant.switches.set(name, value, when)
