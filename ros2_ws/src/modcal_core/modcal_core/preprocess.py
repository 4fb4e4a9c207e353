"""From a recording to samples: checked, on one clock, cut into stations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modcal_core.calibration import (
    Cell,
    Stated,
    choose_parameters,
    fit_cell,
    identify,
    own_statement,
    together_stated,
    views_of,
)
from modcal_core.effects.families import latency
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import Array
from modcal_core.measurements import (
    GLITCHES,
    LIMIT,
    MAX_GLITCHES,
    UNUSABLE,
    Cleaned,
    Dropped,
    Hung,
    Recording,
    Samples,
    StationRules,
    Stretch,
    align,
    at_steady_rate,
    cleaned,
    cut_stations,
    dropped,
    hung,
    other_joints,
    out_of_time,
    require_usable,
    spread_rows,
    together,
)
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import Mechanism, forward

_ROUNDS = 5  # iterations
_SETTLED = 1e-6  # s; in a shorter delay a tool at 1 m/s moves less than a micrometre
_EXPANDED = 2e-5  # rad or m: what an expansion may miss: less than an encoder's step of 18 bits
_MAX_OF = 95  # % of the samples that must be expanded so well; the rest are starts and stops
_MAX = 3000  # samples that a delay is fitted to
_PLAINLY = 0.9  # of what stamps leave, below which a steady rate fits better: of hundreds of readings beyond doubt
# s; a shorter delay is the cell's own, and belongs to the calibration as an effect; a longer one is a clock's
LONGEST_LATENCY = 0.025


@dataclass(frozen=True)
class Prepared:
    """Samples of a recording, what a person should know of how they came about, and how many readings are in none.

    stated: what instruments say of their own error, as far as the data bear it out. doubts: what makes a verdict open.
    """

    samples: Samples
    notes: tuple[str, ...]
    dropped: Dropped = ()
    stated: Stated = field(default_factory=Stated)
    doubts: tuple[str, ...] = ()


def prepare(
    recording: Recording,
    chain: Mechanism,
    rules: StationRules | None = None,
    clock_limit: float = LIMIT,
    since: float = -np.inf,
    until: float = np.inf,
) -> Prepared:
    """The samples of a recording for this arm. Raises BadRecording for what cannot be used.

    since, until: stamps [s] between which dropped readings are counted.
    """
    clean = cleaned(recording, chain.names, chain)
    require_usable(clean.recording, chain)
    timed = _timed(clean.recording, chain, rules, clock_limit, clean.spread)
    if timed.samples.moving.any():
        timed = _at_likelier_times(timed, clean, chain, rules, clock_limit)
    aligned, repeated, samples = timed.aligned, timed.hung, timed.samples
    samples = replace(samples, signals=(*samples.signals, *other_joints(aligned, samples)))
    unused = dropped(aligned, samples, rules, since, until)
    own = own_statement(aligned, chain.names, rules)
    elsewhere = out_of_time(aligned, chain.names, since, until)
    doubts = (*clean.doubts, *repeated.doubts, *_flickering(aligned, dict(unused), since, until), *elsewhere)
    lost = together([clean.lost, unused, repeated.dropped])
    notes = timed.recording.warnings + clean.notes + repeated.notes + timed.notes + own.notes
    return Prepared(samples, notes, lost, own.stated, doubts)


@dataclass(frozen=True)
class _Timed:
    """A recording with its readings on the joints' clock. recording, aligned: before and after, without what hung."""

    recording: Recording
    aligned: Recording
    hung: Hung
    samples: Samples
    notes: tuple[str, ...]


