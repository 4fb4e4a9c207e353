"""Followers with play, against their rule told station by station."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cells import record

from modcal_core.diagnosis.hysteresis import WIDTHS, play


def test_a_follower_moves_only_where_it_would_lag_by_more_than_its_play() -> None:
    samples = record(5, 60).samples
    rng = np.random.default_rng(2)
    samples = replace(samples, stamps=rng.permutation(samples.stamps))  # stations in any order
    found = play(samples)
    order = np.argsort(samples.stamps)
    for j in range(samples.q.shape[1]):
        for w, width in enumerate(WIDTHS):
            follower = float(samples.q[order[0], j])
            for k in order:
                x = float(samples.q[k, j])
                if x - follower > width:
                    follower = x - width
                elif follower - x > width:
                    follower = x + width
                assert abs(found[j, w, k] - (x - follower)) < 1e-12
