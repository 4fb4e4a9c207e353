"""A description of another robot that the geometry makes up for is said beside the report."""

from __future__ import annotations

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.loop import calibrate


@pytest.mark.parametrize("longer_m", [0.0, 0.08])
def test_a_link_of_another_length_is_said_though_it_is_fitted(longer_m: float) -> None:
    made = record(3, 70)
    origins = ur10().origins.copy()
    origins[2, :3, 3] *= 1.0 + longer_m / np.linalg.norm(origins[2, :3, 3])
    report = calibrate(
        made.samples, ur10().with_origins(origins), np.random.default_rng(0), look_for_effects=False
    ).report
    said = [note for note in report.notes if note.startswith("The nominal model misses by")]
    assert len(said) == (longer_m > 0.0)
    final = report.errors["final"].size_mm()
    assert final is not None
    assert final.rms < 0.5