def _timed(
    recording: Recording, chain: Mechanism, rules: StationRules | None, clock_limit: float, spread: Sequence[str]
) -> _Timed:
    """The samples of a clean recording. spread: frames whose stamps are no instrument's: no delay is its own."""
    aligned, notes = align(recording, chain.names, lambda q: forward(chain, q), clock_limit)
    repeated = hung(aligned, chain.names)
    recording, aligned = repeated.left_out(recording), repeated.left_out(aligned)
    samples = cut_stations(aligned, chain.names, rules)
    if samples.moving.any():
        stood = np.isfinite(samples.sigma_position).any()
        # clocks are settled again, and said again if they are still off
        samples, notes = _settle_delays(recording, aligned, samples, chain, rules, spread)
        if not stood:
            said = "The arm was almost always moving: readings were used one by one, with interpolated postures."
            notes = (said, *notes)
    return _Timed(recording, aligned, repeated, samples, notes)


def _at_likelier_times(
    as_stamped: _Timed, clean: Cleaned, chain: Mechanism, rules: StationRules | None, clock_limit: float
) -> _Timed:
    """The samples by the stamps, or by the steady rates that these suggest, as the arm's motion has it."""
    said = {track.frame: at_steady_rate(track) for track in clean.recording.readings if track.frame not in clean.spread}
    frames = tuple(frame for frame, (_, why) in said.items() if why)
    if not frames:
        return as_stamped
    readings = tuple(said[t.frame][0] if t.frame in frames else t for t in clean.recording.readings)
    evenly = _timed(replace(clean.recording, readings=readings), chain, rules, clock_limit, (*clean.spread, *frames))
    both = as_stamped.samples, evenly.samples
    stamped, even = (dict(zip(s.frames, _delays(s, chain)[1], strict=True)) for s in both)
    if not all(even[f] < _PLAINLY * stamped[f] for f in frames):
        return as_stamped
    notes = (f"Readings in {f}: {said[f][1]}: these times fit the motion better and were taken." for f in frames)
    return replace(evenly, notes=(*notes, *evenly.notes))


def _flickering(recording: Recording, unused: dict[str, int], since: float, until: float) -> tuple[str, ...]:
    """Reasons for an open verdict: more than single readings are far from the others of their station."""
    wrong = unused.get(GLITCHES, 0)
    count = sum(int(np.sum((track.stamps >= since) & (track.stamps < until))) for track in recording.readings)
    at_rest = count - sum(n for reason, n in unused.items() if reason != GLITCHES)
    if wrong <= MAX_GLITCHES * at_rest:
        return ()
    return (
        f"{wrong} of {at_rest} readings taken at rest lie far from the others of their station and were left out "
        f"({wrong / at_rest:.0%}; up to {MAX_GLITCHES:.0%} may be wrong readings): see whether the tracker jumps "
        "between targets.",
    )


def prepare_pieces(
    pieces: Iterable[Stretch], chain: Mechanism, clock_limit: float = LIMIT, before: Samples | None = None
) -> Prepared:
    """The samples of all pieces, behind those from before. A piece that holds nothing to use is passed over.

    Raises BadRecording where none of them can be used.
    """
    samples, refused = before, None
    notes: dict[str, None] = {}
    doubts: dict[str, None] = {}
    lost: list[Dropped] = []
    stated: list[Stated] = []
    for piece in pieces:
        try:
            prepared = prepare(piece.recording, chain, None, clock_limit, piece.since, piece.until)
        except BadRecording as error:
            refused = error
            notes[f"One stretch was left out: {error}."] = None
            lost.append(((UNUSABLE, sum(len(track.stamps) for track in piece.recording.readings)),))
            continue
        notes.update(dict.fromkeys(prepared.notes))
        doubts.update(dict.fromkeys(prepared.doubts))
        lost.append(prepared.dropped)
        stated.append(prepared.stated)
        own = prepared.samples.between(piece.since, piece.until)
        samples = own if samples is None else samples.followed_by(own) if len(own) else samples
    if samples is None:
        raise refused or BadRecording("recording", "no message was received", "start the robot and the tracker")
    return Prepared(samples, tuple(notes), together(lost), together_stated(stated), tuple(doubts))


