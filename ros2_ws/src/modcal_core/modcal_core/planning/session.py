"""What has been measured so far: a list of stations that only grows, from which everything else follows.

A station is planned, then measured or not: the tracker may not see it, the arm may not reach it. Whoever measures adds
to the session and asks for advice; a session that is read from its file again goes on where it stopped.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import Array, so3
from modcal_core.measurements import APART, POINT, POSE, TRAVEL, Samples, require
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.planning.proof import Goal

FIT, RETURN, DECIDE, PROOF = "fit", "return", "decide", "proof"  # what a station is for
PLANNED, MEASURED, UNSEEN, SKIPPED = "planned", "measured", "unseen", "skipped"  # what became of it
FRAME = "tracker"


@dataclass(frozen=True)
class Station:
    """asked: the posture that was asked for (n,) [rad, m]. role: FIT, RETURN, DECIDE or PROOF. state: PLANNED,
    MEASURED, UNSEEN (the instrument saw nothing) or SKIPPED (the arm did not go there). q: where the joints stood
    (n,). reading: x y z [m], of a pose qx qy qz qw behind them. stamp: [s]; NaN where nobody knows. approach: the way
    in which each joint came, or is to come, −1, 0 (unknown) or 1, (n,). effort: (n,), NaN where unknown. sigma:
    scatter of the position per axis [m]; NaN where unknown. row: number of the recorded station, of a replay, or of
    what a return comes back to.
    """

    asked: Array
    role: str = FIT
    state: str = PLANNED
    q: Array | None = None
    reading: Array | None = None
    stamp: float = float("nan")
    approach: Array | None = None
    effort: Array | None = None
    sigma: float = float("nan")
    row: int = -1

    def measured(self, reading: Array, q: Array | None = None, **known: object) -> Station:
        """The station with what was read there."""
        stood = self.asked if q is None else q
        return replace(self, state=MEASURED, q=stood, reading=np.asarray(reading, dtype=float), **known)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Session:
    """names: of the joints, in the order of all postures. stations: in the order in which they were asked for.
    carried: the instrument is on the tool, and reads poses of a
    target that stands still.
    """

    names: tuple[str, ...]
    kind: str = POINT
    stations: tuple[Station, ...] = ()
    carried: bool = False

    @property
    def pending(self) -> tuple[int, ...]:
        """Numbers of the stations that are planned and not yet done."""
        return tuple(i for i, s in enumerate(self.stations) if s.state == PLANNED)

    def rows(self, *roles: str) -> list[int]:
        """Numbers of the measured stations of these roles; of all where none is named."""
        return [i for i, s in enumerate(self.stations) if s.state == MEASURED and (not roles or s.role in roles)]

    @property
    def fitted(self) -> list[int]:
        """Numbers of the measured stations that fits may see."""
        return self.rows(FIT, RETURN, DECIDE)

    def asking(self, stations: list[Station]) -> Session:
        """The session with further stations planned."""
        return replace(self, stations=(*self.stations, *stations))

    def with_station(self, number: int, station: Station) -> Session:
        """The session with what became of a station."""
        every = list(self.stations)
        every[number] = station
        return replace(self, stations=tuple(every))

    def samples(self, rows: list[int]) -> Samples:
        """The measured stations with these numbers, as samples, in the order in which they were measured.

        Also of an instrument on the tool they say where the tool is in a frame that stands still.
        """
        stations, N, n = [self.stations[i] for i in rows], len(rows), len(self.names)
        reading = np.array([s.reading for s in stations], dtype=float).reshape(N, -1)
        stamps = np.array([s.stamp for s in stations])
        clock = bool(np.isfinite(stamps).all()) and N > 0
        p, R = reading[:, :3], np.tile(np.eye(3), (N, 1, 1))
        R = so3.from_quaternion(reading[:, 3:]) if self.kind == POSE else R
        if self.carried:
            R = R.transpose(0, 2, 1)
            p = -np.einsum("nij,nj->ni", R, p)
        return Samples(
            names=self.names,
            frames=(FRAME,),
            q=np.array([s.q for s in stations], dtype=float).reshape(N, n),
            stamps=stamps if clock else APART * np.array(rows, dtype=float),
            station=np.array(rows, dtype=int),
            frame=np.zeros(N, dtype=int),
            kind=np.full(N, self.kind, dtype=KIND_NAMES),
            reading=p,
            R=R,
            sigma_position=np.array([s.sigma for s in stations]),
            sigma_rotation=np.full(N, np.nan),
            velocity=np.zeros((N, n)),
            moving=np.zeros(N, dtype=bool),
            approach=self._approach(rows),
            effort=np.array([np.full(n, np.nan) if s.effort is None else s.effort for s in stations]).reshape(N, n),
            clock=clock,
        )

    def _approach(self, rows: list[int]) -> Array:
        """The way each joint came to these stations: as known, else as it comes from the one measured before."""
        way = np.zeros((len(rows), len(self.names)))
        before: Array | None = None
        last = np.zeros(len(self.names))
        wanted = {i: k for k, i in enumerate(rows)}
        for i, s in enumerate(self.stations):
            if s.state != MEASURED or s.q is None:
                continue
            if before is not None:
                step = s.q - before
                last = np.where(np.abs(step) > TRAVEL, np.sign(step), last)
            before = s.q
            if i in wanted:
                way[wanted[i]] = last if s.approach is None else s.approach
        return way


FORMAT = 1  # of the file
_NUMBERS = {"type": ["array", "null"], "items": {"type": "number"}}
_SCHEMA = {
    "type": "object",
    "required": ["modcal_measure", "robot", "joints", "reading", "goal", "seed", "stations"],
    "properties": {
        "modcal_measure": {"enum": [FORMAT]},
        "robot": {"type": "string"},
        "joints": {"type": "array", "items": {"type": "string"}, "minItems": 1},
        "reading": {"enum": [POINT, POSE]},
        "on_tool": {"type": "boolean"},
        "seed": {"type": "integer", "minimum": 0},
        "began": {"type": ["number", "null"]},
        "goal": {"type": "object"},
        "stations": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["role", "state", "asked"],
                "additionalProperties": False,
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
        "stations": [_station_data(s) for s in session.stations],
    }


def _station_data(s: Station) -> dict[str, Any]:
    out = {name: value for name, value in vars(s).items() if isinstance(value, str) or (name == "row" and value >= 0)}
    for name in ("asked", "q", "reading", "approach", "effort", "stamp", "sigma"):
        value = getattr(s, name)
        if value is not None and np.isfinite(value).all():
            out[name] = np.asarray(value, dtype=float).tolist()
    return out


@refusing
def from_data(data: Any, source: str) -> tuple[Session, Goal, int, str, float | None]:
    """Session, goal, seed, fingerprint and beginning of what :func:`to_data` made. Raises BadTable."""
    require(data, _SCHEMA, source, _REMEDY)
    names, stations = tuple(data["joints"]), []
    for i, row in enumerate(data["stations"]):
        known = ((k, v) for k, v in row.items() if v is not None)
        values: dict[str, Any] = {k: np.array(v, dtype=float) if isinstance(v, list) else v for k, v in known}
        if any(values[k].shape != (len(names),) for k in ("asked", "q", "approach", "effort") if k in values):
            raise BadTable(f"{source}, station {i + 1}", f"does not have {len(names)} joints", _REMEDY)
        reading = values.get("reading")
        size = 7 if data["reading"] == POSE else 3
        if (row["state"] == MEASURED) != (reading is not None) or (reading is not None and reading.shape != (size,)):
            raise BadTable(f"{source}, station {i + 1}", f"is {row['state']} and has {reading} as reading", _REMEDY)
        stations.append(Station(**values))
    session = Session(names, data["reading"], tuple(stations), data.get("on_tool", False))
    return session, Goal(**data["goal"]), data["seed"], data["robot"], data.get("began")
