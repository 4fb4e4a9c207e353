"""Stamps of arrival: of readings that a driver hands over together, or each after a delay of its own.

An instrument measures at a steady rate, which its readings' arrival still shows. Bursts are no instrument's rate and
are spread at once. Delays of a part of a period may as well be the true times of a timer that is woken late: that
stamps would suit a steady rate is said, and the arm's motion decides.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements.dwells import spread_rows
from modcal_core.measurements.recording import ReadingTrack

BURST = 1e-3  # s between readings that are handed over together; no instrument measures so often
LONGEST_PAUSE = 1.0  # s between bursts; longer are pauses between stations
_STEADY, _MOST = 1.2, 90.0  # steps between readings, within which most bursts end after their last, %
_FEWEST_IN_BURSTS, SMALLEST_BURST = 10, 3  # readings, in all and in one; two are one that was written twice
_EARLY, _MAX = 30.0, 2000  # price of a second early, of one late: 3 % are early; arrivals that are asked
_FEWEST, _FIRST = 200, 32  # readings that show a rate, and those that it is read from first
# turns of the last reading against the first, by which rates are tried; the same at last
_TURNS, _FINER = np.linspace(-1.0, 1.0, 21), 0.1
_BY_CHANCE = 30.0  # of N R², R the mean direction of N phases: chance has so much once in e^30
_WORTH = 1e-3  # s; delays that vary by less move no tool by more than 1 mm at 1 m/s
_QUIET, _CELLS = 0.2, 40  # share of a period in which fewest arrive, before those that are hardly late; its cells


def without_bursts(track: ReadingTrack, name: str, notes: list[str]) -> ReadingTrack:
    """The track with its stamps spread, where readings were handed over in bursts and stamped when they arrived.

    They get the times of a steady rate where the ends of all bursts agree with one; else the last of a burst keeps its
    stamp, and those before it share the time since the burst before. What that leaves is a delay, fitted as any other.
    """
    t = track.stamps
    if len(t) < _FEWEST_IN_BURSTS or (np.diff(t) < 0.0).any():
        return track
    step = np.diff(t)
    ends = np.r_[np.flatnonzero(step > BURST), len(t) - 1]
    count = np.diff(np.r_[-1, ends])
    pause = np.diff(t[ends], prepend=np.nan)
    usual = float(np.nanmedian(pause)) if len(ends) > 2 else np.inf
    inside = step[step <= BURST]
    if np.median(count) < SMALLEST_BURST or usual > LONGEST_PAUSE or np.median(inside) in (0.0, np.inf):
        return track
    notes.append(
        f"{name}: {len(t)} readings came in bursts of {np.median(count):.0f}, {1e3 * float(np.median(inside)):.2g} ms "
        f"after each other, every {usual:.3g} s, with the stamps of their arrival: they were spread evenly."
    )
    number = np.arange(len(t))
    first, rate = _earliest(ends, t[ends])
    if np.percentile(t[ends] - first - rate * ends, _MOST) <= _STEADY * rate:
        return replace(track, stamps=np.asarray(first + rate * number))
    pause = np.where(pause < 1.5 * usual, pause, usual)
    before = np.repeat(ends, count) - np.arange(len(t))  # readings of the burst that follow each
    return replace(track, stamps=np.repeat(t[ends], count) - before * np.repeat(pause / count, count))


def _earliest(number: np.ndarray, arrived: Array) -> tuple[float, float]:
    """The line (first, step) of which numbered arrivals (m,) [s] are late by least in sum, and hardly any early.

    Of delays that are mostly short, as exponential ones, no line is likelier; a few wrong numbers do not tilt it.
    """
    from scipy.optimize import linprog  # few recordings need it, and looking into a bag is to be quick
    from scipy.sparse import eye_array, hstack

    some = spread_rows(len(number), _MAX)
    n, since = len(some), arrived[some] - arrived[0]
    parts: Any = [np.stack([np.ones(n), number[some]], axis=1), eye_array(n), -eye_array(n)]
    cost = np.r_[0.0, 0.0, np.ones(n), np.full(n, _EARLY)]
    bounds = [(None, None)] * 2 + [(0.0, None)] * (2 * n)
    found: Any = linprog(cost, A_eq=hstack(parts, format="csr"), b_eq=since, bounds=bounds)
    first, step = found.x[:2]
    return float(arrived[0] + first), float(step)


def at_steady_rate(track: ReadingTrack) -> tuple[ReadingTrack, str]:
    """The track with stamps of a steady rate that its readings may have been taken at, some lost perhaps, and a
    sentence; the track itself where stamps show no rate, or hardly differ from it.
    """
    since = track.stamps - track.stamps[:1]
    steps = np.diff(since)
    if len(since) < _FEWEST or (steps < 0.0).any() or not (step := float(np.median(steps))) > 0.0:
        return track, ""
    count, reach = min(_FIRST, len(since)), 1.0
    while reach:  # of twice as many readings each time, the rate is known twice as well
        part = since[:count]
        tried = step / (1.0 + reach * _TURNS * step / max(float(part[-1]), step))
        mean = np.exp(2j * np.pi * part / tried[:, None]).mean(axis=1)
        step = float(tried[np.argmax(np.abs(mean))])
        reach = 1.0 if count < len(since) else _FINER if reach > _FINER else 0.0
        count = min(2 * count, len(since))
    if len(since) * np.abs(mean).max() ** 2 < _BY_CHANCE:
        return track, ""
    arrivals = np.bincount((since / step % 1.0 * _CELLS).astype(int) % _CELLS, minlength=_CELLS)
    quiet = np.convolve(np.r_[arrivals, arrivals], np.ones(width := int(_QUIET * _CELLS)), "valid")[:_CELLS]
    begin = (float(np.argmin(quiet)) + 0.5 * width) / _CELLS  # a reading that seems early would take all before along
    number = np.floor(since / step - begin)
    order = np.arange(len(since))
    # none overtakes another: of those that are late by a period and more the next ones tell it
    number = order + np.minimum.accumulate((number - order)[::-1])[::-1]
    if float(np.std(since - step * number)) < _WORTH:
        return track, ""
    first, step = _earliest(number, since)
    late = since - first - step * number
    varies = float(np.std(late))
    if varies < _WORTH:
        return track, ""
    said = (
        f"stamps vary by {1e3 * varies:.1f} ms (RMS) about a steady rate of {1.0 / step:.4g} Hz, as those of arrival do"
    )
    return replace(track, stamps=track.stamps[0] + first + step * number + float(np.median(late))), said
