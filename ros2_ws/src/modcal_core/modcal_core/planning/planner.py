"""Which stations to measure: the main path of ``modcal plan``.

    joints' ranges → postures that are allowed and seen → rows → exchange → accuracy → how many → the way through them

The parameters are those that ``modcal calibrate`` will fit, its weights and its prior count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from modcal_core.calibration import EQUATIONS_PER_PARAMETER, SHARES
from modcal_core.claim import Claim
from modcal_core.errors import NotPlannable
from modcal_core.geometry import Array
from modcal_core.planning.criteria import ACCURACY, Criterion, Observability, criterion, observability
from modcal_core.planning.fedorov import Exchange, exchange
from modcal_core.planning.posture_pool import CANDIDATES, PosturePool, random_accuracies, survey
from modcal_core.planning.route import RETURNS, Route, route
from modcal_core.planning.site import Site, clearance, visible
from modcal_core.planning.worth import Accuracy, StationRows, station_rows
from modcal_core.robots import Mechanism

_REFINED = (0.3, 0.1, 0.03)  # rad or m by which stations are moved, round by round, in search of better ones
_MOVED = 24  # new candidates for every station and round
_FEWER = 5  # stations fewer that are tried at the end, one by one
STARTS = 2  # of the exchange
_QUICK = (1, 2)  # starts and passes while the number of stations is looked for
_MAX = 400  # stations
_USUAL = 1.5  # times the fewest stations, where neither a number nor an accuracy is asked for: some may be lost


@dataclass(frozen=True)
class PlanRequest:
    """What is asked of a plan.

    stations: how many; None: as many as the accuracy needs, or half as many again as the fewest. accuracy: [m], of what
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
class Plan:
    """Planned stations and their expected accuracy.

    - q: postures in the order of the path, (k, n) [rad, m]; those visited twice appear twice.
    - claim: to be expected over the workspace from the distinct stations. accuracy, indices: of their fit.
    - random: accuracies of as many random stations from the same postures.
    - curve: (number, claim) of the sets tried while the number was sought.
    - values: criterion after each start, then after refinement.
    """

    request: PlanRequest
    pool: PosturePool
    q: Array
    route: Route
    claim: Claim
    accuracy: Accuracy
    indices: Observability
    random: tuple[Accuracy, ...]
    values: tuple[float, ...]
    curve: tuple[tuple[int, Claim], ...] = field(default=())

    @property
    def distinct(self) -> int:
        """The number of distinct stations."""
        return len(self.q) - len(self.route.returns)


def plan(chain: Mechanism, site: Site, request: PlanRequest, rng: np.random.Generator) -> Plan:
    """The stations for this wish. Raises NotPlannable, and BadTable for a wish or a site that makes no sense."""
    pool = survey(chain, site, rng, request.reading, request.fixed, request.candidates, request.besides)
    good = criterion(request.criterion, pool.workspace.gamma)
    measured = 0 if pool.known is None else len(pool.known)
    least = max(min_stations(len(pool.parameters), request.reading) - measured, 1)
    curve: tuple[tuple[int, Claim], ...] = ()
    to_accuracy = request.stations is None and request.accuracy is not None
    if to_accuracy:
        count, curve = _how_many(pool, request, good, least, rng)
    else:
        count = request.stations or min(math.ceil(_USUAL * least), max(least, len(pool.q)))
        _require(count, least, len(pool.q))
    best = chosen_stations(pool, count, good, request.starts, rng)
    claim = pool.claim(best.q)
    if to_accuracy:  # the quick search that said how many does not refine
        for fewer in range(count - 1, max(count - _FEWER, least) - 1, -1):
            other = chosen_stations(pool, fewer, good, 1, rng)
            promised = pool.claim(other.q)
            if _measure(promised, request) > _requested(request):
                break
            best, claim = other, promised
        while _measure(claim, request) > _requested(request) and len(best.q) < len(pool.q):
            best = chosen_stations(pool, min(len(best.q) + 1, len(pool.q)), good, 1, rng)
            claim = pool.claim(best.q)
    count = len(best.q)
    way = through(pool, best.q, request.returns)
    information = best.rows.information(np.arange(count)) + (0.0 if pool.given is None else pool.given)
    return Plan(
        request,
        pool,
        best.q[way.order],
        way,
        claim,
        best.accuracy,
        observability(information, count + measured),
        tuple(random_accuracies(pool, count, rng)),
        best.values,
        curve,
    )


@dataclass(frozen=True)
class Chosen:
    """Stations (k, n), what they tell, the accuracy they give, and the criterion: one value a start, then refined."""

    q: Array
    rows: StationRows
    accuracy: Accuracy
    values: tuple[float, ...]


