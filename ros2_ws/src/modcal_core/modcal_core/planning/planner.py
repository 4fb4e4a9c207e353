"""Which stations to measure: the main path of ``modcal plan``.

    joints' ranges → postures that are allowed and seen → rows → exchange → accuracy → how many → the way through them

The noise is that of the site. What accuracy counts is the claim to be expected (:mod:`modcal_core.claim`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modcal_core.calibration import EQUATIONS_PER_PARAMETER, SHARES, Calibration, Cell, NoiseModel, Stated
from modcal_core.claim import Claim, expected_claim
from modcal_core.errors import BadTable, NotPlannable
from modcal_core.geometry import Array
from modcal_core.planning.exchange import (
    ACCURACY,
    CRITERIA,
    Observability,
    exchange,
    grown,
    information,
    observability,
)
from modcal_core.planning.outlook import nominal_outlook, unrepeated
from modcal_core.planning.pool import CANDIDATES, Ground, Pool, readings_at, survey
from modcal_core.planning.route import RETURNS, Route, route
from modcal_core.planning.site import Site
from modcal_core.robots import Mechanism

_REFINED = (0.3, 0.1, 0.03)  # rad or m by which stations are moved, round by round, in search of better ones
_MOVED = 800  # new candidates for all stations and a round, for time
STARTS = 2  # of the exchange
_MAX = 400  # stations
_USUAL = 2.0  # times the fewest stations, where neither a number nor an accuracy is asked for: effects need some, too
_CLAIMED = 200  # postures that a claim is made over, for time
_RANDOM = 20  # random sets that a plan is compared with


@dataclass(frozen=True)
class PlanRequest:
    """What is asked of a plan.

    stations: how many; None: as many as the accuracy needs, or twice the fewest. accuracy: [m], of what
    measure says: ``rms`` or ``p95``. criterion: one of CRITERIA. reading: ``point`` or ``pose``. fixed: parameters that
    are not fitted. starts: of the exchange. candidates: postures to choose from. besides: stations (N, n) that are
    measured already and count too. returns: how many stations are visited twice, so that it is known what the arm does
    not repeat.
    """

    stations: int | None = None
    accuracy: float | None = None
    measure: str = "p95"
    criterion: str = ACCURACY
    reading: str = "point"
    fixed: tuple[str, ...] = ()
    starts: int = STARTS
    candidates: int = CANDIDATES
    besides: Array | None = None
    returns: int = RETURNS


@dataclass(frozen=True)
class Expected:
    """What is to be expected of a plan's distinct stations, over the workspace.

    claim: from them. left: RMS error [m] that the fit leaves, at_random: of fits to as many random stations from the
    same postures, the median. repeat: RMS [m] of what joints do not repeat. indices: of the fit's Jacobian.
    """

    claim: Claim
    left: float
    at_random: float
    repeat: float
    indices: Observability

    @property
    def ratios(self) -> dict[str, float]:
        """The errors over those of random stations: in all, and what the model leaves."""
        total = np.hypot(self.left, self.repeat) / np.hypot(self.at_random, self.repeat)
        return {"total_rms": float(total), "model_rms": self.left / self.at_random}


@dataclass(frozen=True)
class Plan:
    """Planned stations and what is expected of them.

    - q: postures in the order of the path, (k, n) [rad, m]; those visited twice appear twice.
    - parameters: names of those that are fitted.
    - curve: (number, claim) of the sets tried while the number was sought.
    """

    request: PlanRequest
    pool: Pool
    q: Array
    route: Route
    parameters: Sequence[str]
    expected: Expected
    curve: tuple[tuple[int, Claim], ...] = field(default=())

    @property
    def ground(self) -> Ground:
        """The arm at its site."""
        assert self.pool.ground is not None
        return self.pool.ground

    @property
    def distinct(self) -> int:
        """The number of distinct stations."""
        return len(self.q) - len(self.route.returns)


class Planner:
    """Chooses among the postures of a pool, for one request."""

    def __init__(self, pool: Pool, request: PlanRequest, rng: np.random.Generator) -> None:
        """Raises BadTable for a criterion or parameters that are not known."""
        assert pool.ground is not None
        self.pool, self.ground, self.request, self._rng = pool, pool.ground, request, rng
        fresh = nominal_outlook(pool, pool.q, request.reading, request.fixed)
        if request.criterion not in CRITERIA:
            raise BadTable(f"criterion '{request.criterion}'", "is not known", f"choose {', '.join(CRITERIA)}")
        self.outlook = fresh if request.besides is None else fresh.beside(fresh.rows(request.besides))
        self._rows = self.outlook.rows(pool.q)

    def claim(self, q: Array) -> Claim:
        """The claim to be expected over the workspace from stations q (k, n) and those that are measured already."""
        request, noise, model = self.request, self.ground.site.noise, self.ground.model
        every = q if request.besides is None else np.concatenate([request.besides, q])
        scatter, planned = self.outlook.scatter, readings_at(model, every, request.reading)
        distance = float(np.mean(np.linalg.norm(planned.reading, axis=1)))
        size = np.hypot([noise.position + noise.per_metre * distance, noise.rotation], scatter[[0, 3]])
        made = Calibration(model, model, model, np.stack([every.min(axis=0), every.max(axis=0)]))
        cell = Cell(stated=Stated(instrument_mm=1e3 * np.sqrt(3.0) * (noise.position + noise.per_metre * distance)))
        return expected_claim(made, planned, cell, NoiseModel(*size.tolist()), self.pool.where[:_CLAIMED])

    def left(self, rows: Array) -> float:
        """RMS error of the tool [m] that a fit to stations with these rows leaves."""
        return self.outlook.beside(rows).error(own=True)

    def grown(self) -> Array:
        """As many stations as a plan may have, of which the first so many are a good set of so many, (k, n)."""
        search = self.outlook.search(self._rows, self.request.criterion)
        return self.pool.q[grown(search, min(_MAX, len(self.pool.q)))]

    def best(self, count: int, starts: int) -> Array:
        """The best set of so many stations, (count, n): by exchange, then each moved about where it is, as long as the
        exchange among these finds better ones.
        """
        q = self.pool.q[self._exchanged(self._rows, count, starts)]
        for size in _REFINED:
            moved = np.concatenate([q, self.ground.around(q, (size,), max(_MOVED // count, 1), self._rng)])
            q = moved[self._exchanged(self.outlook.rows(moved), count, begin=np.arange(count))]
        return q

    def _exchanged(self, rows: Array, count: int, starts: int = 1, begin: np.ndarray | None = None) -> np.ndarray:
        search = self.outlook.search(rows, self.request.criterion)
        return exchange(search, count, self._rng, starts, begin=begin)

    def random(self, count: int) -> float:
        """What so many stations would leave that are drawn from the same postures, the median of several sets [m]."""
        sets = (self._rng.choice(len(self.pool.q), count, replace=False) for _ in range(_RANDOM))
        return float(np.median([self.left(self._rows[chosen]) for chosen in sets]))

    def measure(self, claim: Claim) -> float:
        """The upper end of a claim [m], of what was asked for."""
        return 1e-3 * claim.mm["rms" if self.request.measure == "rms" else "p95"].ci95[1]


def plan(chain: Mechanism, site: Site, request: PlanRequest, rng: np.random.Generator) -> Plan:
    """The stations for this wish. Raises NotPlannable, and BadTable for a wish or a site that makes no sense."""
    pool = survey(chain, site, rng, request.reading, request.candidates)
    planner = Planner(pool, request, rng)
    names, besides = planner.outlook.parameters, request.besides
    measured = 0 if besides is None else len(besides)
    least = max(min_stations(len(names), request.reading) - measured, 1)
    ground, where = planner.ground, pool.where
    repeat = float(np.sqrt(np.mean(np.sum(unrepeated(ground.model, where, site.noise)[:, :3] ** 2, axis=(1, 2)))))
    curve: tuple[tuple[int, Claim], ...] = ()
    if request.stations is None and request.accuracy is not None:
        best, claim, curve = _to_accuracy(planner, request.accuracy, least, repeat)
    else:
        count = request.stations or min(math.ceil(_USUAL * least), max(least, len(pool.q)))
        _require(count, least, len(pool.q))
        best = planner.best(count, request.starts)
        claim = planner.claim(best)
    way = route(best, ground.free, pool.roadmap, 0.5 * (best.min(axis=0) + best.max(axis=0)), request.returns)
    rows = planner.outlook.rows(best if besides is None else np.concatenate([besides, best]))
    indices = observability(information(planner.outlook.search(rows, "d").J), len(rows))
    expected = Expected(claim, planner.left(rows[measured:]), planner.random(len(best)), repeat, indices)
    return Plan(request, pool, best[way.order], way, names, expected, curve)


def min_stations(parameters: int, reading: str, share: float = SHARES[0] + SHARES[1]) -> int:
    """The fewest stations from which so many parameters are fitted to a share of them, as ``modcal calibrate`` does."""
    fitted = np.ceil(EQUATIONS_PER_PARAMETER * parameters / (6.0 if reading == "pose" else 3.0))
    return int(np.ceil((fitted - 0.5) / share))


def _require(count: int, least: int, there: int) -> None:
    if count < least:
        raise NotPlannable(f"{count} stations", f"modcal calibrate needs at least {least}", "ask for more stations")
    if count > there:
        said = f"only {there} of the postures tried are allowed and seen"
        raise NotPlannable(f"{count} stations", said, "ask for fewer, or widen the site")


def _to_accuracy(
    planner: Planner, wanted: float, least: int, repeat: float
) -> tuple[Array, Claim, tuple[tuple[int, Claim], ...]]:
    """The fewest stations whose claim meets the wish [m], by doubling and halving, their claim, and what was tried."""
    asked = f"{planner.request.measure} of {1e3 * wanted:.3g} mm"
    _require(least, least, len(planner.pool.q))
    if repeat >= wanted:
        said = f"what the joints do not repeat alone makes {1e3 * repeat:.3g} mm RMS"
        raise NotPlannable(asked, said, "ask for less, or correct the noise of the site")
    tried: dict[int, Claim] = {}
    grown = planner.grown()

    def enough(count: int) -> bool:
        if count not in tried:
            tried[count] = planner.claim(grown[:count])
        return planner.measure(tried[count]) <= wanted

    low, high = least, least
    while not enough(high):
        if high >= len(grown):
            said = f"{high} stations leave {1e3 * planner.measure(tried[high]):.3g} mm"
            raise NotPlannable(asked, said, "ask for less, use a better tracker, or measure poses")
        low, high = high, min(2 * high, len(grown))
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    best = planner.best(high, planner.request.starts)
    claim = planner.claim(best)
    if planner.measure(claim) > wanted:  # what is better by the expected error may be claimed no better
        best, claim = grown[:high], tried[high]
    return best, claim, tuple(sorted(tried.items()))
