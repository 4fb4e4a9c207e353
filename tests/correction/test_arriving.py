"""From which side a joint arrives, as play and friction have it."""

from __future__ import annotations

import numpy as np

from modcal_core.correction.correction import ArmState


def test_a_joint_that_does_not_move_keeps_the_side_it_came_from() -> None:
    at = ArmState.at_rest([0.1, 0.2, 0.3, 0.4], 5.0, approach=[1.0, -1.0, 1.0, 0.0])
    there = at.arriving(at.q + [0.0, 0.0, -0.2, 0.3])
    assert there.approach.tolist() == [1.0, -1.0, -1.0, 1.0]
    assert np.array_equal(there.velocity, np.zeros(4))
