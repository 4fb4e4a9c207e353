"""Readings outside the times of the joint states, which meanwhile go on without any: a clock that was set on the way.

A tracker that begins earlier, or goes on after the joint states have ended, loses nothing but what no posture is known
of. Where as long a part of the joint states has no reading as the readings outside take, these are that part: at an
hour's distance since summer time ended, or a day's since midnight. By motion only jumps of some seconds are found
(:mod:`alignment`).
"""

from __future__ import annotations

import numpy as np

from modcal_core.measurements.dropouts import MAX_GLITCHES
from modcal_core.measurements.recording import Recording, joint_stamps_and_positions

_ALIKE = 0.2  # of the longer: a tracker may pause, or lose its target, at either end of the part


def out_of_time(
    recording: Recording, names: tuple[str, ...], since: float = -np.inf, until: float = np.inf
) -> tuple[str, ...]:
    """What makes a verdict open: a sentence for each track of readings of which a part seems to be stamped elsewhere.

    since, until: stamps [s] between which readings are counted.
    """
    t = np.sort(joint_stamps_and_positions(recording, names)[0])
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
