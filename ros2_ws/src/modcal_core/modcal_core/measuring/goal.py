"""What is asked of a measurement: an error at the tool, how sure it must be, and what it may cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modcal_core.errors import BadTable

Statistic = Literal["rms", "p95"]
# The 95th percentile over the RMS of a squared error that varies from station to station as the square of one normal
# number does: the widest law that the proof allows for (see proof.py), and the one with the longest tail
P95_OVER_RMS = 1.96
MAX_STATIONS = 400  # more than any arm has needed in the benchmarks; without an end a robot would go on for ever


@dataclass(frozen=True)
class Goal:
    """accuracy: [m] at the tool, None: as good as this arm and instrument allow. statistic: of the errors at stations
    drawn at random. confidence: with which it is proven. stations: most that are measured, returns and proof included.
    seconds: most that it may take. instrument: RMS over space [m] that the instrument is stated to add to an error.
    ties: also separate explanations that the readings leave open.
    """

    accuracy: float | None = None
    statistic: Statistic = "rms"
    confidence: float = 0.95
    stations: int = MAX_STATIONS
    seconds: float | None = None
    instrument: float = 0.0
    ties: bool = False

    def __post_init__(self) -> None:
        """Raises BadTable for what cannot be asked."""
        if self.accuracy is not None and not 0.0 < self.accuracy < np.inf:
            raise BadTable("--goal-mm", f"is {1e3 * self.accuracy:g} mm, more than 0 is needed", "give millimetres")
        if not 0.5 <= self.confidence < 1.0:
            raise BadTable("--confidence", f"is {self.confidence:g}, 0.5 to below 1 is possible", "give 0.95")
        if self.stations < 1:
            raise BadTable("--stations", f"is {self.stations}, at least 1 is needed", "give more")

    @property
    def rms(self) -> float | None:
        """The RMS error of a reading [m] below which the goal is met, the instrument's own error included."""
        if self.accuracy is None:
            return None
        tool = self.accuracy / (P95_OVER_RMS if self.statistic == "p95" else 1.0)
        return float(np.hypot(tool, self.instrument))

    def of_tool(self, rms: float) -> float:
        """The statistic of the tool's error [m] that an RMS error of readings [m] amounts to."""
        tool = float(np.sqrt(max(rms**2 - self.instrument**2, 0.0)))
        return tool * (P95_OVER_RMS if self.statistic == "p95" else 1.0)
