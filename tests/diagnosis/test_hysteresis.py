"""Followers with play, against their rule told station by station."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cells import record

from modcal_core.diagnosis.hysteresis import paths
from modcal_core.measurements import WIDTHS


def test_a_follower_moves_only_where_it_would_lag_by_more_than_its_play() -> None:
    samples = record(5, 60).samples
    rng = np.random.default_rng(2)
    samples = replace(samples, stamps=rng.permutation(samples.stamps))  # stations in any order
    found = paths(samples).mean(axis=2)
    order = np.argsort(samples.stamps)
    for j in range(samples.q.shape[1]):
        for w, width in enumerate(WIDTHS):
            followers = samples.q[order[0], j] + np.array([width, -width])
            for k in order:
                x = float(samples.q[k, j])
                for i in range(2):
                    followers[i] = min(max(followers[i], x - width), x + width)
                assert abs(found[k, j, w] - (x - followers.mean())) < 1e-12
