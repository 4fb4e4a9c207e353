"""Samples of a recording, and the recording that samples would be."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import se3
from modcal_core.measurements.dwells import StationRules
from modcal_core.measurements.pairing import paired_columns
from modcal_core.measurements.recording import POSE, JointTrack, ReadingTrack, Recording
from modcal_core.measurements.samples import Samples


def cut_stations(recording: Recording, names: tuple[str, ...], rules: StationRules | None = None) -> Samples:
    """The samples of a recording, for these joints in this order.

    Stations keep their number over all instruments. Raises BadRecording when joints and readings have nothing in
    common.
    """
    return Samples(**paired_columns(recording, names, rules))


def as_recording(samples: Samples, names: tuple[str, ...]) -> Recording:
    """Joint states and readings of samples of these joints, in the form that checks ask for."""
    unknown = np.full(len(samples), np.nan)
    joints = JointTrack(names, samples.stamps, samples.q, samples.velocity, samples.effort, unknown)
    readings = []
    for f, frame in enumerate(samples.frames):
        for kind in samples.kinds:
            rows = (samples.frame == f) & (samples.kind == kind)
            T = se3.transform(samples.R[rows], samples.reading[rows])
            values = se3.to_pose(T) if kind == POSE else samples.reading[rows]
            readings.append(ReadingTrack(kind, frame, samples.stamps[rows], values, unknown[rows], "readings"))
    return Recording((joints,), tuple(readings), samples.signals, source="arrays")
