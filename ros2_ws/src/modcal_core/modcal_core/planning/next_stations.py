"""The stations to ask for next: for the fit, for the floor, to separate explanations, and for the proof.

If one effect is the truth, the other one and the geometry together can imitate it on what was recorded, but not
everywhere. What stations tell of the truth is the information about its size that all which imitates it leaves; its
square root is by how many standard deviations the best imitation misses (T-optimal design; Atkinson & Fedorov 1975).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import (
    FINEST,
    Calibration,
    Model,
    ModelParameter,
    NoiseModel,
    RowView,
    View,
    choose_parameters,
    linearise,
)
from modcal_core.effects import Drivers, Effect, columns, prior_stds
from modcal_core.errors import NotPlannable
from modcal_core.geometry import Array
from modcal_core.measurements import LEFT, TRAVEL, Samples
from modcal_core.planning.exchange import Search, exchange, grown, information
from modcal_core.planning.outlook import Outlook, Refit, chance_seen, nominal_outlook
from modcal_core.planning.pool import Pool, readings_at
from modcal_core.planning.route import nearest_order
from modcal_core.planning.session import DECIDE, FIT, MEASURED, PROOF, RETURN, UNSEEN, Session, Station
from modcal_core.robots import random_postures

DECIDES = 5.0  # standard deviations by which the explanations must differ over all proposed stations together
_ONE_MOTION = (
    0.0025  # of the squares, 5 % of the size: what differs by less is as good as one (that of a scan's candidates)
)
_CANDIDATES = 600  # random postures that the best are taken from
_DRAWN = 40  # times as many, where only some are allowed
_BEYOND = 0.5  # of the recorded range, by which proposals may leave it


@dataclass(frozen=True)
class DecidingStations:
    """Stations that separate an effect from a rival.

    q: (k, n). approach: direction from which each joint should come, −1, 0 (any) or 1, (k, n). separation: by how many
    standard deviations the two explanations differ over these stations, once each has adapted itself. distinct: share
    of what geometry cannot imitate of the effect that the rival cannot imitate either, anywhere within the limits, in
    squares. by_effort: whether one goes by what actuators exert, for which gravity stands in at new postures.
    """

    effect: Effect
    rival: Effect
    q: Array
    approach: Array
    separation: float
    distinct: float = 1.0
    by_effort: bool = False

    @property
    def decides(self) -> bool:
        """Whether recording these stations distinguishes the two explanations."""
        return self.separation >= DECIDES

    @property
    def same(self) -> bool:
        """Whether the two are one motion within the limits, however often it is measured, as far as is known."""
        return self.distinct < _ONE_MOTION

    @property
    def needed(self) -> int:
        """How many stations as good as these it takes to settle it."""
        return int(np.ceil(len(self.q) * (DECIDES / max(self.separation, 1e-3)) ** 2))


def propose(
    calibration: Calibration,
    effect: int,
    rival: int,
    count: int,
    rng: np.random.Generator,
    allowed: Callable[[Array], np.ndarray] | None = None,
) -> DecidingStations:
    """The ``count`` stations, of many within the joint limits, that best separate an effect from one of its rivals.

    allowed: says of postures (N, n) which may be proposed, (N,). Raises NotPlannable where fewer than count may.
    """
    model = calibration.calibrated
    truth, other = model.effects[effect], calibration.rivals[effect][rival]
    rest = tuple(e for i, e in enumerate(model.effects) if i != effect)
    samples = _candidates(calibration, rng, allowed)
    recorded = len(calibration.postures)
    if len(samples) < recorded + count:
        said = f"only {len(samples) - recorded} postures are allowed"
        raise NotPlannable(f"{count} stations", said, "ask for fewer, or widen the site")
    geometry = choose_parameters(model, [View(calibration.kind, 0)]).parameters
    rows = _rows(model.with_effects((*rest, other)), truth, geometry, samples, calibration.noise)
    K = rows.shape[2]
    at_first = np.eye(K) + information(rows[:recorded])
    only_truth = np.diag(np.eye(K)[0])
    new = recorded + np.array(grown(Search.of(rows[recorded:], at_first, only_truth), count))
    told = _told(at_first + information(rows[new])) - _told(at_first)
    whole, bare = np.eye(K) + information(rows), 1 + len(geometry)
    directed = {e.place for e in (truth, other) if e.driver.startswith("direction:")}
    approach = np.where(np.isin(samples.names, list(directed)), samples.approach[new], 0.0)
    distinct = _told(whole) / max(_told(whole[:bare, :bare]), 1e-300)
    by_effort = any(part.startswith("effort:") for e in (truth, other) for part in e.driver.split(","))
    return DecidingStations(truth, other, samples.q[new], approach, float(np.sqrt(told)), distinct, by_effort)


def undecided_by_posture(calibration: Calibration, effect: int, rival: int) -> str:
    """Why postures cannot distinguish an effect from a rival, with the remedy; "" where they can."""
    model = calibration.calibrated
    both = model.effects[effect], calibration.rivals[effect][rival]
    kinds = {part.partition(":")[0] for e in both for part in e.driver.split(",")}
    weighed = model.arm is not None and model.arm.weighed
    if "effort" in kinds and not weighed:
        return "what the actuators will exert at other postures is not known: record stations with another payload"
    if kinds & {"time", "temperature"}:
        return "repeat some stations cold and warm, and some time later"
    if "signal" in kinds:
        of = dict.fromkeys(
            part.partition(":")[2] for e in both for part in e.driver.split(",") if part.startswith("signal:")
        )
        return f"record stations with other values of {' and '.join(of)}"
    if "following" in kinds:
        return "record stations at which the joint is farther from its command"
    return "record stations in motion, fast and slow" if "velocity" in kinds else ""


def _candidates(
    calibration: Calibration, rng: np.random.Generator, allowed: Callable[[Array], np.ndarray] | None
) -> Samples:
    """Recorded postures, then random allowed ones in and around their range, each approached from either side."""
    model = calibration.calibrated
    low, high = calibration.seen
    room = np.maximum(_BEYOND * (high - low), 0.5)
    chain = model.chain.with_limits(
        np.maximum(model.chain.lower, low - room), np.minimum(model.chain.upper, high + room)
    )
    drawn = random_postures(chain, _CANDIDATES if allowed is None else _DRAWN * _CANDIDATES, rng)
    drawn = drawn if allowed is None else drawn[allowed(drawn)][:_CANDIDATES]
    q = np.concatenate([calibration.postures, drawn])
    exact = readings_at(model.with_effects(()), q, calibration.kind)
    return replace(exact, approach=rng.choice([-1.0, 1.0], q.shape), effort=np.full(q.shape, np.nan))


def _rows(
    imitation: Model, truth: Effect, geometry: Sequence[ModelParameter], samples: Samples, noise: NoiseModel
) -> Array:
    """In standard deviations of the readings the motion that one explanation makes, first, and behind it derivatives of
    all that imitates it per prior deviation: of the geometry, then of effects, (N, c, K).
    """
    at = Drivers(samples, imitation.arm or imitation.drivers(samples).arm)
    values = np.concatenate([np.zeros(len(geometry)), *(e.values for e in imitation.effects)])
    view = RowView.of(imitation.with_effects(()), samples, at)
    terms = zip(truth.amplitudes, columns(truth, at), strict=True)
    moved = np.sum([amplitude * view.moved_by(term) for amplitude, term in terms], axis=0)
    prior = np.concatenate([[p.prior_std for p in geometry], *(prior_stds(e, at) for e in imitation.effects)])
    J = np.vstack([moved, linearise(imitation, geometry, values, samples, drivers=at).J * prior[:, None]])
    N = len(samples)
    J[:, : 3 * N] /= np.maximum(noise.of(samples), FINEST).max()
    J[:, 3 * N :] /= max(noise.rotation, FINEST)
    return np.asarray(J.reshape(len(J), -1, N).transpose(2, 1, 0))


def _told(H: Array) -> float:
    """How far the first value is from what the others imitate of it, in variances, by information H (K, K)."""
    return max(1.0 / float(np.linalg.inv(H)[0, 0]) - 1.0, 0.0)


# --- For the fit, for the floor, and for the proof

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
