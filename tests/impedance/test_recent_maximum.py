"""What is kept of the last moments, against all of it looked through."""

from __future__ import annotations

from collections import deque

import numpy as np

from modcal_core.impedance.lead_check import RecentMaximum, sent_since


def test_the_largest_of_the_last_moments_is_that_of_a_list(rng: np.random.Generator) -> None:
    recent = RecentMaximum(0.5)
    assert recent.largest == 0.0
    times = np.cumsum(rng.exponential(0.05, 400))
    values = np.round(rng.uniform(0.0, 1.0, 400), 1)  # some alike
    for k, (now, value) in enumerate(zip(times, values, strict=True)):
        recent.add(now, value)
        assert recent.largest == values[: k + 1][times[: k + 1] >= now - 0.5].max()


def test_what_was_sent_between_two_times_is_that_of_a_list(rng: np.random.Generator) -> None:
    times = np.cumsum(rng.exponential(0.05, 60))
    sent = deque((float(t), np.array([k])) for k, t in enumerate(times))
    for _ in range(300):
        since, until = np.sort(rng.uniform(-0.1, times[-1] + 0.2, 2))
        inside = [k for k, t in enumerate(times) if since <= t <= until]
        before = [k for k, t in enumerate(times) if t <= until]
        assert [int(x[0]) for x in sent_since(sent, since, until)] == (inside or before[-1:])
