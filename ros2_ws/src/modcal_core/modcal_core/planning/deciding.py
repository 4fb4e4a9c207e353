"""Stations that tell two explanations of the same error apart.

If one effect is the truth, the other one and the geometry together can imitate it on what was recorded, but not
everywhere. What stations tell of the truth is the information about its size that all which imitates it leaves; its
square root is by how many standard deviations the best imitation misses (T-optimal design; Atkinson & Fedorov 1975).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from modcal_core.planning.closed_chain import readings_at
from modcal_core.planning.criteria import ACCURACY, Criterion
from modcal_core.planning.exchange import Search, grown, information
from modcal_core.robots import random_postures

DECIDES = 5.0  # standard deviations by which the explanations must differ over all proposed stations together
_SAME = 0.0025  # of the squares, 5 % of the size: what differs by less is as good as one (that of a scan's candidates)
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
        return self.distinct < _SAME

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
    only_truth = Criterion(ACCURACY, np.diag(np.eye(K)[0]))
    new = recorded + np.array(grown(Search.of(rows[recorded:], only_truth, at_first), count))
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
