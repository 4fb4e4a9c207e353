"""Which stations to measure: the main path of ``modcal plan``.

    joints' ranges → postures that are allowed and seen → chooser → accuracy → how many → the way through them

The noise is that of the site. What accuracy counts is the claim to be expected (:mod:`modcal_core.claim`).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import EQUATIONS_PER_PARAMETER, SHARES, Calibration, Cell, NoiseModel, Stated
from modcal_core.claim import Claim, expected_claim
from modcal_core.errors import NotPlannable
from modcal_core.geometry import Array
from modcal_core.planning.chooser import ROUNDS, Chooser, Search, grown
from modcal_core.planning.outlook import nominal_outlook, unrepeated
from modcal_core.planning.pool import CANDIDATES, Pool, readings_at, survey
from modcal_core.planning.route import RETURNS, Route, route
from modcal_core.planning.site import Site
from modcal_core.robots import Mechanism

_MOVES = (0.3, 0.1, 0.03)  # rad or m by which stations are moved, round by round, in search of better ones
_MAX = 400  # stations
_USUAL = 2.0  # times the fewest stations, where neither a number nor an accuracy is asked for: effects need some, too
_CLAIMED = 200  # postures that a claim is made over, for time
_SEEN = 1e-7  # of the largest singular value of the fit's rows: below, a direction is not seen
_RANDOM = 20  # random sets that a plan is compared with


@dataclass(frozen=True)
class PlanRequest:
    """What is asked of a plan.

    stations: how many; None: as many as the accuracy needs, or twice the fewest. accuracy: [m], of what measure says:
    ``rms`` or ``p95``. reading: ``point`` or ``pose``. fixed: parameters that are not fitted. candidates: postures to
    choose from. besides: stations (N, n) that are measured already and count too. returns: how many stations are
    visited twice, so that it is known what the arm does not repeat.
    """

    stations: int | None = None
    accuracy: float | None = None
    measure: str = "p95"
    reading: str = "point"
    fixed: tuple[str, ...] = ()
    candidates: int = CANDIDATES
    besides: Array | None = None
    returns: int = RETURNS


@dataclass(frozen=True)
class Expected:
    """What is to be expected of a plan's distinct stations, over the workspace.

    claim: from them. left: RMS error [m] that the fit leaves, at_random: of fits to as many random stations from the
    same postures, the median. repeat: RMS [m] of what joints do not repeat. rank: of the fit's Jacobian.
    """

    claim: Claim
    left: float
    at_random: float
    repeat: float
    rank: int

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
    - tried: claims of the sets tried while the number was sought, by number.
    """

    request: PlanRequest
    pool: Pool
    q: Array
    route: Route
    parameters: Sequence[str]
    expected: Expected
    tried: Mapping[int, Claim]

    @property
    def distinct(self) -> int:
        """The number of distinct stations."""
        return len(self.q) - len(self.route.returns)