def _settle_delays(
    recording: Recording,
    aligned: Recording,
    samples: Samples,
    chain: Mechanism,
    rules: StationRules | None,
    spread: Sequence[str],
) -> tuple[Samples, tuple[str, ...]]:
    """The samples cut again with the readings of each frame on the joints' clock, as their motion shows it.

    Correlated speeds tell a delay to some ten milliseconds, which is many millimetres in motion. What is left is fitted
    together with the arm, so that the arm's own errors do not pose as delay; in a few rounds, for the fit is good to
    second order only. Delays as short as a driver's are then left in: they are not the clock's fault, and the
    diagnosis names them.
    """
    offset, drifts = _aligned_by(recording, aligned, samples.frames)
    rest = np.zeros(len(offset))
    for _ in range(_ROUNDS):
        step, _ = _delays(samples, chain)
        rest += step
        samples = cut_stations(_shifted(aligned, samples.frames, rest), chain.names, rules)
        if np.abs(step).max() < _SETTLED:
            break
    total = offset + rest
    as_recorded = cut_stations(_shifted(aligned, samples.frames, -offset), chain.names, rules)
    own = (np.abs(total) <= LONGEST_LATENCY) & ~drifts & ~np.isin(samples.frames, spread)
    own &= _within_reach(as_recorded, samples, total)
    samples = cut_stations(_shifted(aligned, samples.frames, np.where(own, -offset, rest)), chain.names, rules)
    said = tuple(
        f"Readings in {frame} were {1e3 * total[f]:+.2f} ms late, by their motion"
        + (", and their clock drifted" if drifts[f] else "")
        + "; their stamps were corrected."
        for f, frame in enumerate(samples.frames)
        if not own[f]
    )
    return samples, said


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
            out[f] = np.percentile(missed, _MAX_OF) < _EXPANDED
    return out


def _aligned_by(recording: Recording, aligned: Recording, frames: tuple[str, ...]) -> tuple[Array, np.ndarray]:
    """By how much aligning has shifted the readings of each frame [s], (F,), and whether by more and more, (F,)."""
    shifts = {
        before.frame: before.stamps - after.stamps
        for before, after in zip(recording.readings, aligned.readings, strict=True)
        if len(before.stamps)
    }
    each = [shifts[frame] for frame in frames]
    return np.array([np.median(s) for s in each]), np.array([np.ptp(s) > 1e-6 for s in each])


def _shifted(recording: Recording, frames: tuple[str, ...], delays: Array) -> Recording:
    late = dict(zip(frames, delays, strict=True))
    readings = tuple(replace(r, stamps=r.stamps - late.get(r.frame, 0.0)) for r in recording.readings)
    return replace(recording, readings=readings)


def _delays(samples: Samples, chain: Mechanism) -> tuple[Array, Array]:
    """Delay of the readings of each frame [s], (F,), and what a fit with it leaves [m], (F,); zero and infinite where
    nothing moves or the data cannot carry a fit.
    """
    out, left = np.zeros(len(samples.frames)), np.full(len(samples.frames), np.inf)
    for f in range(len(out)):
        rows = np.flatnonzero((samples.frame == f) & samples.moving & np.isfinite(samples.velocity).all(axis=1))
        if not len(rows) or not is_direct(np.unique(samples.kind[rows]).tolist()):
            continue
        few = samples.select(rows[spread_rows(len(rows), _MAX)])
        few = replace(few, frames=(samples.frames[f],), frame=np.zeros(len(few), int))
        late = latency.late().started(np.zeros(1))
        try:
            located = fit_cell(chain, few, Cell()).model
            choice = choose_parameters(located, views_of(few))
            fit = identify(located.with_effects((late,)), few, choice.parameters)
            out[f], left[f] = fit.model.effects[0].values[0], fit.noise.position
        except NotEnoughData:
            continue
    return out, left
