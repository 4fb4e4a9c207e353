"""What an instrument says of its own error in its messages, checked against how its readings scatter.

Covariances in messages are of all sorts: measured, copied from a data sheet, or invented. Where the arm stands still,
readings scatter by what the instrument adds from one to the next; a covariance that is far from that is not believed,
and one that nothing can be compared with is not used. What remains stands in for what a person would state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.stated import MAX_DEG, MAX_MM, Stated
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dwells import StationRules, inliers
from modcal_core.measurements.recording import POSE, ReadingTrack, Recording, joint_stamps_and_positions
from modcal_core.measurements.settled import dwells_of

_FACTOR = 3.0  # of deviations; scatter has a slow part that standing still does not show, and filters hide some
_MIN = 50  # readings that a scatter is taken from, and twice as many as dwells
_REMEDY = "State --instrument-mm"


@dataclass(frozen=True)
class OwnStatement:
    """What is believed of instruments by their own word, and a sentence for each of them."""

    stated: Stated
    notes: tuple[str, ...] = ()


def own_statement(recording: Recording, names: tuple[str, ...], rules: StationRules | None = None) -> OwnStatement:
    """Errors that the instruments of a recording on one clock report of their readings, as far as the data bear it out.

    Of several instruments the largest error counts.
    """
    tracks = [track for track in recording.readings if track.stated is not None and len(track.stamps)]
    if not tracks:
        return OwnStatement(Stated())
    t, q = joint_stamps_and_positions(recording, names)
    order = np.argsort(t, kind="stable")
    dwells = dwells_of(t[order], q[order], recording.readings, rules or StationRules())
    believed: list[tuple[float | None, float | None]] = []
    notes = []
    for track in tracks:
        own = _median(track)
        seen = _scatter(track, dwells)
        name = f"{track.topic} ({track.frame})"
        units = ((1e3, "mm", MAX_MM), (np.degrees(1.0), "°", MAX_DEG))
        kept: list[float | None] = []
        for what, shown, (scale, unit, largest) in zip(own, seen, units, strict=True):
            value = _checked(what, shown, scale, largest)
            kept.append(value)
            if np.isfinite(what):
                notes.append(
                    f"{name} reports its own error as {scale * what:.3g} {unit}{_why(value, shown, scale, unit)}."
                )
        believed.append((kept[0], kept[1]))
    position, rotation = (
        None if any(pair[k] is None for pair in believed) else max(float(pair[k] or 0.0) for pair in believed)
        for k in (0, 1)
    )
    return OwnStatement(Stated(instrument_mm=position, instrument_deg=rotation), tuple(notes))


def together_stated(parts: Sequence[Stated]) -> Stated:
    """The largest statement of several pieces of a recording; none where one of them bears none out."""
    values = {}
    for name in ("instrument_mm", "instrument_deg"):
        each = [getattr(part, name) for part in parts]
        values[name] = None if not each or None in each else max(each)
    return Stated(**values)


def _checked(what: float, shown: float, scale: float, largest: float) -> float | None:
    """The statement in mm or degrees, if it is borne out."""
    if not np.isfinite([what, shown]).all() or not shown / _FACTOR <= what <= shown * _FACTOR:
        return None
    return float(scale * what) if 0.0 < scale * what <= largest else None


def _why(value: float | None, shown: float, scale: float, unit: str) -> str:
    if not np.isfinite(shown):
        return f": not used, because the arm does not stand still long enough to compare. {_REMEDY}, if it is known"
    seen = f"its readings scatter by {scale * shown:.3g} {unit} where the arm stands still"
    return f"; {seen}, which agrees with it" if value is not None else f": not used, because {seen}"


def _median(track: ReadingTrack) -> Array:
    """The usual statement of position [m] and angle [rad], (2,); NaN where there is none."""
    assert track.stated is not None
    return np.array([float(np.median(c[np.isfinite(c)])) if np.isfinite(c).any() else np.nan for c in track.stated.T])


def _scatter(track: ReadingTrack, dwells: Array) -> Array:
    """RMS over space by which readings scatter about the mean of their dwell, position [m] and angle [rad], (2,)."""
    order = np.argsort(track.stamps, kind="stable")
    stamps = track.stamps[order]
    square, freedom = np.zeros(2), 0
    for first, last in np.searchsorted(stamps, dwells).tolist() if len(dwells) else ():
        rows = order[first:last]
        if len(rows) < 3:
            continue
        values = track.values[rows]
        values = values[inliers(values[:, :3])]
        if len(values) < 3:
            continue
        square[0] += float(((values[:, :3] - values[:, :3].mean(axis=0)) ** 2).sum())
        if track.kind == POSE:
            R = so3.from_quaternion(values[:, 3:])
            turned = so3.log(np.swapaxes(so3.mean(R)[None], 1, 2) @ R)
            square[1] += float((turned**2).sum())
        freedom += len(values) - 1
    if freedom < _MIN:
        return np.full(2, np.nan)
    out = np.sqrt(square / freedom)
    return np.where([True, track.kind == POSE], out, np.nan)
