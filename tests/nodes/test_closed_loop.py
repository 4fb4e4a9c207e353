"""The whole way round: record, calibrate, correct, command; the true tool comes as near as the arm repeats.

Longer than 20 s, for an arm takes time to go anywhere: the one test of what all the rest is for, against MuJoCo's truth.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from nodes.closed_loop import close_the_loop


@pytest.mark.dds
@pytest.mark.slow
def test_the_true_tool_comes_as_near_as_the_arm_repeats(tmp_path: Path) -> None:
    """Of bench/closed_loop.py a part. The RMS of 48 visits is known to some 8 %; see Outcome.repeatability_mm."""
    outcome = close_the_loop(tmp_path, stations=110, wishes=16, visits=3)
    print(outcome.table())
    assert outcome.refused == 0
    assert {"compliance shoulder_lift_joint", "gear_harmonic elbow_joint"} <= set(outcome.effects)
    assert outcome.nominal.rms_mm > 20.0 * outcome.floor.rms_mm, "there was nothing to correct"
    floor = outcome.repeatability_mm(16)
    print(f"does not repeat: {floor:.4f} mm")
    assert outcome.corrected.rms_mm <= 1.3 * floor
