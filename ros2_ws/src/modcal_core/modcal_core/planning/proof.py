"""What is to be proven, and how a measurement ends.

An accuracy is proven where the upper end of the claim (:mod:`modcal_core.claim`) is within it, over postures drawn at
random from all that are allowed and seen. Some of the stations are such postures, which no fit sees: what the model
lacks there counts in the claim as it does where the model was fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.verdict import Floor

MIN_STATIONS = 6  # at random; what is wrong at two fifths of all postures shows at one of six with 95 %

Statistic = Literal["rms", "p95"]
# The 95th percentile over the RMS of a squared error that varies from station to station as the square of one normal
# number does: the widest law that the proof allows for, and the one with the longest tail
P95_OVER_RMS = 1.96
MAX_STATIONS = 400  # more than any arm has needed in the benchmarks; without an end a robot would go on for ever


@dataclass(frozen=True)
class Goal:
    """accuracy: [m] at the tool, None: as good as this arm and instrument allow. statistic: of the errors at stations
    drawn at random. stations: most that are measured, returns and proof included.
    seconds: most that it may take. instrument: RMS over space [m] that the instrument is stated to add to an error.
    ties: also separate explanations that the readings leave open.
    """

    accuracy: float | None = None
    statistic: Statistic = "rms"
    stations: int = MAX_STATIONS
    seconds: float | None = None
    instrument: float = 0.0
    ties: bool = False

    def __post_init__(self) -> None:
        """Raises BadTable for what cannot be asked."""
        if self.accuracy is not None and not 0.0 < self.accuracy < np.inf:
            raise BadTable("--goal-mm", f"is {1e3 * self.accuracy:g} mm, more than 0 is needed", "give millimetres")
        if self.stations < 1:
            raise BadTable("--stations", f"is {self.stations}, at least 1 is needed", "give more")

    @property
    def rms(self) -> float | None:
        """The RMS error of a reading [m] below which the goal is met, the instrument's own error included."""
        if self.accuracy is None:
            return None
        tool = self.accuracy / (P95_OVER_RMS if self.statistic == "p95" else 1.0)
        return float(np.hypot(tool, self.instrument))


Ending = Literal["proven", "budget", "no_station_helps"]
UNEXPLAINED = 1.5  # mean square left over the most that the floor may be, from which something is to be found still


@dataclass(frozen=True)
class End:
    """How it ended, and why, in a sentence."""

    ending: Ending
    sentence: str


def proven(goal: Goal, claimed: float, measured: int, unseen: int) -> End:
    """The goal is proven. claimed: upper end [mm] of what it asks for. measured: stations in all. unseen: at random."""
    assert goal.accuracy is not None
    return End(
        "proven",
        f"{1e3 * goal.accuracy:g} mm is proven: over all postures that are allowed and seen {_said(goal, claimed)}, "
        f"from {measured} stations, {unseen} of them at random and in no fit.",
    )


def spent(goal: Goal, measured: int, claimed: float | None) -> End:
    """The budget is gone. claimed: upper end [mm] of what the goal asks for; None where there is no fit yet."""
    reached = "too few for a fit." if claimed is None else f"{_said(goal, claimed)}, and the goal is not proven."
    return End("budget", f"The budget is gone after {measured} stations: {reached}")


def no_station_helps(goal: Goal, claimed: float, floor: Floor | None, left: float) -> End:
    """Why more stations would change nothing. claimed: as of :func:`spent`. left: RMS [m] of the fit's residuals."""
    reached = _said(goal, claimed)
    if floor is None:
        cause = "what is left does not get smaller with more stations; no posture was visited twice to tell why"
    elif left**2 > UNEXPLAINED * 1e-6 * floor.interval[1]:
        parts = f"{1e3 * left:.3f} mm is left, {floor.rms:.3f} mm of it does not repeat"
        cause = f"{parts}; the rest has no known cause"
    else:
        many = f"{floor.returns} returns" if floor.returns else "what was stated"
        low, high = np.sqrt(floor.interval)
        sized = f"{floor.rms:.3f} mm ({low:.3f} to {high:.3f})" if floor.returns else f"{floor.rms:.3f} mm"
        cause = f"{sized} is what this arm repeats and this instrument reads, by {many}"
    if goal.accuracy is None:
        return End("no_station_helps", f"No further station helps: {reached}; {cause}.")
    wanted = f"{1e3 * goal.accuracy:g} mm"
    below = floor is not None and goal.rms is not None and 1e3 * goal.rms < floor.rms
    said = f"{wanted} is below what can be reached" if below else f"{wanted} is not in reach"
    return End("no_station_helps", f"{said}: {cause}; reached: {reached}.")


def _said(goal: Goal, claimed: float) -> str:
    name = "95th percentile" if goal.statistic == "p95" else "RMS error"
    return f"the tool's {name} is at most {claimed:.3f} mm with 95 % confidence"
