"""The stations to ask for next: for the fit, for the floor, to separate explanations, and for the proof."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.errors import NotPlannable
from modcal_core.geometry import Array
from modcal_core.measurements import LEFT, TRAVEL
from modcal_core.planning.deciding import DecidingStations, propose, undecided_by_posture
from modcal_core.planning.exchange import exchange, grown
from modcal_core.planning.outlook import Outlook, chance_seen, nominal_outlook
from modcal_core.planning.pool import Pool
from modcal_core.planning.refit import Refit
from modcal_core.planning.route import nearest_order
from modcal_core.planning.session import DECIDE, FIT, MEASURED, PROOF, RETURN, UNSEEN, Session, Station

_OFFERED = 800  # postures that are compared at once, for time
_PASSES = 2  # of the exchange that chooses the first stations; later ones take what it missed
_SAME = 1e-9  # rad or m; postures of a pool are asked for as they are


def _taken(pool: Pool, session: Session) -> np.ndarray:
    if pool.recorded:
        taken = np.zeros(len(pool.q), bool)
        taken[[s.row for s in session.stations]] = True
        return taken
    asked = np.array([s.asked for s in session.stations]).reshape(-1, pool.q.shape[1])
    return np.asarray((np.abs(pool.q[:, None] - asked[None]).max(axis=2) < _SAME).any(axis=1))


def _station(pool: Pool, j: int, role: str) -> Station:
    return Station(asked=pool.q[j], role=role, row=j if pool.recorded else -1)


def first_stations(pool: Pool, session: Session, count: int, planned: bool, rng: np.random.Generator) -> list[Station]:
    """The first ``count`` stations of a session; those not seen are made up for by others."""
    if planned and not session.stations:
        chosen = _far_apart(pool.q, count) if pool.ground is None else _best_for_nominal(pool, session, count, rng)
        q = pool.q[chosen]
        return [_station(pool, int(chosen[k]), FIT) for k in nearest_order(q, q.mean(axis=0))]
    return [_station(pool, j, FIT) for j in _at_random(pool, session, count - len(session.fitted))]


def _at_random(pool: Pool, session: Session, count: int) -> list[int]:
    # from the end: the stations of the proof, which are drawn from the beginning, stay what they would have been
    taken = _taken(pool, session)
    return [int(j) for j in pool.order[::-1] if not taken[j]][: max(count, 0)]


def _best_for_nominal(pool: Pool, session: Session, count: int, rng: np.random.Generator) -> np.ndarray:
    q = pool.q[np.setdiff1d(np.arange(len(pool.q)), pool.order)]
    view = nominal_outlook(pool, q, session.kind)
    return exchange(view.search(view.rows(q)), min(count, len(q)), rng, 1, _PASSES)


def _far_apart(q: Array, count: int) -> np.ndarray:
    """Numbers of postures far from each other: of a recording's base and tool nothing is known that would say more."""
    x = q / np.maximum(np.ptp(q, axis=0), 1e-6)
    chosen = [int(np.argmax(np.sum((x - x.mean(axis=0)) ** 2, axis=1)))]
    apart = np.sum((x - x[chosen[0]]) ** 2, axis=1)
    while len(chosen) < min(count, len(q)):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.sum((x - x[chosen[-1]]) ** 2, axis=1))
    return np.array(chosen)


@dataclass(frozen=True)
class Chooser:
    """Chooses stations for a fit. pool: from which. view: what they are worth. refitted: the model so far. planned:
    False takes them at random.
    """

    pool: Pool
    view: Outlook
    refitted: Refit
    planned: bool = True

    def best(
        self, session: Session, count: int, rng: np.random.Generator, first: int | None = None
    ) -> tuple[list[Station], Array]:
        """The ``count`` stations from which the fit gains most, and their rows (count, c, K).

        first: how many of them are to be measured: each is moved about where it is, while that is better; None: all.
        """
        pool, view = self.pool, self.view
        ways = rng.choice([-1.0, 1.0], pool.q.shape)
        if not self.planned:
            free = _at_random(pool, session, count)
            return [_station(pool, j, FIT) for j in free], view.rows(pool.q[free], ways[free])
        candidates = np.flatnonzero(~_taken(pool, session))
        candidates = candidates if pool.recorded else np.setdiff1d(candidates, pool.order)
        candidates = np.sort(rng.permutation(candidates)[: max(_OFFERED, 4 * count)])
        if not len(candidates):
            return [], np.zeros((0, 3, len(view.H)))
        q, ways = pool.q[candidates], ways[candidates]
        rows = view.rows(q, ways)
        chosen = grown(view.search(rows), count, self._chances(q, session))
        stations, rows = [_station(pool, int(candidates[j]), FIT) for j in chosen], rows[chosen]
        for k in range(0 if pool.recorded else len(chosen[:first])):
            near = pool.around(q[chosen[k]], rng)
            moved = view.rows(near, np.repeat(ways[chosen[k]][None], len(near), axis=0))
            (best,) = grown(view.search(moved), 1, self._chances(near, session))
            stations[k], rows[k] = replace(stations[k], asked=near[best]), moved[best]
            view = view.beside(moved[best][None])
        return stations, rows

    def _chances(self, q: Array, session: Session) -> Array:
        """Chance of each posture (N, n) to be seen, by what has and what has not been seen so far."""
        tried = [s for s in session.stations if s.state in (MEASURED, UNSEEN)]
        if not any(s.state == UNSEEN for s in tried):
            return np.ones(len(q))
        model = self.refitted.calibration.calibrated
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


def _separations(
    refitted: Refit, pool: Pool, count: int, rng: np.random.Generator
) -> Iterator[tuple[int, int, DecidingStations]]:
    """What separates each effect from each of its rivals, where as many postures are allowed."""
    calibration = refitted.calibration
    allowed = None if pool.ground is None else pool.ground.allowed
    for i, rivals in enumerate(calibration.rivals):
        for j in range(len(rivals)):
            with suppress(NotPlannable):
                yield i, j, propose(calibration, i, j, count, rng, allowed)


def deciding_stations(refitted: Refit, pool: Pool, count: int, rng: np.random.Generator) -> tuple[list[Station], str]:
    """Stations that separate explanations which the readings leave open, and which; none where no posture can."""
    for i, j, found in _separations(refitted, pool, count, rng):
        if not found.same and not undecided_by_posture(refitted.calibration, i, j):
            ways = [a if a.any() else None for a in found.approach]
            stations = [Station(asked=q, role=DECIDE, approach=a) for q, a in zip(found.q, ways, strict=True)]
            return stations, f"{found.effect.label} or {found.rival.label}"
    return [], ""


def one_motion(refitted: Refit, pool: Pool, rng: np.random.Generator) -> set[tuple[str, str]]:
    """Names of explanations that are one motion of the tool within what the arm may do: no posture separates them."""
    found = (found for _, _, found in _separations(refitted, pool, 1, rng))
    return {(f.effect.label, f.rival.label) for f in found if f.same}
