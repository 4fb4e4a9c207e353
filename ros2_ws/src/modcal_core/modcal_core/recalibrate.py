"""Calibrate again from all that was received, and compare with the model that is trusted.

The comparison is made on stations that the new fit has not seen and, where something has changed, only on those since:
before the change the trusted model was right.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from modcal_core.calibration import Calibration, Cell, errors, with_frames
from modcal_core.geometry import Array
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements import Dropped, Recording, Samples, Stretch, spread_rows, together
from modcal_core.outcome import Outcome, Trace, iso_date
from modcal_core.preprocess import prepare_pieces
from modcal_core.robots import Inertias, Mechanism

_MIN_COMPARED = 4  # stations; a standard error of fewer says nothing
_SURE = 2.0  # standard errors by which the new model must be better: one chance in forty to replace it for nothing
_WORTH = 0.9  # of the error before; a gain of less than a tenth is not worth a new calibration to all who use it


@dataclass(frozen=True)
class SampleMemory:
    """What a node remembers: whole recordings, oldest first, and the samples of those it keeps no more.

    dropped: what was left out of the latter, by reason.
    """

    recordings: tuple[Recording, ...]
    samples: Samples | None = None
    dropped: Dropped = ()

    def prepared(
        self, chain: Mechanism, clock_limit: float, most: int | None = None
    ) -> tuple[Samples, tuple[str, ...], Dropped]:
        """All samples, what to know of them, and what was left out; of more than ``most`` the older ones are thinned.

        A recording that holds nothing to use is passed over when there are others. Raises ModcalError.
        """
        pieces = (Stretch(recording) for recording in self.recordings)
        prepared = prepare_pieces(pieces, chain, clock_limit=clock_limit, before=self.samples)
        samples = replace(prepared.samples, origin=replace(prepared.samples.origin, doubts=prepared.doubts))
        lost = together([self.dropped, prepared.dropped])
        return (samples if most is None else thinned(samples, most)), prepared.notes, lost


@dataclass(frozen=True)
class ModelComparison:
    """RMS of the position error [m] before (trusted, or nominal) and after, on ``count`` held-out samples."""

    before: float
    after: float
    count: int
    better: bool


@dataclass(frozen=True)
class Job:
    """Everything a calibration needs, so that it can be done elsewhere.

    changed: stamp [s] since when something is different. trusted: what to compare with; None: the nominal arm. effects:
    whether to look for effects beyond the geometry.
    """

    collected: SampleMemory
    chain: Mechanism
    inertias: Inertias | None
    cell: Cell = field(default_factory=Cell)
    seed: int = 0
    clock_limit: float = 0.5
    changed: float | None = None
    trusted: Calibration | None = None
    effects: bool = True


@dataclass(frozen=True)
class Recalibration:
    """A calibration, its report, and how it compares with the one before."""

    result: Solution
    report: Outcome
    comparison: ModelComparison


def recalibrate(job: Job) -> Recalibration:
    """Calibrate again and compare. Raises ModcalError for data that cannot carry a fit."""
    samples, notes, lost = job.collected.prepared(job.chain, job.clock_limit)
    rng = np.random.default_rng(job.seed)
    result = calibrate(
        samples, job.chain, rng, job.cell, inertias=job.inertias, look_for_effects=job.effects, changed=job.changed
    )
    trace = Trace(date=iso_date(float(samples.stamps.min())))
    report = replace(result.report, title="live", notes=(*result.report.notes, *notes), trace=trace, dropped=lost)
    return Recalibration(result, report, _compare(job, result))


def _compare(job: Job, result: Solution) -> ModelComparison:
    scored, score = result.report.scored, result.report.errors
    own = () if job.trusted is None else job.trusted.calibrated.frames
    number = np.array([own.index(name) if name in own else -1 for name in scored.frames])
    known = np.flatnonzero(number[scored.frame] >= 0)
    if job.trusted is None or not len(known):  # what it says of an instrument that it does not know is nothing
        return compared(score["nominal"].position_norm, score["final"].position_norm)
    scored = scored.select(known)
    if job.changed is not None:
        since = scored.select(scored.stamps >= job.changed)
        scored = since if len(since) >= _MIN_COMPARED else scored
    before = errors(with_frames(job.trusted.calibrated, own), replace(scored, frames=own, frame=number[scored.frame]))
    after = errors(result.scored.model, scored).position_norm
    return compared(before.position_norm, after)


def compared(before: Array, after: Array) -> ModelComparison:
    """Two models' errors (N,) [m] on the same samples; better: surely, and by enough to be worth a change."""
    gain = before**2 - after**2
    count = len(gain)
    rms_before, rms_after = float(np.sqrt(np.mean(before**2))), float(np.sqrt(np.mean(after**2)))
    sure = count >= _MIN_COMPARED and gain.mean() > _SURE * gain.std(ddof=1) / np.sqrt(count)
    return ModelComparison(rms_before, rms_after, count, bool(sure and rms_after < _WORTH * rms_before))


def thinned(samples: Samples, most: int) -> Samples:
    """At most ``most`` samples: the newest half in full, the older ones thinned evenly."""
    if len(samples) <= most:
        return samples
    recent = most // 2
    older = spread_rows(len(samples) - recent, most - recent)
    return samples.select(np.r_[older, len(samples) - recent : len(samples)])
