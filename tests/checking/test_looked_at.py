"""Which stations of a long recording a check looks at."""

from __future__ import annotations

import itertools

import numpy as np

from modcal_core.measurements.dwells import spread_rows
from modcal_core.measurements.samples import Samples
from modcal_core.moves.known import spread_out
from modcal_core.moves.likelihood import witnesses


def raster(levels: int, joints: int) -> Samples:
    """A raster of postures, the last joint fastest, read as points."""
    q = np.array(list(itertools.product(np.linspace(-2.0, 2.0, levels), repeat=joints)))
    return Samples.from_arrays(q, points=np.zeros((len(q), 3)), stamps=np.arange(len(q), dtype=float))


def test_stations_of_a_raster_cover_every_joint_and_the_whole_time() -> None:
    samples = raster(12, 3)  # 1 728 stations
    part = spread_out(samples, 48)
    assert part.stations == 48
    for column in part.q.T:
        assert np.ptp(column) > 3.9
    gaps = np.diff(np.r_[-1, np.sort(part.stamps), len(samples)])
    assert gaps.max() <= 2 * len(samples) / 48
    every = samples.select(np.arange(0, len(samples), len(samples) // 48))
    assert np.ptp(every.q[:, 2]) < 0.1  # every 36th has the last joint where it was
    assert witnesses(part) > 2.0 * witnesses(every)
    assert witnesses(part) > 1.2 * witnesses(samples.select(spread_rows(len(samples), 48)))