def chosen_stations(pool: PosturePool, count: int, good: Criterion, starts: int, rng: np.random.Generator) -> Chosen:
    """Best set of a number of stations: by exchange, then refined."""
    found = exchange(pool.rows, count, good, rng, starts, given=pool.given)
    q, rows, value = refined(pool, found, good, rng)
    accuracy = pool.accuracy(rows)
    return Chosen(q, rows, accuracy, (*found.starts, value))


def refined(
    pool: PosturePool, found: Exchange, good: Criterion, rng: np.random.Generator
) -> tuple[Array, StationRows, float]:
    """Stations (k, n) near those that were found and better, what they tell, and the criterion.

    Round by round every station gets candidates around it, allowed and seen, and the exchange goes on among these.
    """
    chain, site, count = pool.model.chain, pool.site, len(found.chosen)
    q, value = pool.q[found.chosen], found.value
    rows = pool.rows.of(found.chosen)
    for size in _REFINED:
        moved = np.repeat(q, _MOVED, axis=0)
        moved = np.clip(moved + size * rng.standard_normal(moved.shape), chain.lower, chain.upper)
        moved = moved[clearance(pool.spheres, site, moved) >= 0.0]
        moved = np.concatenate([q, moved[visible(pool.spheres, site, moved)]])
        more = station_rows(pool.model, pool.parameters, moved, pool.reading, site.noise, pool.rows.joint_variance)
        better = exchange(more, count, good, rng, begin=np.arange(count), given=pool.given)
        q, rows, value = moved[better.chosen], more.of(better.chosen), better.value
    return q, rows, value


def min_stations(parameters: int, reading: str) -> int:
    """The fewest stations from which ``modcal calibrate`` fits so many parameters: it fits to a share of them first."""
    equations = SHARES[0] * (6.0 if reading == "pose" else 3.0)
    return int(np.ceil(EQUATIONS_PER_PARAMETER * parameters / equations))


def through(pool: PosturePool, q: Array, returns: int = 0) -> Route:
    """The way through these stations, coming back to some of them, free of touching by the spheres."""

    def free(postures: Array) -> np.ndarray:
        return np.asarray(clearance(pool.spheres, pool.site, postures) >= 0.0)

    return route(q, free, pool.free_q, 0.5 * (q.min(axis=0) + q.max(axis=0)), returns)


def _require(count: int, least: int, there: int) -> None:
    if count < least:
        raise NotPlannable(f"{count} stations", f"modcal calibrate needs at least {least}", "ask for more stations")
    if count > there:
        said = f"only {there} of the postures tried are allowed and seen"
        raise NotPlannable(f"{count} stations", said, "ask for fewer, or widen the site")


def _requested(request: PlanRequest) -> float:
    assert request.accuracy is not None
    return request.accuracy


def _measure(claim: Claim, request: PlanRequest) -> float:
    """The upper end of the claim [m], of what was asked for."""
    return 1e-3 * claim.mm["rms" if request.measure == "rms" else "p95"].ci95[1]


def _how_many(
    pool: PosturePool, request: PlanRequest, good: Criterion, least: int, rng: np.random.Generator
) -> tuple[int, tuple[tuple[int, Claim], ...]]:
    """The smallest number of stations that meets the wish, by doubling and halving, and what was tried."""
    most = min(_MAX, len(pool.q))
    _require(least, least, len(pool.q))
    repeat = float(np.sqrt(np.mean(pool.workspace.repeat)))
    if repeat >= _requested(request):
        said = f"what the joints do not repeat alone makes {1e3 * repeat:.3g} mm RMS"
        remedy = "ask for less, or correct the noise of the site"
        raise NotPlannable(f"{request.measure} of {1e3 * _requested(request):.3g} mm", said, remedy)
    tried: dict[int, Claim] = {}

    def enough(count: int) -> bool:
        if count not in tried:
            chosen = exchange(pool.rows, count, good, rng, *_QUICK, given=pool.given).chosen
            tried[count] = pool.claim(pool.q[chosen])
        return _measure(tried[count], request) <= _requested(request)

    low, high = least, least
    while not enough(high):
        if high >= most:
            said = f"{high} stations leave {1e3 * _measure(tried[high], request):.3g} mm"
            remedy = "ask for less, use a better tracker, or measure poses"
            raise NotPlannable(f"{request.measure} of {1e3 * _requested(request):.3g} mm", said, remedy)
        low, high = high, min(2 * high, most)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high, tuple(sorted(tried.items()))
