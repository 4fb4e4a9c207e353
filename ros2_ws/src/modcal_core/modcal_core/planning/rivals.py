"""Which stations tell two explanations apart that the readings leave open.

If one effect is the truth, the other one and the geometry together can imitate it on what was recorded, but not
everywhere. What stations tell of the truth is the information about its size that all which imitates it leaves; its
square root is by how many standard deviations the best imitation misses (T-optimal design; Atkinson & Fedorov 1975).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
from modcal_core.measurements import Samples
from modcal_core.planning.chooser import Search, grown
from modcal_core.planning.outlook import information
from modcal_core.planning.pool import Pool, readings_at, survey
from modcal_core.planning.site import Site

DECIDES = 5.0  # standard deviations by which the explanations must differ over all proposed stations together
_ONE_MOTION = 0.0025  # of the squares, 5 % of the size: less is as good as one motion (that of a scan's candidates)
_CANDIDATES = 600  # postures that the best are taken from
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
    def name(self) -> str:
        """Both explanations."""
        return f"{self.effect.label} or {self.rival.label}"

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


def pool_near(calibration: Calibration, site: Site, rng: np.random.Generator) -> Pool:
    """Postures in and around the recorded range that are allowed and seen at a site. Raises NotPlannable."""
    chain, (low, high) = calibration.nominal.chain, _around(calibration)
    chain = chain.with_limits(np.maximum(chain.lower, low), np.minimum(chain.upper, high))
    return survey(chain, site, rng, calibration.kind, _CANDIDATES)


def _around(calibration: Calibration) -> tuple[Array, Array]:
    low, high = calibration.seen
    room = np.maximum(_BEYOND * (high - low), 0.5)
    return low - room, high + room


def propose(
    calibration: Calibration, effect: int, rival: int, count: int, rng: np.random.Generator, pool: Pool
) -> DecidingStations:
    """The ``count`` stations of a pool, in and around the recorded range, that best separate an effect from one of its
    rivals, each joint coming from either side. Raises NotPlannable where there are fewer.
    """
    model = calibration.calibrated
    truth, other = model.effects[effect], calibration.rivals[effect][rival]
    low, high = _around(calibration)
    q = pool.q[((pool.q >= low) & (pool.q <= high)).all(axis=1)][:_CANDIDATES]
    if len(q) < count:
        raise NotPlannable(f"{count} stations", f"{len(q)} postures are allowed", "ask for fewer, or widen the site")
    geometry = choose_parameters(model, [View(calibration.kind, 0)]).parameters
    imitation = model.with_effects((*(e for i, e in enumerate(model.effects) if i != effect), other))
    recorded = len(calibration.postures)
    q = np.concatenate([calibration.postures, q])
    ways = rng.choice([-1.0, 1.0], q.shape)
    exact = readings_at(model.with_effects(()), q, calibration.kind)
    samples = replace(exact, approach=ways, effort=np.full(q.shape, np.nan))
    rows = _rows(imitation, truth, geometry, samples, calibration.noise)
    K, bare = rows.shape[2], 1 + len(geometry)
    known = np.eye(K) + information(rows[:recorded])
    only_truth = np.diag(np.eye(K)[0])  # of all values its size alone counts
    chosen = recorded + np.array(grown(Search.of(rows[recorded:], known, only_truth), count))
    told, whole = _told(known + information(rows[chosen])) - _told(known), np.eye(K) + information(rows)
    directed = [e.place for e in (truth, other) if e.driver.startswith("direction:")]
    approach = np.where(np.isin(model.chain.names, directed), ways[chosen], 0.0)
    distinct = _told(whole) / max(_told(whole[:bare, :bare]), 1e-300)
    by_effort = any(part.startswith("effort:") for e in (truth, other) for part in e.driver.split(","))
    return DecidingStations(truth, other, q[chosen], approach, float(np.sqrt(told)), distinct, by_effort)


def _rows(
    imitation: Model, truth: Effect, geometry: Sequence[ModelParameter], samples: Samples, noise: NoiseModel
) -> Array:
    """In standard deviations of the readings the motion that the truth makes, first, and behind it derivatives of all
    that imitates it per prior deviation: of the geometry, then of effects, (N, c, K).
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


def undecided_by_posture(calibration: Calibration, effect: int, rival: int) -> str:
    """Why postures cannot distinguish an effect from a rival, with the remedy; "" where they can."""
    model = calibration.calibrated
    both = model.effects[effect], calibration.rivals[effect][rival]
    parts = [part.partition(":") for e in both for part in e.driver.split(",")]
    kinds = {kind for kind, _, _ in parts}
    weighed = model.arm is not None and model.arm.weighed
    if "effort" in kinds and not weighed:
        return "what the actuators will exert at other postures is not known: record stations with another payload"
    if kinds & {"time", "temperature"}:
        return "repeat some stations cold and warm, and some time later"
    if "signal" in kinds:
        topics = dict.fromkeys(topic for kind, _, topic in parts if kind == "signal" and topic)
        return f"record stations with other values of {' and '.join(topics)}"
    if "following" in kinds:
        return "record stations at which the joint is farther from its command"
    return "record stations in motion, fast and slow" if "velocity" in kinds else ""


def separations(
    calibration: Calibration, pool: Pool, count: int, rng: np.random.Generator
) -> Iterator[tuple[DecidingStations, str]]:
    """What separates each effect from each of its rivals, and "", or no stations and why postures cannot. Raises
    NotPlannable where fewer postures are allowed.
    """
    for i, rivals in enumerate(calibration.rivals):
        for j, rival in enumerate(rivals):
            instead = undecided_by_posture(calibration, i, j)
            if instead:
                effect, none = calibration.calibrated.effects[i], pool.q[:0]
                yield DecidingStations(effect, rival, none, none, 0.0), instead
            else:
                yield propose(calibration, i, j, count, rng, pool), ""


def deciding(
    calibration: Calibration, pool: Pool, count: int, rng: np.random.Generator
) -> tuple[DecidingStations | None, dict[str, str]]:
    """The first stations that separate two explanations; None if no posture does. By name of the pairs before: why."""
    why: dict[str, str] = {}
    with suppress(NotPlannable):
        for found, instead in separations(calibration, pool, count, rng):
            if not instead and not found.same:
                return found, why
            why[found.name] = instead or _one_motion(found)
    return None, why


def _one_motion(found: DecidingStations) -> str:
    """What would tell explanations that are one motion: another payload changes two loads alike."""
    loads = sum(" by load:" in e.label or " by payload:" in e.label for e in (found.effect, found.rival))
    payload = "another payload, or " if loads == 1 else ""
    return (
        "cannot tell: they are one motion of the tool, which no posture separates and either corrects; "
        f"{payload}a target on a link between them would tell"
    )
