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
from modcal_core.geometry import se3
from modcal_core.measurements import MIN_RETURNS
from modcal_core.planning.next_stations import (
    Chooser,
    deciding_stations,
    first_stations,
    one_motion,
    proof_stations,
    return_stations,
)
from modcal_core.planning.outlook import Outlook, Refit, outlook, proven_over, refit
from modcal_core.planning.planner import min_stations
from modcal_core.planning.pool import Pool
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


@dataclass(frozen=True)
class _Standing:
    """What is known after a fit. view: what further stations are worth. floor: None unless a posture was repeated."""

    session: Session
    status: Advance
    refitted: Refit
    view: Outlook
    floor: Floor | None

    @property
    def bound(self) -> float:
        """The upper end of the claim [m], of what the goal asks for."""
        assert self.status.bound is not None
        return self.status.bound

    def needing(self, stations: int) -> _Standing:
        """The same where so many further stations should do."""
        return replace(self, status=replace(self.status, needed=stations))

    def advice(self, why: str, outcome: End | None = None) -> Advice:
        """Advice from here."""
        return Advice(self.session, why, self.status, outcome, self.refitted)


@dataclass(frozen=True)
class Method:
    """How stations are chosen. seed: of all that is drawn. planned: False draws every station at random, to compare
    with. batch: stations between two fits. effects: whether to look for more than geometry.
    """

    seed: int = 0
    planned: bool = True
    batch: int = BATCH
    effects: bool = True


