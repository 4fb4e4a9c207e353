"""From a recording to samples: checked, on one clock, cut into stations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.measurements.alignment import LIMIT, align
from modcal_core.measurements.checks import require_usable
from modcal_core.measurements.recording import Recording
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.stations import StationRules, cut_stations
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import frames


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
    if samples.moving.any() and not np.isfinite(samples.sigma_position).any():
        notes += ("The arm hardly stood still: readings were used one by one, with postures interpolated.",)
    return Prepared(samples, recording.warnings + notes)
