"""Stations that tell two explanations of the same error apart.

If one effect is the truth, the other one and the geometry together can imitate it on what was recorded, but not
everywhere. The imitation is fitted to what was recorded; where it then misses the truth by most, a station says which
of the two it is. That station is added to what is imitated, and so on (T-optimal design; Atkinson & Fedorov 1975).
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
    exact_samples,
    linearise,
)
from modcal_core.effects import Drivers, Effect, columns, prior_stds
from modcal_core.errors import NotPlannable
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import KIND_NAMES
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
    rows = _Rows.of(model.with_effects((*rest, other)), truth, geometry, samples, calibration.noise)
    chosen = list(range(recorded))
    for _ in range(count):
        missed = rows.missed(chosen)
        missed[chosen] = 0.0
        chosen.append(int(np.argmax(missed)))
    new = np.array(chosen[recorded:])
    separation = float(np.sqrt(np.sum(rows.missed(chosen)[new])))
    directed = {e.place for e in (truth, other) if e.driver.startswith("direction:")}
    approach = np.where(np.isin(samples.names, list(directed)), samples.approach[new], 0.0)
    everywhere = list(range(len(samples)))
    own, left = (float(np.sum(r.missed(everywhere))) for r in (rows.without_effects(len(geometry)), rows))
    by_effort = any(part.startswith("effort:") for e in (truth, other) for part in e.driver.split(","))
    return DecidingStations(truth, other, samples.q[new], approach, separation, left / max(own, 1e-300), by_effort)


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
    N = len(q)
    exact = exact_samples(model.with_effects(()), q, np.zeros(N, int), np.full(N, calibration.kind, dtype=KIND_NAMES))
    return replace(exact, approach=rng.choice([-1.0, 1.0], q.shape), effort=np.full(q.shape, np.nan))


@dataclass(frozen=True)
class _Rows:
    """What tells two explanations apart, in standard deviations of the readings. difference: the motion that one makes
    (N, c). J: derivatives of all that imitates it (N, c, K). prior: standard deviations (K,).
    """

    difference: Array
    J: Array
    prior: Array

    @classmethod
    def of(
        cls, imitation: Model, truth: Effect, geometry: Sequence[ModelParameter], samples: Samples, noise: NoiseModel
    ) -> _Rows:
        at = Drivers(samples, imitation.arm or imitation.drivers(samples).arm)
        values = np.concatenate([np.zeros(len(geometry)), *(e.values for e in imitation.effects)])
        J = linearise(imitation, geometry, values, samples, drivers=at).J
        view = RowView.of(imitation.with_effects(()), samples, at)
        moved = np.sum(
            [a * view.moved_by(t) for a, t in zip(truth.amplitudes, columns(truth, at), strict=True)], axis=0
        )
        N = len(samples)
        weight = np.full(len(moved), 1.0 / np.maximum(noise.of(samples), FINEST).max())
        weight[3 * N :] = 1.0 / max(noise.rotation, FINEST)
        prior = np.concatenate([[p.prior_std for p in geometry], *(prior_stds(e, at) for e in imitation.effects)])
        return cls((moved * weight).reshape(-1, N).T, (J * weight).reshape(len(J), -1, N).transpose(2, 1, 0), prior)

    def without_effects(self, geometry: int) -> _Rows:
        """The same where geometry alone imitates."""
        return replace(self, J=self.J[..., :geometry], prior=self.prior[:geometry])

    def missed(self, chosen: list[int]) -> Array:
        """Squared miss at every station (N,), in variances, of the imitation fitted to the chosen ones."""
        K = self.J.shape[2]
        A, b = self.J[chosen].reshape(-1, K), self.difference[chosen].ravel()
        A, b = np.concatenate([A, np.diag(1.0 / self.prior)]), np.concatenate([b, np.zeros(K)])
        return np.asarray(np.sum((self.difference - self.J @ np.linalg.lstsq(A, b, rcond=1e-12)[0]) ** 2, axis=1))
