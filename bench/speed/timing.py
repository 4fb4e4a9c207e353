"""Times that others on the machine disturb little, and the rows they are noted in.

The processor's time of this process is taken, on one thread; the two sides of a comparison take turns, and the medians
are compared. What is left of a busy machine (shared caches, a slower clock) then falls on both alike.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Work = Callable[[], Any]
_ELSEWHERE = 1.44 + 1.45  # ms, of machine_scale's work on the machine that the published figures of the peers come from


@dataclass(frozen=True)
class Row:
    """One line. ms: ours. peer, peer_ms: the other's name and time, None where there is none or where it is not
    installed, which ``remark`` then says. size: N, where growth is of interest.
    """

    work: str
    ms: float
    peer: str = ""
    peer_ms: float | None = None
    remark: str = ""
    size: int = 0

    def cells(self) -> tuple[str, ...]:
        """The row in words."""
        digits = 1 if self.ms >= 10.0 else 2 if self.ms >= 1.0 else 3
        if self.peer_ms is None:
            return self.work, f"{self.ms:.{digits}f}", self.peer, "", "", self.remark
        ratio = self.peer_ms / self.ms
        told = f"{self.peer_ms:.{digits}f}", f"{ratio:.{1 if ratio < 20.0 else 0}f} x"
        return self.work, f"{self.ms:.{digits}f}", self.peer, *told, self.remark


def growth(rows: Sequence[Row]) -> dict[str, float]:
    """Exponent of N between the two largest sizes of the same work; 1 is linear."""
    sized: dict[str, dict[int, float]] = {}
    for row in [row for row in rows if row.size]:
        sized.setdefault(re.sub(r", N = \d+", "", row.work), {})[row.size] = row.ms
    largest = {work: sorted(by_size.items())[-2:] for work, by_size in sized.items() if len(by_size) > 1}
    return {work: float(np.log(ms / less) / np.log(b / a)) for work, ((a, less), (b, ms)) in largest.items()}


def spent_ms(work: Work) -> float:
    """The processor's time of one run [ms]."""
    begun = time.process_time()
    work()
    return 1e3 * (time.process_time() - begun)


def median_ms(work: Work, runs: int = 7) -> float:
    """Median of several runs after one that is not counted [ms]."""
    work()
    return float(np.median([spent_ms(work) for _ in range(runs)]))


def pair_ms(ours: Work, other: Work, runs: int = 7, others: int = 7) -> tuple[float, float]:
    """Medians of both sides [ms], which take turns. others: runs of the other side, where it is slow."""
    ours()
    if others > 1:
        other()
    times: tuple[list[float], list[float]] = ([], [])
    for i in range(runs):
        times[0].append(spent_ms(ours))
        if i < others:
            times[1].append(spent_ms(other))
    return float(np.median(times[0])), float(np.median(times[1]))


def machine_scale() -> float:
    """How many times slower this machine is, at this moment, than the one of the peers' published figures.

    By sines and cosines of 60 000 angles, and one JᵀJ of 27 columns with 30 000 rows.
    """
    rng = np.random.default_rng(0)
    q, J = rng.uniform(-3.0, 3.0, (6, 10_000)), rng.normal(size=(27, 30_000))
    return median_ms(lambda: (np.sin(q), np.cos(q), J @ J.T), 15) / _ELSEWHERE