class Planner:
    """Chooses among the postures of a pool, for one request."""

    def __init__(self, pool: Pool, request: PlanRequest, rng: np.random.Generator) -> None:
        """Raises BadTable for parameters that are not known."""
        self.pool, self.request, self._rng = pool, request, rng
        fresh = nominal_outlook(pool, request.reading, request.fixed)
        self.outlook = fresh if request.besides is None else fresh.beside(fresh.rows(request.besides))
        self._rows = self.outlook.rows(pool.q)

    def every(self, q: Array) -> Array:
        """Stations q (k, n) behind those that are measured already."""
        return q if self.request.besides is None else np.concatenate([self.request.besides, q])

    def claim(self, q: Array) -> Claim:
        """The claim to be expected over the workspace from stations q (k, n) and those that are measured already."""
        model, noise, every = self.pool.at.model, self.pool.at.site.noise, self.every(q)
        scatter, planned = self.outlook.scatter, readings_at(model, every, self.request.reading)
        read = noise.position + noise.per_metre * float(np.mean(np.linalg.norm(planned.reading, axis=1)))
        size = np.hypot([read, noise.rotation], scatter[[0, 3]])
        made = Calibration(model, model, model, np.stack([every.min(axis=0), every.max(axis=0)]))
        cell = Cell(stated=Stated(instrument_mm=1e3 * np.sqrt(3.0) * read))
        return expected_claim(made, planned, cell, NoiseModel(*size.tolist()), self.pool.where[:_CLAIMED])

    def left(self, rows: Array) -> float:
        """RMS error of the tool [m] that a fit to stations with these rows leaves."""
        return self.outlook.beside(rows).error(own=True)

    def best(self, count: int) -> Array:
        """The best set of so many stations, (count, n)."""
        chooser = Chooser(self.outlook, self.pool.ground, _MOVES, ROUNDS)
        return chooser.best(self.pool.q, count, self._rng).q

    def random(self, count: int) -> float:
        """What so many stations would leave that are drawn from the same postures, the median of several sets [m]."""
        sets = (self._rng.choice(len(self.pool.q), count, replace=False) for _ in range(_RANDOM))
        return float(np.median([self.left(self._rows[chosen]) for chosen in sets]))

    def to_accuracy(self, wanted: float, least: int) -> tuple[Array, Claim, dict[int, Claim]]:
        """The fewest stations whose claim meets the wish [m], by doubling and halving, their claim, and what was tried.
        Raises NotPlannable where as many as a plan may have do not.
        """
        search = Search.of(self._rows, self.outlook.H, self.outlook.gamma)
        q = self.pool.q[grown(search, min(_MAX, len(self.pool.q)))]  # the first so many are a good set of so many
        tried: dict[int, Claim] = {}

        def met(count: int) -> bool:
            if count not in tried:
                tried[count] = self.claim(q[:count])
            return self._upper(tried[count]) <= wanted

        high = least
        while not met(high):
            if high == len(q):
                said = f"{high} stations leave {1e3 * self._upper(tried[high]):.3g} mm"
                raise NotPlannable(self._asked, said, "ask for less, use a better tracker, or measure poses")
            high = min(2 * high, len(q))
        count = bisect_left(range(high), True, max(least, high // 2), key=met)
        best = self.best(count)
        claim = self.claim(best)
        if self._upper(claim) > wanted:  # what is better by the expected error may be claimed no better
            best, claim = q[:count], tried[count]
        return best, claim, dict(sorted(tried.items()))

    def _upper(self, claim: Claim) -> float:
        return 1e-3 * claim.mm["rms" if self.request.measure == "rms" else "p95"].ci95[1]

    @property
    def _asked(self) -> str:
        return f"{self.request.measure} of {1e3 * (self.request.accuracy or 0.0):.3g} mm"

    def require(self, count: int, least: int, repeat: float) -> None:
        """Raises NotPlannable where so many stations are too few or not there, or joints do not repeat to the wish."""
        there = len(self.pool.q)
        if count < least:
            raise NotPlannable(f"{count} stations", f"modcal calibrate needs at least {least}", "ask for more stations")
        if count > there:
            said = f"only {there} of the postures tried are allowed and seen"
            raise NotPlannable(f"{count} stations", said, "ask for fewer, or widen the site")
        if repeat >= (self.request.accuracy or np.inf):
            said = f"what the joints do not repeat alone makes {1e3 * repeat:.3g} mm RMS"
            raise NotPlannable(self._asked, said, "ask for less, or correct the noise of the site")


def plan(chain: Mechanism, site: Site, request: PlanRequest, rng: np.random.Generator) -> Plan:
    """The stations for this wish. Raises NotPlannable, and BadTable for a wish or a site that makes no sense."""
    pool = survey(chain, site, rng, request.reading, request.candidates)
    planner = Planner(pool, request, rng)
    names, outlook = planner.outlook.parameters, planner.outlook
    least = max(min_stations(len(names), request.reading) - len(planner.every(pool.q[:0])), 1)
    repeat = float(np.sqrt(np.mean(np.sum(unrepeated(pool.at.model, pool.where, site.noise)[:, :3] ** 2, axis=(1, 2)))))
    asked, tried = request.stations is None and request.accuracy is not None, dict[int, Claim]()
    count = request.stations or min(math.ceil(_USUAL * least), max(least, len(pool.q)))
    planner.require(least if asked else count, least, repeat if asked else 0.0)
    if asked and request.accuracy is not None:
        best, claim, tried = planner.to_accuracy(request.accuracy, least)
    else:
        best = planner.best(count)
        claim = planner.claim(best)
    way = route(best, pool.at.free, pool.roadmap, 0.5 * (best.min(axis=0) + best.max(axis=0)), request.returns)
    own = outlook.rows(planner.every(best))[..., outlook.own]
    told = np.linalg.svd(own.reshape(-1, own.shape[2]), compute_uv=False)
    rank = int(np.sum(told > _SEEN * told[0]))
    expected = Expected(claim, planner.left(outlook.rows(best)), planner.random(len(best)), repeat, rank)
    return Plan(request, pool, best[way.order], way, names, expected, tried)


def min_stations(parameters: int, reading: str, share: float = SHARES[0] + SHARES[1]) -> int:
    """The fewest stations from which so many parameters are fitted to a share of them, as ``modcal calibrate`` does."""
    fitted = np.ceil(EQUATIONS_PER_PARAMETER * parameters / (6.0 if reading == "pose" else 3.0))
    return int(np.ceil((fitted - 0.5) / share))
