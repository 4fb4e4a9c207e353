"""A hypothesis: what may have been written down wrongly, how the readings look without it, and its price."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import consecutive
from modcal_core.hypotheses.hand_eye import HandEye

COMMON, RARE, VERY_RARE = (float(np.log(share)) for share in (0.02, 0.004, 0.001))  # chance of meeting any of a family
ROWS_REMEDY = "pair each reading with its own posture (a table that slipped or was sorted, labels, or a clock)"


@dataclass(frozen=True)
class Hypothesis:
    """what: a phrase that names it. remedy: what to do. undone: a case as it would be without it. price: log of the
    odds beforehand [nats]. values: how many numbers were fitted for it. touches: "orientations", "readings", "joints"
    or "rows". stations: how many are concerned; None for all.
    """

    what: str
    remedy: str
    undone: Callable[[HandEye], HandEye]
    price: float
    values: int = 0
    touches: str = "readings"
    stations: int | None = None

    def cost(self, N: int) -> float:
        """Nats that its evidence has to make up for, of N stations."""
        return self.price - 0.5 * self.values * float(np.log(max(N, 2)))


@dataclass(frozen=True)
class Disagreement:
    """what: a phrase naming what looks wrong. remedy: what to do. stations: how many, of how many. missed: by the arm
    with that corrected, at the usual station [m]; None where it is not known.
    """

    what: str
    remedy: str
    stations: int
    of: int
    missed: float | None = None


def family(price: float, members: Iterable[Hypothesis]) -> list[Hypothesis]:
    """The members, which share one chance of being met."""
    members = list(members)
    return [replace(h, price=price - float(np.log(len(members)))) for h in members]


def where(case: HandEye, rows: np.ndarray) -> str:
    """These rows in words: runs of station numbers, or how many they are; empty for all of them."""
    if len(rows) == len(case):
        return ""
    runs, number = consecutive(np.isin(np.arange(len(case)), rows)), case.station
    if len(runs) <= 3:
        ends = ((number[a], number[b - 1]) for a, b in runs)
        return " at stations " + " and ".join(f"{a} to {b}" if a < b else f"{a}" for a, b in ends)
    return f" at {len(rows)} of {len(case)} stations, here and there"


def cost_of_rows(rows: np.ndarray, N: int) -> float:
    """Nats that it takes to say which rows: two ends of a run each, or each by itself."""
    ends = 2 * len(consecutive(np.isin(np.arange(N), rows))) * float(np.log(N))
    share = np.clip(len(rows) / N, 1.0 / N, 1.0 - 1.0 / N)
    return min(ends, -N * float(share * np.log(share) + (1.0 - share) * np.log(1.0 - share)))


def listed(names: Iterable[str]) -> str:
    """Names in a sentence: a, b and c."""
    *first, last = [*names] or [""]
    return f"{', '.join(first)} and {last}" if first else last