class Advisor:
    """Advises on one robot at one place. Nothing of what it remembers matters but for time: the same session gets the
    same advice from another advisor.
    """

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
        rows = session.fitted
        status = Advance(len(session.rows()), len(rows), len(session.rows(PROOF)))
        refitted = self._refit(session, rows) if len(rows) >= self.least(session.kind) else None
        if session.pending:
            return Advice(session, "stations asked for before", status, refitted=refitted)
        if refitted is None:
            count, rng = self.least(session.kind), np.random.default_rng(self._method.seed)
            stations = first_stations(self.pool, session, count, self._method.planned, rng)
            why = f"first stations: {count} are needed for the geometry"
            return self._asked(Advice(session, why, status), stations)
        view = outlook(
            refitted, self.pool.where, self._cell.met(refitted.samples), np.random.default_rng(self._method.seed)
        )
        at = self._standing(session, status, refitted, view)
        if self._is_met(at) and status.proving >= MIN_STATIONS:
            at = replace(at, refitted=proven_over(refitted, self.pool.where))
            return self._settle_ties(at, proven(self.goal, 1e3 * at.bound, status.measured, status.proving))
        if self._gone(session, elapsed):
            return at.advice("", spent(self.goal, status.measured, 1e3 * at.bound))
        return self._next(at)

    def _refit(self, session: Session, rows: list[int]) -> Refit | None:
        if self._last is None or self._last[0] != tuple(rows):
            try:
                self._last = tuple(rows), self._fitted_to(session, rows)
            except NotEnoughData:
                return None
        return self._last[1]

    def _fitted_to(self, session: Session, rows: list[int]) -> Refit:
        return refit(
            session.samples(rows), self.chain, self._method.seed, self._cell, self._inertias, self._method.effects
        )

    def _standing(self, session: Session, status: Advance, refitted: Refit, view: Outlook) -> _Standing:
        calibration, random = refitted.calibration, session.rows(PROOF)
        model = calibration.calibrated
        samples = session.samples([*session.fitted, *random])
        right = samples.select(np.r_[~refitted.wrong, np.ones(len(random), bool)])
        # what may be claimed of the model over all postures of the pool, by every station
        claim = claim_at_tool(calibration, right, self._cell.met(samples), self.pool.where[:_POSTURES])
        residual = errors(model, refitted.samples)
        floor = floors(residual, refitted.samples, refitted.wrong, self._cell.stated).position
        left = errors(model, session.samples(random)).position_norm if random else None
        pairs = zip(model.effects, calibration.rivals, strict=False)
        status = replace(
            status,
            expected=float(np.hypot(refitted.spread, view.error(own=True))),
            bound=1e-3 * claim.mm[self.goal.statistic].ci95[1],
            seen=None if left is None else float(np.sqrt(np.mean(left**2))),
            floor=None if floor is None else 1e-3 * floor.rms,
            effects=tuple(effect.label for effect in model.effects if claimed(effect)),
            ties=tuple(f"{effect.label} or {rival.label}" for effect, rivals in pairs for rival in rivals),
        )
        return _Standing(session, status, refitted, view, floor)

    def _is_met(self, at: _Standing) -> bool:
        return self.goal.accuracy is not None and at.bound <= self.goal.accuracy

    def _next(self, at: _Standing) -> Advice:
        session, status = at.session, at.status
        size = max(self._method.batch, len(session.fitted) // _GROWING)
        size = max(1, min(size, self.goal.stations - status.measured))
        rng = np.random.default_rng((self._method.seed, len(session.stations)))
        if self.goal.accuracy is None:
            return self._as_good_as_can_be(at, size, rng)
        missing = max(MIN_STATIONS - status.proving, 0)
        if self._is_met(at):
            asked = at.needing(missing).advice("random stations for the proof")
            return self._asked(asked, proof_stations(self.pool, session, missing))
        stations, rows = self._chooser(at).best(session, _AHEAD * size, rng, size)
        view = at.view
        for k in range(size, len(rows) + 1, size):
            view = view.beside(rows[k - size : k])
            if at.bound * view.error() / at.view.error() <= self.goal.accuracy:
                asked = at.needing(k + missing).advice("stations that lower the error most")
                return self._asked(asked, stations[:size])
        return self._as_good_as_can_be(at, size, rng)

    def _chooser(self, at: _Standing) -> Chooser:
        return Chooser(self.pool, at.view, at.refitted, self._method.planned)

    def _as_good_as_can_be(self, at: _Standing, size: int, rng: np.random.Generator) -> Advice:
        """No proof is in reach: know the floor, then measure until more stations would change nothing."""
        session, refitted, floor, goal = at.session, at.refitted, at.floor, self.goal.rms
        fitted, least = len(session.fitted), self.least(session.kind)
        size = max(size, fitted // _UNHURRIED)
        returned = len(session.rows(RETURN))
        unclear = floor is None or (goal is not None and floor.interval[0] < (1e3 * goal) ** 2 < floor.interval[1])
        early = fitted < _RETURNS_FROM * least
        if not self.pool.recorded and unclear and not early and returned < _MAX_RETURNS:
            count = MIN_RETURNS if returned < MIN_RETURNS else min(MIN_RETURNS, _MAX_RETURNS - returned)
            if stations := return_stations(session, count):
                return self._asked(at.advice("postures again: what the arm does not repeat"), stations)
        # error now over that which the whole budget of stations would leave: the model's part shrinks
        spread, model = refitted.spread**2, at.view.error(own=True) ** 2
        gain = np.sqrt((spread + model) / (spread + model * min(fitted / max(self.goal.stations, 1), 1.0)))
        hidden = floor is None or spread > UNEXPLAINED * 1e-6 * floor.interval[1]
        searching = early or (hidden and self._method.effects and not self._stalled(at))
        if gain > _SETTLED or searching:
            # what nobody suspects no choice looks for: half of the stations of a long search are drawn at random
            blind = size // 2 if searching and fitted >= _SEARCHED * least else 0
            chooser = self._chooser(at)
            stations, _ = chooser.best(session, size - blind, rng)
            if blind:
                stations += replace(chooser, planned=False).best(session.asking(stations), blind, rng)[0]
            if stations:
                why = "stations for what the model lacks still" if searching else "stations that lower the error most"
                return self._asked(at.advice(why), stations)
        return self._settle_ties(at, no_station_helps(self.goal, 1e3 * at.bound, floor, refitted.spread))

    def _stalled(self, at: _Standing) -> bool:
        """Whether twice the stations have brought nothing: neither an effect, nor a smaller rest."""
        rows, refitted = at.session.fitted, at.refitted
        if self.pool.recorded or len(rows) < _SEARCHED * self.least(at.session.kind):
            return False  # what is recorded costs nothing more
        half = self._fitted_to(at.session, rows[: len(rows) // 2])
        e = errors(half.calibration.calibrated, refitted.samples).position_norm
        return refitted.spread > _BROUGHT * float(np.sqrt(np.mean(e[~refitted.wrong] ** 2)))

    def _settle_ties(self, at: _Standing, ended: End) -> Advice:
        """The end, after stations that separate explanations where that is asked for."""
        asked = sum(s.role == DECIDE for s in at.session.stations)
        if self.goal.ties and asked < _DECIDING[1] and not self.pool.recorded and not self._gone(at.session, 0.0):
            rng = np.random.default_rng((self._method.seed, asked))
            stations, between = deciding_stations(at.refitted, self.pool, _DECIDING[0], rng)
            if stations:
                return self._asked(at.advice(f"stations that decide: {between}"), stations)
            same = {f"{one} or {other}" for one, other in one_motion(at.refitted, self.pool, rng)}
            named = (f"{tie} ({_not_by_posture(tie)})" if tie in same else tie for tie in at.status.ties)
            at = replace(at, status=replace(at.status, ties=tuple(named)))
        return at.advice("", ended)

    def _asked(self, advice: Advice, stations: list[Station]) -> Advice:
        """The advice with these stations asked for, in a short order; the end where the budget leaves none."""
        session, status = advice.session, advice.status
        stations = stations[: max(self.goal.stations - status.measured, 0)]
        if not stations:
            bound = None if status.bound is None else 1e3 * status.bound
            return replace(advice, why="", outcome=spent(self.goal, status.measured, bound))
        if len(stations) > 1 and stations[0].role not in (RETURN, DECIDE):
            last = next((s.q for s in reversed(session.stations) if s.q is not None), None)
            q = np.array([s.asked for s in stations])
            stations = [stations[k] for k in nearest_order(q, q.mean(axis=0) if last is None else last)]
        return replace(advice, session=session.asking(stations))

    def _gone(self, session: Session, elapsed: float) -> bool:
        late = self.goal.seconds is not None and elapsed >= self.goal.seconds
        return late or len(session.rows()) >= self.goal.stations


def _not_by_posture(tie: str) -> str:
    """Why these explanations stay open, and what would tell: another payload changes two loads alike."""
    loads = sum(" by load:" in name or " by payload:" in name for name in tie.split(" or "))
    payload = "another payload, or " if loads == 1 else ""
    return (
        "cannot tell: they are one motion of the tool, which no posture separates and either corrects; "
        f"{payload}a target on a link between them would tell"
    )
