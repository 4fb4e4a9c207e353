"""A session as plain data, in SI units: what its file keeps of it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POINT, POSE
from modcal_core.measurements.schema import require
from modcal_core.measuring.goal import Goal
from modcal_core.measuring.session import (
    DECIDE,
    FIT,
    MEASURED,
    PLANNED,
    PROOF,
    RETURN,
    SKIPPED,
    UNSEEN,
    Look,
    Session,
    Station,
)

FORMAT = 1  # of the file
_NUMBERS = {"type": ["array", "null"], "items": {"type": "number"}}
_SCHEMA = {
    "type": "object",
    "required": ["modcal_measure", "robot", "joints", "reading", "goal", "seed", "stations", "looks"],
    "properties": {
        "modcal_measure": {"enum": [FORMAT]},
        "robot": {"type": "string"},
        "joints": {"type": "array", "items": {"type": "string"}, "minItems": 1},
        "reading": {"enum": [POINT, POSE]},
        "on_tool": {"type": "boolean"},
        "seed": {"type": "integer", "minimum": 0},
        "began": {"type": ["number", "null"]},
        "goal": {"type": "object"},
        "looks": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["fitted", "expected", "axes"],
                "properties": {
                    "fitted": {"type": "integer", "minimum": 1},
                    "expected": {"type": "number", "exclusiveMinimum": 0},
                    "axes": {"type": "number", "minimum": 1, "maximum": 2},
                },
            },
        },
        "stations": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["role", "state", "asked"],
                "properties": {
                    "role": {"enum": [FIT, RETURN, DECIDE, PROOF]},
                    "state": {"enum": [PLANNED, MEASURED, UNSEEN, SKIPPED]},
                    "asked": {"type": "array", "items": {"type": "number"}},
                    "q": _NUMBERS,
                    "reading": _NUMBERS,
                    "approach": _NUMBERS,
                    "effort": _NUMBERS,
                    "stamp": {"type": ["number", "null"]},
                    "sigma": {"type": ["number", "null"], "minimum": 0},
                    "row": {"type": "integer"},
                },
            },
        },
    },
}
_REMEDY = "give the session.yaml that modcal measure wrote, or another folder"


def to_data(session: Session, goal: Goal, seed: int, robot: str, began: float | None) -> dict[str, Any]:
    """Everything of a session, in nested dictionaries and lists. robot: fingerprint. began: [s]."""
    return {
        "modcal_measure": FORMAT,
        "robot": robot,
        "joints": list(session.names),
        "reading": session.kind,
        **({"on_tool": True} if session.carried else {}),
        "seed": seed,
        "began": began,
        "goal": asdict(goal),
        "looks": [asdict(look) for look in session.looks],
        "stations": [_station_data(s) for s in session.stations],
    }


def _station_data(s: Station) -> dict[str, Any]:
    out: dict[str, Any] = {"role": s.role, "state": s.state, "asked": _list(s.asked)}
    for name in ("q", "reading", "approach", "effort"):
        value = getattr(s, name)
        if value is not None and np.isfinite(value).all():
            out[name] = _list(value)
    for name in ("stamp", "sigma"):
        if np.isfinite(value := getattr(s, name)):
            out[name] = float(value)
    if s.row >= 0:
        out["row"] = s.row
    return out


def _list(values: Array) -> list[float]:
    return [float(v) for v in values]


@refusing
def from_data(data: Any, source: str) -> tuple[Session, Goal, int, str, float | None]:
    """Session, goal, seed, fingerprint and beginning of what :func:`to_data` made. Raises BadTable."""
    require(data, _SCHEMA, source, _REMEDY)
    names = tuple(str(name) for name in data["joints"])
    stations = []
    for i, row in enumerate(data["stations"]):
        wide = {key: row.get(key) for key in ("asked", "q", "approach", "effort")}
        vectors = {k: None if v is None else np.array(v, dtype=float) for k, v in wide.items()}
        if any(v is not None and v.shape != (len(names),) for v in vectors.values()):
            raise BadTable(f"{source}, station {i + 1}", f"does not have {len(names)} joints", _REMEDY)
        reading = None if row.get("reading") is None else np.array(row["reading"], dtype=float)
        size = 7 if data["reading"] == POSE else 3
        if (row["state"] == MEASURED) != (reading is not None) or (reading is not None and reading.shape != (size,)):
            raise BadTable(f"{source}, station {i + 1}", f"is {row['state']} and has {reading} as reading", _REMEDY)
        asked = vectors.pop("asked")
        assert asked is not None
        stations.append(
            Station(
                asked,
                row["role"],
                row["state"],
                reading=reading,
                stamp=_or_nan(row.get("stamp")),
                sigma=_or_nan(row.get("sigma")),
                row=row.get("row", -1),
                **vectors,
            )
        )
    looks = tuple(Look(**look) for look in data["looks"])
    session = Session(names, data["reading"], tuple(stations), looks, data.get("on_tool", False))
    return session, Goal(**data["goal"]), data["seed"], data["robot"], data.get("began")


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else float(value)
