"""From a recording to samples: checked, on one clock, cut into stations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.effects import JOINTS, Effect
from modcal_core.calibration.identify import identify
from modcal_core.calibration.shapes import Shape
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import NotEnoughData
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.alignment import LIMIT, align
from modcal_core.measurements.checks import require_usable
from modcal_core.measurements.recording import Recording
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.stations import StationRules, cut_stations
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import frames

_ROUNDS = 5
_EXPANDED = 2e-5  # rad or m
_MOST = 3000  # samples that a delay is fitted to
# s; a shorter delay is the cell's own, and belongs to the calibration as an effect; a longer one is a clock's
LONGEST_LATENCY = 0.025


@dataclass(frozen=True)
class Prepared:
    """Samples of a recording, and what a person should know of how they came about."""

    samples: Samples
    notes: tuple[str, ...]


def prepare(
    recording: Recording, chain: Chain, rules: StationRules | None = None, clock_limit: float = LIMIT
) -> Prepared:
    """The samples of a recording for this arm. Raises BadRecording for what cannot be used."""
    require_usable(recording, chain)
    aligned, notes = align(recording, chain.names, lambda q: frames(chain, q).p[-1].T, clock_limit)
    samples = cut_stations(aligned, chain.names, rules)
    if samples.moving.any():
        if not np.isfinite(samples.sigma_position).any():
            said = "The arm hardly stood still: readings were used one by one, with postures interpolated."
            notes = (said,) if aligned is recording else (said, *notes)
        samples, notes = _settle_delays(recording, aligned, samples, chain, rules, notes)
    return Prepared(samples, recording.warnings + notes)


def _settle_delays(
    recording: Recording,
    aligned: Recording,
    samples: Samples,
    chain: Chain,
    rules: StationRules | None,
    notes: tuple[str, ...],
) -> tuple[Samples, tuple[str, ...]]:
    """The samples cut again with the readings of each frame on the joints' clock, as their motion shows it.

    Correlated speeds tell a delay to some ten milliseconds, which is many millimetres in motion. What is left is fitted
    together with the arm, so that the arm's own errors do not pose as delay; in a few rounds, for the fit is good to
    second order only. Delays as short as a driver's are then left in: they are not the clock's fault, and the
    diagnosis names them.
    """
    total = np.array([_offset(recording, aligned, frame) for frame in samples.frames])
    for _ in range(_ROUNDS):
        step = _delays(samples, chain)
        total += step
        samples = cut_stations(_shifted(recording, samples.frames, total), chain.names, rules)
        if np.abs(step).max() < 1e-6:
            break
    as_recorded = cut_stations(recording, chain.names, rules)
    clocks = np.where((np.abs(total) <= LONGEST_LATENCY) & _within_reach(as_recorded, samples, total), 0.0, total)
    samples = cut_stations(_shifted(recording, samples.frames, clocks), chain.names, rules)
    drops = tuple(n for n in notes if not n.startswith("The clock of"))
    said = tuple(
        f"Readings in {frame} were {1e3 * delay:+.2f} ms late, by their motion; their stamps were corrected."
        for frame, delay in zip(samples.frames, clocks, strict=True)
        if delay
    )
    return samples, drops + said


def _within_reach(late: Samples, exact: Samples, delay: Array) -> np.ndarray:
    """For each frame whether an effect of the second order in the delay says where the joints were, (F,)."""
    out = np.ones(len(delay), bool)
    for f, seconds in enumerate(delay):
        here, there = late.select(late.frame == f), exact.select(exact.frame == f)
        same = np.clip(np.searchsorted(there.stamps, here.stamps - seconds - 1e-5), 0, max(len(there) - 1, 0))
        rows = np.flatnonzero(np.abs(there.stamps[same] + seconds - here.stamps) < 1e-4) if len(there) else same[:0]
        if len(rows):
            expected = here.q - seconds * np.nan_to_num(here.velocity) + 0.5 * seconds**2 * here.acceleration
            missed = np.abs(there.q[same[rows]] - expected[rows]).max(axis=1)
            out[f] = np.percentile(missed, 95) < _EXPANDED
    return out


def _offset(recording: Recording, aligned: Recording, frame: str) -> float:
    """By how much aligning has shifted the readings of a frame [s]."""
    for before, after in zip(recording.readings, aligned.readings, strict=True):
        if before.frame == frame and len(before.stamps):
            return float(np.median(before.stamps - after.stamps))
    return 0.0


def _shifted(recording: Recording, frames: tuple[str, ...], delays: Array) -> Recording:
    late = dict(zip(frames, delays, strict=True))
    readings = tuple(replace(r, stamps=r.stamps - late.get(r.frame, 0.0)) for r in recording.readings)
    return replace(recording, readings=readings)


def _delays(samples: Samples, chain: Chain) -> Array:
    """Delay of the readings of each frame [s], (F,); zero where nothing moves or the data cannot carry a fit."""
    out = np.zeros(len(samples.frames))
    for f in range(len(out)):
        rows = np.flatnonzero((samples.frame == f) & samples.moving & np.isfinite(samples.velocity).all(axis=1))
        if not len(rows):
            continue
        few = samples.select(rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MOST)).astype(int))])
        few = replace(few, frames=(samples.frames[f],), frame=np.zeros(len(few), int))
        late = Effect("latency", "tracker", JOINTS, "velocity", Shape("linear")).started(np.zeros(1))
        try:
            located = fit_cell(chain, few, Cell()).model
            choice = choose_parameters(located, views_of(few))
            out[f] = identify(located.with_effects((late,)), few, choice.parameters).model.effects[0].values[0]
        except NotEnoughData:
            continue
    return out
