"""The last way of every joint, in live posture after posture."""

from __future__ import annotations

import numpy as np

from modcal_core.measurements.dwells import Approach


def test_approach_remembers_the_last_way_of_every_joint() -> None:
    approach = Approach()
    assert approach.update(np.zeros(3)).tolist() == [0, 0, 0]
    for x in np.linspace(0.0, 0.1, 50):
        came = approach.update(np.array([x, -x, 1e-5 * x]))
    assert came.tolist() == [1, -1, 0]
    assert approach.update(np.array([0.0998, -0.1, 0.0])).tolist() == [1, -1, 0], "less than noise"
    assert approach.update(np.array([0.0990, -0.1, 0.0])).tolist() == [-1, -1, 0]
