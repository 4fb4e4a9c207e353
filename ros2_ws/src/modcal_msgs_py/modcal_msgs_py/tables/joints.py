"""The joints' columns of a table: positions, and velocity, effort and commanded positions where it has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import JointTrack
from modcal_msgs_py.tables.table import Table

UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "gon": np.pi / 200.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
SPEEDS = {f"{unit}/s": scale for unit, scale in UNITS.items()}
EFFORTS = {"N m": 1.0, "N": 1.0, "N mm": 1e-3, "kN m": 1e3}
COMMANDS = "/joint_commands"


def joints_of(table: Table, joints: Mapping[str, Any], stamps: Array) -> tuple[JointTrack, JointTrack | None]:
    """Joint states of a table, and the commanded positions if it has any; rows that lack one are left out."""
    names = tuple(joints["columns"])
    position = _scaled(table, joints, UNITS, names)
    velocity = _beside(table, joints, "velocity", SPEEDS, names)
    effort = _beside(table, joints, "effort", EFFORTS, names)
    if joints.get("effort", {}).get("of_load"):
        effort = -effort
    keep = np.isfinite(stamps) & table.present(list(joints["columns"].values()))
    track = JointTrack(names, stamps, position, velocity, effort, stamps)
    if "commanded" not in joints:
        return _rows(track, keep), None
    wanted = joints["commanded"]
    known = tuple(wanted["columns"])
    position = _scaled(table, {"unit": joints["unit"], **wanted}, UNITS, known)
    unknown = np.full_like(position, np.nan)
    sent = np.isfinite(stamps) & np.isfinite(position).all(axis=1)
    return _rows(track, keep), _rows(JointTrack(known, stamps, position, unknown, unknown, stamps, COMMANDS), sent)


def merged(tracks: list[JointTrack]) -> JointTrack | None:
    """One track of several with the same joints; None for none. Raises BadTable where they are not the same."""
    if not tracks:
        return None
    names = tracks[0].names
    if any(track.names != names for track in tracks):
        raise BadTable("tables", "have different joints", "import them into bags of their own")
    columns: dict[str, Any] = {
        what: np.concatenate([getattr(t, what) for t in tracks])
        for what in ("stamps", "position", "velocity", "effort", "received")
    }
    return replace(tracks[0], **columns)


def _scaled(table: Table, part: Mapping[str, Any], units: Mapping[str, float], names: tuple[str, ...]) -> Array:
    own = part.get("units") or {}
    scale = np.array([units[own.get(name, part["unit"])] for name in names])
    return scale * table.numbers([part["columns"][name] for name in names])


def _beside(
    table: Table, joints: Mapping[str, Any], what: str, units: Mapping[str, float], names: tuple[str, ...]
) -> Array:
    """A quantity of the joints (N, n), NaN where it is not stated."""
    out = np.full((len(table), len(names)), np.nan)
    if what in joints:
        part = {"unit": "N m", **joints[what]}
        known = tuple(name for name in names if name in part["columns"])
        out[:, [names.index(name) for name in known]] = _scaled(table, part, units, known)
    return out


def _rows(track: JointTrack, keep: np.ndarray) -> JointTrack:
    columns = {what: getattr(track, what)[keep] for what in ("stamps", "position", "velocity", "effort", "received")}
    return replace(track, **columns)
