"""The stations to ask for next: for the fit, for the floor, to separate explanations, and for the proof."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import NotPlannable
from modcal_core.geometry import Array
from modcal_core.measurements import LEFT, TRAVEL
from modcal_core.measuring.outlook import Outlook, chance_seen
from modcal_core.measuring.refit import Refit
from modcal_core.measuring.session import DECIDE, FIT, MEASURED, PROOF, RETURN, UNSEEN, Session, Station
from modcal_core.planning import (
    ACCURACY,
    CANDIDATES,
    Site,
    clearance,
    criterion,
    exchange,
    propose,
    survey,
    undecided_by_posture,
    visible,
)
from modcal_core.robots import Mechanism

_AHEAD = 400  # postures that stand for where accuracy counts, for time
_PASSES = 2  # of the exchange that chooses the first stations; later ones take what it missed
_MOVED = (0.3, 0.1)  # rad or m by which a chosen posture is moved in search of a better one
_TRIED = 24  # postures around it, each time


@dataclass(frozen=True)
class Pool:
    """q: postures to choose from (N, n). where: postures (M, n) that stand for where accuracy counts. order: numbers of
    q in the order in which they are drawn at random. first: numbers of q that are best to begin with, the best first.
    allowed: says of postures (N, n) whether the arm may take them and they should be seen; None where only q exist.
    recorded: q are stations of a recording, each of which can be measured once.
    """

    q: Array
    where: Array
    order: np.ndarray
    first: Callable[[int], np.ndarray]
    allowed: Callable[[Array], np.ndarray] | None
    lower: Array
    upper: Array
    recorded: bool = False

    def around(self, q: Array, rng: np.random.Generator) -> Array:
        """Postures near q (n,) that are allowed, itself first, (k, n)."""
        if self.allowed is None:
            return q[None]
        moved = [q + size * rng.standard_normal((_TRIED, len(q))) for size in _MOVED]
        near = np.clip(np.concatenate(moved), self.lower, self.upper)
        return np.concatenate([q[None], near[self.allowed(near)]])


def of_robot(chain: Mechanism, site: Site, kind: str, rng: np.random.Generator, candidates: int = CANDIDATES) -> Pool:
    """Postures of a robot at a site: within limits, touching nothing, seen by the instrument. Raises NotPlannable."""
    there = survey(chain, site, rng, kind, (), 2 * candidates)
    if len(there.q) < 2 * _TRIED:
        said = f"only {len(there.q)} of the postures tried are allowed and seen"
        raise NotPlannable("measuring", said, "widen limits, or correct radii, floor and the tracker's place")
    # one half is chosen from, the other half is drawn from: what proves must not be near what was fitted by design
    half = len(there.q) // 2
    mixed = there.q[rng.permutation(len(there.q))]
    drawn = mixed[half:]
    if site.box is not None:
        at = there.model.predict(drawn)[:, :3, 3] + site.still
        drawn = drawn[((at >= site.box[0]) & (at <= site.box[1])).all(axis=1)]
        if not len(drawn):
            raise NotPlannable("workspace box", "no allowed posture holds the target in it", "correct box_m")
    good = criterion(ACCURACY, there.workspace.gamma)
    seed = int(rng.integers(1 << 31))

    def first(count: int) -> np.ndarray:
        found = exchange(there.rows, min(count, len(there.q)), good, np.random.default_rng(seed), 1, _PASSES)
        return found.chosen

    limits = there.model.chain
    return Pool(
        q=np.concatenate([there.q, drawn]),
        where=drawn[:_AHEAD],
        order=len(there.q) + np.arange(len(drawn)),
        first=first,
        allowed=lambda q: np.asarray((clearance(there.spheres, site, q) >= 0.0) & visible(there.spheres, site, q)),
        lower=np.asarray(limits.lower),
        upper=np.asarray(limits.upper),
    )


def of_recording(q: Array, rng: np.random.Generator) -> Pool:
    """The stations (N, n) of a recording."""
    order = rng.permutation(len(q))
    where = q[order[:_AHEAD]]

    def first(count: int) -> np.ndarray:
        """Postures far from each other: nothing is known of base and tool that would say more."""
        scale = np.maximum(np.ptp(q, axis=0), 1e-6)
        x = q / scale
        chosen = [int(np.argmax(np.sum((x - x.mean(axis=0)) ** 2, axis=1)))]
        apart = np.sum((x - x[chosen[0]]) ** 2, axis=1)
        while len(chosen) < min(count, len(q)):
            chosen.append(int(np.argmax(apart)))
            apart = np.minimum(apart, np.sum((x - x[chosen[-1]]) ** 2, axis=1))
        return np.array(chosen)

    return Pool(q, where, order, first, None, q.min(axis=0), q.max(axis=0), recorded=True)


_OFFERED = 800  # postures that are compared at once, for time
_SAME = 1e-9  # rad or m; postures of a pool are asked for as they are


@dataclass(frozen=True)
class Batch:
    """Stations to ask for, and the information (K, K) after each of them."""

    stations: list[Station]
    after: list[Array]


def _taken(pool: Pool, session: Session) -> np.ndarray:
    if pool.recorded:
        taken = np.zeros(len(pool.q), bool)
        taken[[s.row for s in session.stations]] = True
        return taken
    asked = np.array([s.asked for s in session.stations]).reshape(-1, pool.q.shape[1])
    return np.asarray((np.abs(pool.q[:, None] - asked[None]).max(axis=2) < _SAME).any(axis=1))


def _station(pool: Pool, j: int, role: str) -> Station:
    return Station(asked=pool.q[j], role=role, row=j if pool.recorded else -1)


def first_stations(pool: Pool, session: Session, count: int, planned: bool) -> list[Station]:
    """The first ``count`` stations of a session; those not seen are made up for by others."""
    missing = count - len(session.fitted)
    taken = _taken(pool, session)
    if planned and not session.stations:
        chosen = pool.first(count)
        return [_station(pool, int(j), FIT) for j in in_order(pool.q, chosen, None)]
    # from the end: the stations of the proof, which are drawn from the beginning, stay what they would have been
    free = [int(j) for j in pool.order[::-1] if not taken[j]]
    return [_station(pool, j, FIT) for j in free[:missing]]


def fit_stations(
    pool: Pool,
    session: Session,
    view: Outlook,
    refitted: Refit,
    count: int,
    planned: bool,
    rng: np.random.Generator,
    first: int | None = None,
) -> Batch:
    """The ``count`` stations from which the fit gains most (planned), or as many at random.

    first: how many of them are to be measured: each is moved about where it is, while that is better; None: all.
    """
    taken = _taken(pool, session)
    ways = rng.choice([-1.0, 1.0], pool.q.shape)
    if not planned:
        free = [int(j) for j in pool.order[::-1] if not taken[j]][:count]
        J = view.rows(pool.q[free], ways[free])
        after, H = [], view.H
        for rows in J:
            H = H + rows.T @ rows
            after.append(H)
        return Batch([_station(pool, j, FIT) for j in free], after)
    candidates = np.flatnonzero(~taken)
    candidates = np.setdiff1d(candidates, pool.order) if not pool.recorded else candidates
    candidates = np.sort(rng.permutation(candidates)[: max(_OFFERED, 4 * count)])
    q = pool.q[candidates]
    if not len(q):
        return Batch([], [])
    weight = _chances(q, session, refitted)
    J = view.rows(q, ways[candidates])
    chosen, after = view.best(J, weight, count)
    if pool.recorded:
        return Batch([_station(pool, int(candidates[j]), FIT) for j in chosen], after)
    stations, H, after = [], view.H, []
    for j in chosen[:first]:
        near = pool.around(q[j], rng)
        J_near = view.rows(near, np.repeat(ways[candidates[j]][None], len(near), axis=0))
        (best,), (H,) = view.best(J_near, _chances(near, session, refitted), 1, H)
        stations.append(Station(asked=near[best], role=FIT))
        after.append(H)
    for j in chosen[len(stations) :]:
        H = H + J[j].T @ J[j]
        stations.append(Station(asked=q[j], role=FIT))
        after.append(H)
    return Batch(stations, after)


def _chances(q: Array, session: Session, refitted: Refit) -> Array:
    """Chance of each posture (N, n) to be seen, by what has and what has not been seen so far."""
    tried = [s for s in session.stations if s.state in (MEASURED, UNSEEN)]
    if not any(s.state == UNSEEN for s in tried):
        return np.ones(len(q))
    model = refitted.calibration.calibrated
    T, known = model.predict(q), model.predict(np.array([s.asked for s in tried]))
    seen = np.array([s.state == MEASURED for s in tried])
    return chance_seen(T[:, :3, 3], T[:, :3, 2], known[:, :3, 3], known[:, :3, 2], seen)


def proof_stations(pool: Pool, session: Session, count: int) -> list[Station]:
    """The next stations at random: drawn once and for all, whatever has been measured since."""
    taken = _taken(pool, session)
    free = [int(j) for j in pool.order if not taken[j]]
    return [_station(pool, j, PROOF) for j in free[:count]]


def return_stations(session: Session, count: int) -> list[Station]:
    """Stations to come back to, each from another side than the first time, and none twice."""
    again = {s.row for s in session.stations if s.role == RETURN}
    rows = [i for i in session.rows(FIT) if i not in again]
    samples = session.samples(rows)
    q, way = samples.q, samples.approach
    last = next((s.q for s in reversed(session.stations) if s.state == MEASURED and s.q is not None), q[0])
    out: list[Station] = []
    free = np.ones(len(rows), bool)
    while len(out) < count:
        step = q - last
        side = np.where(np.abs(step) > TRAVEL, np.sign(step), 0.0)
        other = np.mean(side * way < 0.0, axis=1)
        other[~free | (np.abs(step).max(axis=1) <= LEFT)] = 0.0
        k = int(np.argmax(other))
        if other[k] == 0.0:
            break
        free[k] = False
        out.append(Station(asked=q[k], role=RETURN, row=rows[k]))
        last = q[k]
    return out


def deciding_stations(refitted: Refit, pool: Pool, count: int, rng: np.random.Generator) -> tuple[list[Station], str]:
    """Stations that separate explanations which the readings leave open, and which; none where no posture can."""
    calibration = refitted.calibration
    for i, rivals in enumerate(calibration.rivals):
        for j in range(len(rivals)):
            if undecided_by_posture(calibration, i, j):
                continue
            try:
                found = propose(calibration, i, j, count, rng, pool.allowed)
            except NotPlannable:
                continue
            if not found.same:
                ways = [a if a.any() else None for a in found.approach]
                stations = [Station(asked=q, role=DECIDE, approach=a) for q, a in zip(found.q, ways, strict=True)]
                return stations, f"{found.effect.label} or {found.rival.label}"
    return [], ""


def one_motion(refitted: Refit, pool: Pool, rng: np.random.Generator) -> set[tuple[str, str]]:
    """Names of explanations that are one motion of the tool within what the arm may do: no posture separates them."""
    calibration = refitted.calibration
    out = set()
    for i, rivals in enumerate(calibration.rivals):
        for j in range(len(rivals)):
            try:
                found = propose(calibration, i, j, 1, rng, pool.allowed)
            except NotPlannable:
                continue
            if found.same:
                out.add((found.effect.label, found.rival.label))
    return out


def in_order(q: Array, chosen: Sequence[int] | np.ndarray, begin: Array | None) -> list[int]:
    """The chosen postures' numbers, each the nearest to the one before it."""
    left = [int(j) for j in chosen]
    here = q[left].mean(axis=0) if begin is None else begin
    out: list[int] = []
    while left:
        nearest = min(left, key=lambda j: float(np.abs(q[j] - here).max()))
        left.remove(nearest)
        out.append(nearest)
        here = q[nearest]
    return out
