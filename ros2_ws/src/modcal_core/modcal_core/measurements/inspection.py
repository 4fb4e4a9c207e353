"""What is in a recording, what it can be used for, and what looks wrong, without fitting anything.

A tracker that begins earlier than the joint states, or goes on, loses nothing. Where as long a part of these has no
reading as the readings outside take, they are that part: an hour away since summer time ended, or a day.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.errors import ModcalError
from modcal_core.geometry import Array
from modcal_core.measurements.alignment import at_steady_rate
from modcal_core.measurements.checks import require_usable
from modcal_core.measurements.dropouts import MAX_GLITCHES, cleaned, hung
from modcal_core.measurements.dwells import MIN_RETURNS, StationRules, find_dwells, returns
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import POINT, POSE, Recording, joints_by_time
from modcal_core.robots import Mechanism

# --- Readings outside the times of the joint states, which meanwhile go on without any

_ALIKE = 0.2  # of the longer: a tracker may pause, or lose its target, at either end of the part


def out_of_time(
    recording: Recording, names: tuple[str, ...], since: float = -np.inf, until: float = np.inf
) -> tuple[str, ...]:
    """What makes a verdict open: a sentence for each track of readings of which a part seems to be stamped elsewhere.

    since, until: stamps [s] between which readings are counted.
    """
    t = joints_by_time(recording, names)[0]
    found = []
    for track in recording.readings if len(t) else ():
        stamps = np.sort(track.stamps[(track.stamps >= since) & (track.stamps < until)])
        before, after = stamps[stamps < t[0]], stamps[stamps > t[-1]]
        outside = len(before) + len(after)
        if outside <= MAX_GLITCHES * len(stamps):
            continue
        taken = sum(float(np.ptp(part)) for part in (before, after) if len(part))
        inside = stamps[len(before) : len(stamps) - len(after)]
        silent = float(np.diff(np.r_[t[0], inside, t[-1]]).max())
        if abs(silent - taken) <= _ALIKE * max(silent, taken):
            found.append(
                f"{outside} of {len(stamps)} readings of {track.topic} ({track.frame}) are stamped before or after all "
                f"joint states and were left out ({outside / len(stamps):.0%}), and {silent:.0f} s of them have no "
                "reading: see whether a clock was set while recording (summer time, midnight, NTP), and correct the "
                "stamps or calibrate either part alone."
            )
    return tuple(found)


_MIN = 20  # steps between stamps, of which a median tells what is usual
_MIN_GAP = 0.1  # s; shorter silences happen on any busy computer
_RARE = 0.02  # share of the steps up to which gaps are silences; more are how the topic speaks
_LATE = 0.5  # s from stamp to reception; no transport takes so long, so a clock is wrong
_CLOCKS = 0.05  # s between two topics' delays; transport on one network differs by less
_CONSTANT = 1e-4  # rad or m; an encoder's noise at standstill stays below, and a joint in use does not
_GAP = 10.0  # times the usual period that make a silence worth saying


@dataclass(frozen=True)
class TrackFacts:
    """One track: topic, role, number of messages, rate [Hz], largest gap [s], first and last stamp [s]."""

    topic: str
    what: str
    count: int
    rate: float
    largest_gap: float
    first: float
    last: float


@dataclass(frozen=True)
class Inspection:
    """Facts by track, what the recording can be used for, and findings: a sentence for each thing that looks wrong."""

    tracks: tuple[TrackFacts, ...]
    uses: tuple[str, ...]
    findings: tuple[str, ...]


def inspect(recording: Recording, chain: Mechanism | None = None) -> Inspection:
    """What a recording holds; with a chain, also whether it can calibrate that arm."""
    facts, findings = [], list(recording.warnings)
    for joint in recording.joints:
        facts.append(_facts(joint.topic, f"{len(joint.names)} joints: {', '.join(joint.names)}", joint.stamps))
        findings += _clock_findings(joint.topic, joint.stamps, joint.received)
        for name, p in zip(joint.names, joint.position.T, strict=True):
            if len(joint.stamps) > 2 and np.isfinite(p).all() and np.ptp(p) < _CONSTANT:
                findings.append(f"Joint {name} never moves.")
    for told in recording.commands:
        facts.append(_facts(told.topic, f"commands of {len(told.names)} joints", told.stamps))
    for reading in recording.readings:
        name = f"{reading.topic} ({reading.frame})"
        facts.append(_facts(reading.topic, f"{reading.kind} in frame {reading.frame}", reading.stamps))
        findings += _clock_findings(name, reading.stamps, reading.received)
        findings += [f"{name}: {said}: the arm's motion will decide."] if (said := at_steady_rate(reading)[1]) else []
    for signal in recording.signals:
        facts.append(_facts(signal.topic, signal.name, signal.stamps))
    findings += _receive_finding(recording)
    if chain is not None:
        try:
            clean = cleaned(recording, chain.names, chain)
            require_usable(clean.recording, chain)
        except ModcalError as error:
            findings.append(f"Cannot be used for calibration: {error}.")
        else:
            elsewhere = out_of_time(clean.recording, chain.names)
            repeated = hung(clean.recording, chain.names).notes
            findings += [*clean.notes, *elsewhere, *repeated, *_returns_finding(clean.recording, chain)]
            recording = clean.recording
    return Inspection(tuple(facts), _uses(recording, chain), tuple(findings))


def _facts(topic: str, what: str, stamps: Array) -> TrackFacts:
    steps = np.diff(np.sort(stamps))
    steps = steps[steps > 0.0]
    rate = float(1.0 / np.median(steps)) if len(steps) else 0.0
    gap = float(steps.max()) if len(steps) else 0.0
    return TrackFacts(topic, what, len(stamps), rate, gap, float(np.min(stamps)), float(np.max(stamps)))


def _clock_findings(name: str, stamps: Array, received: Array) -> list[str]:
    out = []
    steps = np.diff(stamps)
    back = np.flatnonzero(steps < 0.0)
    if len(back):
        worst = back[np.argmin(steps[back])]
        out.append(
            f"{name}: the clock jumps back {len(back)} times, by up to {-steps[worst]:.3f} s at {stamps[worst]:.3f} s."
        )
    if (repeats := int((steps == 0.0).sum())) > 0:
        out.append(f"{name}: {repeats} messages have the stamp of the message before.")
    forward = steps[steps > 0.0]
    if len(forward) > _MIN:
        usual = float(np.median(forward))
        gaps = forward[forward > max(_GAP * usual, _MIN_GAP)]
        if 0 < len(gaps) <= _RARE * len(forward):
            out.append(f"{name}: silent {len(gaps)} times for up to {gaps.max():.2f} s, usually {usual:.3f} s.")
    late = received - stamps
    if np.isfinite(late).any() and abs(float(np.nanmedian(late))) > _LATE:
        out.append(f"{name}: stamps are {float(np.nanmedian(late)):+.2f} s from the time they were received.")
    return out


def _receive_finding(recording: Recording) -> list[str]:
    """Clocks that differ between topics show as different delays from stamp to reception."""
    joints = [t.received - t.stamps for t in recording.joints if np.isfinite(t.received).any()]
    if not joints:
        return []
    usual = float(np.nanmedian(np.concatenate(joints)))
    return [
        f"{r.topic} ({r.frame}): its clock is {offset:+.3f} s off that of the joint states, by times of reception."
        for r in recording.readings
        if np.isfinite(r.received).any() and abs(offset := usual - float(np.nanmedian(r.received - r.stamps))) > _CLOCKS
    ]


def _returns_finding(recording: Recording, chain: Mechanism) -> list[str]:
    """Without postures that are visited twice nobody knows how well the arm repeats, so no fit can be called good."""
    t, q = joints_by_time(recording, chain.names)
    dwells = find_dwells(t, q, StationRules())
    if len(dwells):
        q = q[np.searchsorted(t, dwells.mean(axis=1)).clip(max=len(t) - 1)]
    elif not sum(int(np.isin(r.stamps, t).sum()) for r in recording.readings):
        return []  # readings in motion have no posture to come back to
    count = len(returns(q))
    if count >= MIN_RETURNS:
        return []
    few = "No posture is visited twice" if not count else f"Only {count} postures are visited twice"
    return [
        f"{few}: the noise floor will be unknown; visit {MIN_RETURNS} postures again, each from another side, or "
        "state --repeatability-mm and --instrument-mm."
    ]


def _uses(recording: Recording, chain: Mechanism | None) -> tuple[str, ...]:
    names = chain.names if chain is not None else max((t.names for t in recording.joints), key=len, default=())
    t, q = joints_by_time(recording, names)
    read = [name for name in kinds() if any(r.kind == name for r in recording.readings)]
    if not read:
        return ("articulated objects, where the end effector's pose is known",) if len(t) else ()
    if not len(t):
        return ()
    dwells = find_dwells(t, q, StationRules())
    paired = sum(int(np.isin(r.stamps, t).sum()) for r in recording.readings)
    what = " and ".join({POSE: "poses", POINT: "points"}.get(name, f"readings of {name}") for name in read)
    if len(dwells):
        return (f"calibration from {what} in {len(dwells)} dwells",)
    if paired:
        return (f"calibration from {paired} finished stations ({what})",)
    return (f"calibration from {what} in motion",)
