"""What has been measured so far: a list of stations that only grows, from which everything else follows.

A station is planned, then measured or not: the tracker may not see it, the arm may not reach it. An accuracy is proven
where the upper end of the claim (:mod:`modcal_core.claim`) is within it, over postures drawn at random from all that
are allowed and seen. Some stations are such postures, which no fit sees.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import Array, so3
from modcal_core.measurements import APART, POINT, POSE, TRAVEL, Samples
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.schema import NUMBER, SIZE, TEXT, holding, list_of, record, require, whole
from modcal_core.verdict import Floor

MIN_STATIONS = 6  # at random; what is wrong at two fifths of all postures shows at one of six with 95 %

Statistic = Literal["rms", "p95"]
# The 95th percentile over the RMS of a squared error that varies from station to station as the square of one normal
# number does: the widest law that the proof allows for, and the one with the longest tail
P95_OVER_RMS = 1.96
MAX_STATIONS = 400  # more than any arm has needed in the benchmarks; without an end a robot would go on for ever


@dataclass(frozen=True)
class Goal:
    """accuracy: [m] at the tool, None: as good as this arm and instrument allow. statistic: of the errors at stations
    drawn at random. stations, seconds: most that it may take. instrument: RMS over space [m] that the instrument is
    stated to add to an error. ties: also separate explanations that the readings leave open.
    """

    accuracy: float | None = None
    statistic: Statistic = "rms"
    stations: int = MAX_STATIONS
    seconds: float | None = None
    instrument: float = 0.0
    ties: bool = False

    def __post_init__(self) -> None:
        """Raises BadTable for what cannot be asked."""
        if self.accuracy is not None and not 0.0 < self.accuracy < np.inf:
            raise BadTable("--goal-mm", f"is {1e3 * self.accuracy:g} mm, more than 0 is needed", "give millimetres")
        if self.stations < 1:
            raise BadTable("--stations", f"is {self.stations}, at least 1 is needed", "give more")

    @property
    def rms(self) -> float | None:
        """The RMS error of a reading [m] below which the goal is met, the instrument's own error included."""
        if self.accuracy is None:
            return None
        tool = self.accuracy / (P95_OVER_RMS if self.statistic == "p95" else 1.0)
        return float(np.hypot(tool, self.instrument))


Ending = Literal["proven", "budget", "no_station_helps"]
UNEXPLAINED = 1.5  # mean square left over the most that the floor may be, from which something is to be found still


@dataclass(frozen=True)
class End:
    """How it ended, and why, in a sentence."""

    ending: Ending
    sentence: str


def proven(goal: Goal, claimed: float, measured: int, unseen: int) -> End:
    """The goal is proven. claimed: upper end [mm] of what it asks for. measured: stations in all. unseen: at random."""
    assert goal.accuracy is not None
    return End(
        "proven",
        f"{1e3 * goal.accuracy:g} mm is proven: over all postures that are allowed and seen {_said(goal, claimed)}, "
        f"from {measured} stations, {unseen} of them at random and in no fit.",
    )


def spent(goal: Goal, measured: int, claimed: float | None) -> End:
    """The budget is gone. claimed: upper end [mm] of what the goal asks for; None where there is no fit yet."""
    reached = "too few for a fit." if claimed is None else f"{_said(goal, claimed)}, and the goal is not proven."
    return End("budget", f"The budget is gone after {measured} stations: {reached}")


def no_station_helps(goal: Goal, claimed: float, floor: Floor | None, left: float) -> End:
    """Why more stations would change nothing. claimed: as of :func:`spent`. left: RMS [m] of the fit's residuals."""
    reached = _said(goal, claimed)
    if floor is None:
        cause = "what is left does not get smaller with more stations; no posture was visited twice to tell why"
    elif left**2 > UNEXPLAINED * 1e-6 * floor.interval[1]:
        parts = f"{1e3 * left:.3f} mm is left, {floor.rms:.3f} mm of it does not repeat"
        cause = f"{parts}; the rest has no known cause"
    else:
        many = f"{floor.returns} returns" if floor.returns else "what was stated"
        low, high = np.sqrt(floor.interval)
        sized = f"{floor.rms:.3f} mm ({low:.3f} to {high:.3f})" if floor.returns else f"{floor.rms:.3f} mm"
        cause = f"{sized} is what this arm repeats and this instrument reads, by {many}"
    if goal.accuracy is None:
        return End("no_station_helps", f"No further station helps: {reached}; {cause}.")
    wanted = f"{1e3 * goal.accuracy:g} mm"
    below = floor is not None and goal.rms is not None and 1e3 * goal.rms < floor.rms
    said = f"{wanted} is below what can be reached" if below else f"{wanted} is not in reach"
    return End("no_station_helps", f"{said}: {cause}; reached: {reached}.")


def _said(goal: Goal, claimed: float) -> str:
    name = "95th percentile" if goal.statistic == "p95" else "RMS error"
    return f"the tool's {name} is at most {claimed:.3f} mm with 95 % confidence"


# --- What has been measured so far

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
    carried: the instrument is on the tool, and reads poses of a target that stands still.
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
        """The measured stations with these numbers, as samples, in the order in which they were measured; also of an
        instrument on the tool they say where the tool is in a frame that stands still.
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
            kind=np.full(N, self.kind, dtype=KIND_NAMES),
            reading=p,
            R=R,
            sigma_position=np.array([s.sigma for s in stations]),
            approach=self._approach(rows),
            effort=np.array([np.full(n, np.nan) if s.effort is None else s.effort for s in stations]).reshape(N, n),
            clock=clock,
        )

    def _approach(self, rows: list[int]) -> Array:
        """The way each joint came to these stations: as known, else as it comes from the one measured before."""
        ways, last, before = dict[int, Array](), np.zeros(len(self.names)), None
        for i in self.rows():
            station = self.stations[i]
            if before is not None and station.q is not None:
                step = station.q - before
                last = np.where(np.abs(step) > TRAVEL, np.sign(step), last)
            before = station.q
            ways[i] = last if station.approach is None else station.approach
        return np.array([ways[i] for i in rows]).reshape(len(rows), len(self.names))


FORMAT = 1  # of the file
_NUMBERS = {**list_of(NUMBER), "type": ["array", "null"]}
_STATION = record(
    ("role", "state", "asked"),
    role={"enum": (FIT, RETURN, DECIDE, PROOF)},
    state={"enum": (PLANNED, MEASURED, UNSEEN, SKIPPED)},
    asked=list_of(NUMBER),
    stamp={"type": ["number", "null"]},
    sigma={**SIZE, "type": ["number", "null"]},
    row={"type": "integer"},
    **dict.fromkeys(("q", "reading", "approach", "effort"), _NUMBERS),
)
_SCHEMA = holding(
    ("modcal_measure", "robot", "joints", "reading", "goal", "seed", "stations"),
    modcal_measure={"enum": [FORMAT]},
    robot=TEXT,
    joints=list_of(TEXT, 1),
    reading={"enum": (POINT, POSE)},
    on_tool={"type": "boolean"},
    seed=whole(0, 2**63),
    began={"type": ["number", "null"]},
    goal={"type": "object"},
    stations=list_of(_STATION),
)
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
