"""Joints that are recorded beside the arm's own: another arm, a gantry, a gripper. They may move the tool too."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import PART, Recording, SignalTrack
from modcal_core.measurements.samples import Samples

_MOVES = 1e-3  # rad or m; a joint that moves by less stands still
_MARK = f"{PART}joint "


def other_joints(recording: Recording, samples: Samples) -> tuple[SignalTrack, ...]:
    """A signal for each joint that moves and is none of the arm's: its position [rad or m] at the samples.

    recording: on the clock of the samples.
    """
    at = np.unique(samples.stamps)
    found: dict[str, SignalTrack] = {}
    for track in recording.joints:
        for column, name in enumerate(track.names):
            known = np.isfinite(track.position[:, column])
            if name in samples.names or known.sum() < 2:
                continue
            order = np.argsort(track.stamps[known], kind="stable")
            value = np.interp(at, track.stamps[known][order], track.position[known, column][order])
            if np.ptp(value) > _MOVES:
                signal = f"signal:{track.topic}{_MARK}{name}"
                found.setdefault(signal, SignalTrack(signal, at, value[:, None], track.topic))
    return tuple(found.values())


def others_at(samples: Samples) -> Array:
    """Positions of these joints at the samples, (N, K); K is 0 where there are none."""
    tracks = [track for track in samples.signals if _MARK in track.name]
    columns = [np.interp(samples.stamps, track.stamps, track.values[:, 0]) for track in tracks]
    return np.stack(columns, axis=1) if columns else np.empty((len(samples), 0))


def others_by_name(samples: Samples) -> dict[str, Array]:
    """Positions of these joints at the samples, (N,), by the joint's name."""
    tracks = [track for track in samples.signals if _MARK in track.name]
    return {spoken_name(t.name): np.interp(samples.stamps, t.stamps, t.values[:, 0]) for t in tracks}


def moving_beside(samples: Samples) -> tuple[str, ...]:
    """Names of the joints that were recorded moving and are none of the arm's."""
    return tuple(spoken_name(track.name) for track in samples.signals if _MARK in track.name)


def spoken_name(signal: str) -> str:
    """A recorded signal as a person calls it: its topic, or the joint."""
    return signal.rpartition(_MARK)[2].removeprefix("signal:").replace("temperature:", "the temperature of ")
