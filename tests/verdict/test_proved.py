"""What the model lacks may be what an effect stands for: when a cause is proved beside a rest that is predictable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modcal_core.calibration import Errors
from modcal_core.outcome import Finding
from modcal_core.scoring import _hidden
from modcal_core.verdict.verdict import Reason, Share, Verdict

HALF = Share(0.5, (0.4, 0.6), 0.4)
OPEN = Verdict("open", (Reason("predictable", "Half is predictable."),), predictable=HALF, predictable_both=HALF)
LEFT = Errors(np.tile([0.2e-3, 0.0, 0.0], (50, 1)), np.empty((0, 3)))  # 0.04 mm², half of it predictable
NONE, MANY = np.zeros(100, bool), np.arange(100) < 20
FOUND = Finding("coupling", "elbow_joint", "axis", "position:wrist_1_joint", {}, 1e-9, 1e-3, 1e-4)


@pytest.mark.parametrize(("gain_mm2", "hidden"), [(0.019, True), (0.021, False), (None, False)])
def test_it_has_to_bring_more_than_what_is_predictable(gain_mm2: float | None, hidden: bool) -> None:
    assert _hidden(replace(FOUND, gain_mm2=gain_mm2), OPEN, LEFT, NONE) == hidden
    assert not _hidden(replace(FOUND, gain_mm2=gain_mm2), Verdict("at_floor"), LEFT, NONE)


def test_nothing_is_proved_beside_many_rejected_stations() -> None:
    large = replace(FOUND, gain_mm2=10.0)
    rejected = replace(OPEN, reasons=(*OPEN.reasons, Reason("rejected", "20 stations were rejected.")))
    assert _hidden(large, rejected, LEFT, MANY)
    assert not _hidden(large, rejected, LEFT, NONE)
    assert not _hidden(large, OPEN, LEFT, MANY)
