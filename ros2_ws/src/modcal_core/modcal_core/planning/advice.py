"""What comes next: more stations for the fit, for the floor or for the proof, or an end, with its reason.

After each batch the model is fitted again, and the claim at the tool says what is proven of it, by all stations. From
the model's covariance follows how the claim shrinks after one, two, … further batches. Random stations, which no fit
sees, are measured once the claim has met the goal without them; where it no longer does with them, the fit goes on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Cell, View, choose_parameters, errors, place_model
from modcal_core.claim import claim_at_tool
from modcal_core.effects import claimed
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, se3
from modcal_core.measurements import MIN_RETURNS
from modcal_core.planning.next_stations import (
    best_stations,
    deciding_stations,
    first_stations,
    proof_stations,
    random_stations,
    return_stations,
)
from modcal_core.planning.outlook import Outlook, Refit, outlook, proven_over, refit
from modcal_core.planning.planner import min_stations
from modcal_core.planning.pool import Pool
from modcal_core.planning.rivals import deciding
from modcal_core.planning.route import nearest_order
from modcal_core.planning.session import (
    DECIDE,
    MIN_STATIONS,
    PROOF,
    RETURN,
    UNEXPLAINED,
    End,
    Goal,
    Session,
    Station,
    no_station_helps,
    proven,
    spent,
)
from modcal_core.robots import Inertias, Mechanism
from modcal_core.verdict import Floor, floors

BATCH = 2  # stations between two fits: fewer cost time, more are chosen by an older model
_GROWING = 6  # a batch is at least one in so many of the stations so far: a fit hardly changes by fewer
_UNHURRIED = 4  # where nothing is to be proven a batch is at least one in so many: a few more stations do no harm
_LOWERING = "stations that lower the error most"
_AHEAD = 6  # batches that are looked ahead
_POSTURES = 200  # that the claim is made over, for time
# Error of readings now over that which all stations of the budget would leave: no more is worth having. The tool's own
# error, without the instrument's, falls by up to twice as much
_SETTLED = 1.025
_SEARCHED = 4.0  # times the first stations, from which it may be said that a search has stalled
_BROUGHT = 0.9  # of what the model from half of the stations leaves; more is left where the other half brought little
_DECIDING = 4, 12  # stations to separate explanations: at once, and altogether
_RETURNS_FROM = 2.0  # times the first stations; a model of fewer may lack what makes the goal seem out of reach
_MAX_RETURNS = 12  # beyond, the floor is known to a tenth


@dataclass(frozen=True)
class Advance:
    """Where a measurement stands. expected: RMS error of a reading that the fit expects [m], None before the first fit.
    bound: upper end of the claim [m], of what the goal asks for. seen: RMS at the proof's stations [m]. floor: RMS [m]
    that repeats and instrument leave, None while it is not known. needed: further stations that it should take, None
    where nobody knows.
    """

    measured: int
    fitted: int
    proving: int
    expected: float | None = None
    bound: float | None = None
    seen: float | None = None
    floor: float | None = None
    needed: int | None = None
    effects: tuple[str, ...] = ()
    ties: tuple[str, ...] = ()


@dataclass(frozen=True)
class Advice:
    """session: with the stations to measure now, its pending ones. why: what they are for. outcome: None while it goes
    on. refitted: the model so far, None before the first.
    """

    session: Session
    why: str
    status: Advance
    outcome: End | None = None
    refitted: Refit | None = None


@dataclass(frozen=True, kw_only=True)
class _Standing(Advice):
    """What is known after a fit. view: what further stations are worth. bound: upper end of the claim [m], of what the
    goal asks for. floor: None unless a posture was repeated.
    """

    refitted: Refit
    view: Outlook
    bound: float
    floor: Floor | None

    def needing(self, stations: int) -> _Standing:
        """The same where so many further stations should do."""
        return replace(self, status=replace(self.status, needed=stations))


@dataclass(frozen=True)
class Method:
    """How stations are chosen. seed: of all that is drawn. batch: stations between two fits. effects: whether to look
    for more than geometry.
    """

    seed: int = 0
    batch: int = BATCH
    effects: bool = True


class Advisor:
    """Advises on one robot at one place; the same session gets the same advice from another advisor."""

    def __init__(
        self,
        chain: Mechanism,
        pool: Pool,
        goal: Goal,
        method: Method | None = None,
        cell: Cell | None = None,
        inertias: Inertias | None = None,
    ) -> None:
        """chain: the nominal robot. cell: what is known of its surroundings."""
        self.chain, self.pool, self.goal, self._method = chain, pool, goal, method or Method()
        self._cell, self._inertias = cell or Cell(), inertias
        if goal.instrument:
            stated = replace(self._cell.stated, instrument_mm=1e3 * goal.instrument)
            self._cell = replace(self._cell, stated=stated)
        self._last: tuple[tuple[int, ...], Refit] | None = None
        self._least: dict[str, int] = {}

    def least(self, kind: str) -> int:
        """The fewest stations from which the geometry can be fitted."""
        if kind not in self._least:
            # a tool that lies on no axis, as structure.parameter_count takes it
            tool = se3.transform(p=[0.11, 0.07, 0.13])
            model = replace(place_model(self.chain, ("tracker",)), T_tip_tool=tool)
            P = len(choose_parameters(model, [View(kind, 0)], self._cell.kept).parameters)
            self._least[kind] = min_stations(P, kind, 1.0) + 1
        return self._least[kind]

    def advise(self, session: Session, elapsed: float = 0.0) -> Advice:
        """What to do after what has been measured. elapsed: seconds since the session began."""
        begun, goal, least = self._fitted(session), self.goal, self.least(session.kind)
        if session.pending:
            return replace(begun, why="stations asked for before")
        if begun.refitted is None:
            first = first_stations(self.pool, session, least, np.random.default_rng(self._method.seed))
            return self._asked(begun, first, f"first stations: {least} are needed for the geometry")
        at = self._judged(begun, begun.refitted)
        measured, missing = at.status.measured, max(MIN_STATIONS - at.status.proving, 0)
        met = goal.accuracy is not None and at.bound <= goal.accuracy
        if met and not missing:
            at = replace(at, refitted=proven_over(at.refitted, self.pool.where))
            return self._ended(at, proven(goal, 1e3 * at.bound, measured, at.status.proving))
        if self._gone(session, elapsed):
            return replace(at, outcome=spent(goal, measured, 1e3 * at.bound))
        if met:
            return self._asked(
                at.needing(missing), proof_stations(self.pool, session, missing), "random stations for the proof"
            )
        rng = np.random.default_rng((self._method.seed, len(session.stations)))
        found, more = self._toward_goal(at, rng)
        if found:
            return self._asked(at.needing(more + missing), found, _LOWERING)
        if self._floor_is_unclear(at) and (found := self._returns(session)):
            return self._asked(at, found, "postures again: what the arm does not repeat")
        searching = self._is_searching(at)
        if (searching or self._is_unsettled(at)) and (found := self._hopeful(at, searching, rng)):
            return self._asked(at, found, "stations for what the model lacks still" if searching else _LOWERING)
        return self._ended(at, no_station_helps(goal, 1e3 * at.bound, at.floor, at.refitted.spread))

    # what is known

    def _fitted(self, session: Session) -> Advice:
        """The model of the stations so far, where they are enough."""
        rows = session.fitted
        status = Advance(len(session.rows()), len(rows), len(session.rows(PROOF)))
        if len(rows) < self.least(session.kind):
            return Advice(session, "", status)
        if self._last is None or self._last[0] != tuple(rows):
            try:
                self._last = tuple(rows), self._refit(session, rows)
            except NotEnoughData:
                return Advice(session, "", status)
        return Advice(session, "", status, refitted=self._last[1])

    def _refit(self, session: Session, rows: list[int]) -> Refit:
        method = self._method
        return refit(session.samples(rows), self.chain, method.seed, self._cell, self._inertias, method.effects)

    def _judged(self, at: Advice, refitted: Refit) -> _Standing:
        """What may be claimed of the model over all postures of the pool, by every station, and the floor."""
        session, rng = at.session, np.random.default_rng(self._method.seed)
        calibration, random = refitted.calibration, session.rows(PROOF)
        model = calibration.calibrated
        view = outlook(refitted, self.pool.where, self._cell.met(refitted.samples), rng)
        samples = session.samples([*session.fitted, *random])
        right = samples.select(np.r_[~refitted.wrong, np.ones(len(random), bool)])
        claim = claim_at_tool(calibration, right, self._cell.met(samples), self.pool.where[:_POSTURES])
        bound = 1e-3 * claim.mm[self.goal.statistic].ci95[1]
        residual = errors(model, refitted.samples)
        floor = floors(residual, refitted.samples, refitted.wrong, self._cell.stated).position
        left = errors(model, session.samples(random)).position_norm if random else None
        pairs = zip(model.effects, calibration.rivals, strict=False)
        status = replace(
            at.status,
            expected=float(np.hypot(refitted.spread, view.error(own=True))),
            bound=bound,
            seen=None if left is None else float(np.sqrt(np.mean(left**2))),
            floor=None if floor is None else 1e-3 * floor.rms,
            effects=tuple(effect.label for effect in model.effects if claimed(effect)),
            ties=tuple(f"{effect.label} or {rival.label}" for effect, rivals in pairs for rival in rivals),
        )
        return _Standing(session, "", status, refitted=refitted, view=view, bound=bound, floor=floor)

    def _gone(self, session: Session, elapsed: float) -> bool:
        late = self.goal.seconds is not None and elapsed >= self.goal.seconds
        return late or len(session.rows()) >= self.goal.stations

    def _floor_is_unclear(self, at: _Standing) -> bool:
        """Whether returns would tell more of what the arm does not repeat, and whether the goal is below it."""
        goal, floor = self.goal.rms, at.floor
        unclear = floor is None or (goal is not None and floor.interval[0] < (1e3 * goal) ** 2 < floor.interval[1])
        return unclear and not self.pool.recorded and not self._is_early(at)

    def _is_early(self, at: _Standing) -> bool:
        return at.status.fitted < _RETURNS_FROM * self.least(at.session.kind)

    def _is_unsettled(self, at: _Standing) -> bool:
        """Whether the whole budget of stations would still leave less: the model's part of the error shrinks."""
        spread, model = at.refitted.spread**2, at.view.error(own=True) ** 2
        share = min(at.status.fitted / max(self.goal.stations, 1), 1.0)
        return bool((spread + model) / (spread + model * share) > _SETTLED**2)

    def _is_searching(self, at: _Standing) -> bool:
        """Whether something is left that further stations may explain."""
        if self._is_early(at):
            return True
        refitted, rows = at.refitted, at.session.fitted
        hidden = at.floor is None or refitted.spread**2 > UNEXPLAINED * 1e-6 * at.floor.interval[1]
        if not (hidden and self._method.effects):
            return False
        if self.pool.recorded or len(rows) < _SEARCHED * self.least(at.session.kind):
            return True  # what is recorded costs nothing more
        # whether twice the stations have brought something: an effect, or a smaller rest
        half = self._refit(at.session, rows[: len(rows) // 2])
        e = errors(half.calibration.calibrated, refitted.samples).position_norm
        return refitted.spread <= _BROUGHT * float(np.sqrt(np.mean(e[~refitted.wrong] ** 2)))

    # what is chosen

    def _batch(self, at: _Standing, least: int) -> int:
        return max(1, min(max(self._method.batch, least), self.goal.stations - at.status.measured))

    def _best(self, at: _Standing, count: int, first: int, rng: np.random.Generator) -> tuple[list[Station], Array]:
        return best_stations(self.pool, at.view, at.refitted, at.session, count, first, rng)

    def _toward_goal(self, at: _Standing, rng: np.random.Generator) -> tuple[list[Station], int]:
        """The next batch, where a few more like it should prove the goal, and how many stations that takes."""
        if self.goal.accuracy is None:
            return [], 0
        size = self._batch(at, at.status.fitted // _GROWING)
        stations, rows = self._best(at, _AHEAD * size, size, rng)
        needed = at.view.reaching(self.goal.accuracy / at.bound, rows, size)
        return ([], 0) if needed is None else (stations[:size], needed)

    def _hopeful(self, at: _Standing, searching: bool, rng: np.random.Generator) -> list[Station]:
        """The next batch where no proof is in reach: half of the stations of a long search are drawn at random, since
        what nobody suspects no choice looks for.
        """
        fitted = at.status.fitted
        size = self._batch(at, fitted // _UNHURRIED)
        blind = size // 2 if searching and fitted >= _SEARCHED * self.least(at.session.kind) else 0
        stations, _ = self._best(at, size - blind, size, rng)
        return stations + random_stations(self.pool, at.session.asking(stations), blind)

    def _returns(self, session: Session) -> list[Station]:
        returned = len(session.rows(RETURN))
        return return_stations(session, min(MIN_RETURNS, _MAX_RETURNS - returned)) if returned < _MAX_RETURNS else []

    def _ended(self, at: _Standing, end: End) -> Advice:
        """The end, after stations that separate explanations where that is asked for."""
        asked = sum(s.role == DECIDE for s in at.session.stations)
        if self.goal.ties and asked < _DECIDING[1] and not self.pool.recorded and not self._gone(at.session, 0.0):
            rng = np.random.default_rng((self._method.seed, asked))
            found, why = deciding(at.refitted.calibration, self.pool, _DECIDING[0], rng)
            if found is not None:
                return self._asked(at, deciding_stations(found), f"stations that decide: {found.name}")
            ties = tuple(f"{tie} ({why[tie]})" if tie in why else tie for tie in at.status.ties)
            at = replace(at, status=replace(at.status, ties=ties))
        return replace(at, outcome=end)

    def _asked(self, at: Advice, stations: list[Station], why: str) -> Advice:
        """These stations, in a short order; the end where the budget leaves none."""
        session, status = at.session, at.status
        stations = stations[: max(self.goal.stations - status.measured, 0)]
        if not stations:
            bound = None if status.bound is None else 1e3 * status.bound
            return replace(at, outcome=spent(self.goal, status.measured, bound))
        if len(stations) > 1 and stations[0].role not in (RETURN, DECIDE):
            last = next((s.q for s in reversed(session.stations) if s.q is not None), None)
            q = np.array([s.asked for s in stations])
            stations = [stations[k] for k in nearest_order(q, q.mean(axis=0) if last is None else last)]
        return replace(at, session=session.asking(stations), why=why)
