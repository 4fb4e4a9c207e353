"""What a measurement is to prove, and the words of its end."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.errors import BadTable
from modcal_core.planning.session import Goal, proven, spent


def test_the_instruments_own_error_is_no_error_of_the_tool() -> None:
    assert Goal(1e-4, instrument=5e-5).rms == pytest.approx(np.hypot(1e-4, 5e-5))
    assert Goal(1.96e-4, "p95").rms == pytest.approx(1e-4)
    assert Goal().rms is None


def test_an_end_says_the_upper_end_of_the_claim() -> None:
    said = proven(Goal(1e-4), 0.083, 26, 6).sentence
    assert said.startswith(
        "0.1 mm is proven: over all postures that are allowed and seen the tool's RMS error is at most"
    )
    assert "at most 0.083 mm with 95 % confidence, from 26 stations, 6 of them at random and in no fit." in said
    gone = spent(Goal(1e-4, "p95"), 15, 0.3).sentence
    assert "95th percentile is at most 0.300 mm" in gone
    assert "too few for a fit" in spent(Goal(1e-4), 3, None).sentence


def test_what_cannot_be_asked_is_refused() -> None:
    for wrong in ({"accuracy": 0.0}, {"accuracy": np.inf}, {"stations": 0}):
        with pytest.raises(BadTable):
            Goal(**wrong)  # type: ignore[arg-type]
