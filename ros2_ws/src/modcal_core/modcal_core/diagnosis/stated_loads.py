"""Payloads that the cell file states: loads computed with them, or, of an arm without masses, a number beside it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import Cell, StatedPayload
from modcal_core.diagnosis.load_hypothesis import LoadHypothesis
from modcal_core.effects import NominalArm
from modcal_core.errors import BadTable
from modcal_core.measurements import Samples, SignalTrack

TOPIC = "/payload_kg"


def stated_arm(arm: NominalArm, cell: Cell) -> NominalArm:
    """The arm with what it carries by the cell file; the same where nothing is stated or its masses are unknown."""
    if not cell.payloads or not arm.weighed:
        return arm
    hypothesis = LoadHypothesis(arm, until=cell.between, carries=True)
    return hypothesis.pulled(np.concatenate([p.mass * np.array([1.0, *p.place]) for p in _each(cell)]))


def with_stated(samples: Samples, cell: Cell, weighed: bool) -> Samples:
    """Samples with the stated payload as a recorded signal, for an arm without masses; otherwise unchanged.

    Raises BadTable where payloads are stated for another number of recordings.
    """
    if not cell.payloads:
        return samples
    each = _each(cell)
    if weighed or any(track.name.endswith(TOPIC) for track in samples.signals):
        return samples
    stamps = np.unique(samples.stamps)
    mass = np.array([p.mass for p in each])[np.searchsorted(np.array(cell.between), stamps, side="right")]
    return replace(samples, signals=(*samples.signals, SignalTrack(f"signal:{TOPIC}", stamps, mass[:, None], TOPIC)))


def _each(cell: Cell) -> tuple[StatedPayload, ...]:
    """One payload for each recording."""
    count, stated = len(cell.between) + 1, cell.payloads
    if len(stated) not in (1, count):
        said = f"{len(stated)} are stated, and recordings: {count}"
        raise BadTable("cell file: payloads", said, "state one for all recordings, or one for each in their order")
    return stated if len(stated) == count else stated * count
