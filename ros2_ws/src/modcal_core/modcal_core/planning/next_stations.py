"""The stations to ask for next: for the fit, for the floor, to separate explanations, and for the proof."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements import LEFT, directions
from modcal_core.planning.chooser import Chooser
from modcal_core.planning.outlook import Outlook, Refit, nominal_outlook
from modcal_core.planning.pool import Pool
from modcal_core.planning.rivals import DecidingStations
from modcal_core.planning.session import DECIDE, FIT, MEASURED, PROOF, RETURN, UNSEEN, Session, Station

_OFFERED = 800  # postures that are compared at once, for time
_MOVES = (0.3, 0.1)  # rad or m by which a station is moved in search of a better one
_ROUNDS = 2  # of the exchange that chooses the first stations; later ones take what it missed
_NEAR, _FACING = 0.3, 0.7  # m, rad: places and directions that a tracker sees alike
_SEEN_FIRST = 0.95  # chance that a posture is seen where nothing near was tried; weighs as much as one station
_SAME = 1e-9  # rad or m; postures of a pool are asked for as they are


def _untaken(pool: Pool, session: Session) -> np.ndarray:
    """True for postures of the pool that were not asked for, (N,)."""
    if pool.recorded:
        return ~np.isin(np.arange(len(pool.q)), [s.row for s in session.stations])
    asked = np.array([s.asked for s in session.stations]).reshape(-1, pool.q.shape[1])
    return ~(np.abs(pool.q[:, None] - asked[None]).max(axis=2) < _SAME).any(axis=1)


def _stations(pool: Pool, numbers: np.ndarray, role: str = FIT) -> list[Station]:
    return [Station(asked=pool.q[j], role=role, row=int(j) if pool.recorded else -1) for j in numbers]


def proof_stations(pool: Pool, session: Session, count: int) -> list[Station]:
    """The next stations at random: drawn once and for all, whatever has been measured since."""
    return _stations(pool, pool.order[_untaken(pool, session)[pool.order]][:count], PROOF)


def random_stations(pool: Pool, session: Session, count: int) -> list[Station]:
    """Stations at random for the fit: from the other end, so that those of the proof stay what they would have been."""
    last = pool.order[::-1]
    return _stations(pool, last[_untaken(pool, session)[last]][: max(count, 0)])


def first_stations(pool: Pool, session: Session, count: int, rng: np.random.Generator) -> list[Station]:
    """The first ``count`` stations of a session; those not seen are made up for by others."""
    if session.stations:
        return random_stations(pool, session, count - len(session.fitted))
    if pool.recorded:
        return _stations(pool, _far_apart(pool.q, count))
    view, offered = nominal_outlook(pool, session.kind), pool.offered
    return _stations(pool, offered[Chooser(view, rounds=_ROUNDS).best(pool.q[offered], count, rng).numbers])


def _far_apart(q: Array, count: int) -> np.ndarray:
    """Numbers of postures far from each other: of a recording's base and tool nothing is known that would say more."""
    x = q / np.maximum(np.ptp(q, axis=0), 1e-6)
    chosen = [int(np.argmax(np.sum((x - x.mean(axis=0)) ** 2, axis=1)))]
    apart = np.sum((x - x[chosen[0]]) ** 2, axis=1)
    while len(chosen) < min(count, len(q)):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.sum((x - x[chosen[-1]]) ** 2, axis=1))
    return np.array(chosen)


def best_stations(
    pool: Pool, view: Outlook, refitted: Refit, session: Session, count: int, first: int, rng: np.random.Generator
) -> tuple[list[Station], Array]:
    """The ``count`` stations from which the fit gains most, and their rows (count, c, K). first: so many of them are to
    be measured: they are moved about where they are, while that is better.
    """
    offered = pool.offered[_untaken(pool, session)[pool.offered]]
    offered = np.sort(rng.permutation(offered)[: max(_OFFERED, 4 * count)])
    if not len(offered):
        return [], np.zeros((0, 3, len(view.H)))
    ways = rng.choice([-1.0, 1.0], (len(offered), pool.q.shape[1]))
    chooser = Chooser(view, pool.ground, _MOVES, chance=lambda q: _chances(refitted, session, q))
    found = chooser.best(pool.q[offered], count, rng, ways, first)
    rows = offered[found.numbers] if pool.recorded else np.full(len(found.q), -1)
    return [Station(asked=q, row=int(j)) for q, j in zip(found.q, rows, strict=True)], found.rows


def _chances(refitted: Refit, session: Session, q: Array) -> Array:
    """Chance of each posture (N, n) to be seen: a kernel estimate over where the tool was and was not seen before."""
    tried = [s for s in session.stations if s.state in (MEASURED, UNSEEN)]
    seen = np.array([s.state == MEASURED for s in tried])
    if seen.all():
        return np.ones(len(q))
    model = refitted.calibration.calibrated
    T, known = model.predict(q)[:, None], model.predict(np.array([s.asked for s in tried]))
    apart = np.sum((T[..., :3, 3] - known[:, :3, 3]) ** 2, axis=2) / _NEAR**2
    turned = np.sum((T[..., :3, 2] - known[:, :3, 2]) ** 2, axis=2) / _FACING**2
    weight = np.exp(-0.5 * (apart + turned))
    return np.asarray((weight @ seen + _SEEN_FIRST) / (weight.sum(axis=1) + 1.0))


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
        other = np.mean(directions(step) * way < 0.0, axis=1)
        other[~free | (np.abs(step).max(axis=1) <= LEFT)] = 0.0
        k = int(np.argmax(other))
        if other[k] == 0.0:
            break
        free[k] = False
        out.append(Station(asked=q[k], role=RETURN, row=rows[k]))
        last = q[k]
    return out


def deciding_stations(found: DecidingStations) -> list[Station]:
    """The stations that separate two explanations."""
    ways = [a if a.any() else None for a in found.approach]
    return [Station(asked=q, role=DECIDE, approach=a) for q, a in zip(found.q, ways, strict=True)]
