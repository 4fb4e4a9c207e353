"""What is stated of arm and instrument, on the command line and in a cell file."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.calibration.stated import Stated
from modcal_core.errors import BadTable


def test_repeatability_of_a_data_sheet_as_rms() -> None:
    """RP of ISO 9283 is the mean distance to the mean position plus three standard deviations of it."""
    rng = np.random.default_rng(0)
    gap = 0.03 * rng.standard_normal((400_000, 3))
    far = np.linalg.norm(gap - gap.mean(axis=0), axis=1)
    iso = far.mean() + 3.0 * far.std(ddof=1)
    rms = Stated(repeatability_iso_mm=iso).rms_mm
    assert rms == pytest.approx(np.sqrt(np.mean(far**2)), rel=0.005)


def test_what_cannot_be_stated_is_refused() -> None:
    for values in (
        {"repeatability_mm": 0.0},
        {"instrument_mm": -0.1},
        {"instrument_deg": 20.0},
        {"repeatability_mm": float("nan")},
        {"repeatability_mm": 0.02, "repeatability_iso_mm": 0.05},
    ):
        with pytest.raises(BadTable):
            Stated(**values)
