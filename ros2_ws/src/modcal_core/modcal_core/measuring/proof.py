"""A proof that stays valid however often one looks: a test martingale of the errors at random stations.

Let X_i be the squared error of the frozen model at the i-th of stations drawn at random and kept out of its fit, and
g² the mean square that is to be excluded. If X varies from station to station no more than the mean of ν squared normal
numbers, its Laplace transform is E exp(−λX) ≤ (1 + 2λg²/ν)^(−ν/2) wherever its mean is g² or more, so

    E_n = Π (g/s)^ν exp(−λ X_i),    λ = ν (1/s² − 1/g²) / 2

is a supermartingale that begins at 1 and exceeds 1/α at any time with probability at most α (Ville 1939; see Ramdas et
al. 2023, Statistical Science 38:576). s is the RMS error that the fit expects, known before the first of these stations
is read: a wrong s costs stations, and never the guarantee; E_n is a weighted mean of those with s as expected and
somewhat larger, so that it does not cost many. ν, of at most three directions, is between one and two, as
for returns (verdict/floor.py), by how the fit's own residuals vary (Satterthwaite 1946). What no such law covers is an
error that is rare and large, which no few stations can exclude.

Each new model is proven again on all of these stations, with a share of α of its own, so that all shares add up to α.
They fall slowly, 1/k(k + 1) of what the first leaves: to fit again costs the proof a station or two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.verdict import Floor

_FIRST = 2.0 / 3.0  # of α for the first model that is tried, which is mostly the last
MIN_STATIONS = 6  # at random; what is wrong at two fifths of all postures shows at one of six with 95 %
_LARGER = np.array([1.0, 1.3, 1.7])  # times what is expected: fits of few stations expect too little more often
_WEIGHTS = np.array([0.5, 0.3, 0.2])  # of these: what the fit expects is mostly right
_MIN_RATIO = 1.05  # goal over expected error; nearer to 1 a proof takes hundreds of stations


def share(alpha: float, version: int) -> float:
    """The share of α that is spent on the version-th model (0, 1, …) that a proof is tried of."""
    return float(alpha * (_FIRST if version == 0 else (1.0 - _FIRST) / (version * (version + 1))))


def axes_of(squares: Array) -> float:
    """ν: how many directions squares (n,) of errors vary like, between one and two."""
    mean, variance = float(np.mean(squares)), float(np.var(squares))
    return float(np.clip(2.0 * mean**2 / max(variance, 1e-300), 1.0, 2.0))


@dataclass(frozen=True)
class Proof:
    """errors: of one frozen model at random stations (n,) [m]. expected: RMS [m], stated before they were read. alpha:
    chance of a false proof. axes: ν, known as early.
    """

    errors: Array
    expected: float
    alpha: float
    axes: float = 1.0

    def _evidences(self, goal: float) -> Array:
        """log of weight times E_n against an RMS of ``goal`` [m] or more, for each of the expected sizes."""
        s = self.expected * _LARGER
        n, square = len(self.errors), 0.5 * float(np.sum(self.errors**2))
        gained = self.axes * (n * np.log(goal / s) - square * (s**-2 - goal**-2))
        return np.asarray(np.log(_WEIGHTS) + np.where(goal > s, gained, 0.0))  # a size beyond the goal says nothing

    def evidence(self, goal: float) -> float:
        """log E_n against an RMS of ``goal`` [m] or more."""
        return float(np.logaddexp.reduce(self._evidences(goal)))

    def holds(self, goal: float) -> bool:
        """Whether an RMS error below the goal [m] is proven."""
        return len(self.errors) >= MIN_STATIONS and self.evidence(goal) >= -np.log(self.alpha)

    @property
    def rms(self) -> float | None:
        """RMS of the errors seen [m]; None before the first."""
        return float(np.sqrt(np.mean(self.errors**2))) if len(self.errors) else None

    @property
    def bound(self) -> float | None:
        """The smallest RMS [m] that is proven not to be exceeded, None where nothing is proven yet.

        Above the RMS that was seen the evidence rises with the goal, so it is where that crosses −log α.
        """
        if len(self.errors) < MIN_STATIONS:
            return None
        low = max(self.expected, self.rms or 0.0, 1e-12)
        high = 2.0 * low
        for _ in range(60):
            if self.holds(high):
                break
            high *= 2.0
        else:
            return None
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.holds(middle) else (middle, high)
        return high

    def more(self, goal: float, expected: float) -> float:
        """Further stations until the goal is proven, if the RMS error is this."""
        s = self.expected * _LARGER
        each = self.axes * (np.log(goal / s) - 0.5 * expected**2 * (s**-2 - goal**-2))
        missing = -np.log(self.alpha) - self._evidences(goal)
        good = (each > 0.0) & (goal > _MIN_RATIO * s)
        if not good.any():
            return float("inf")
        least = float(max(MIN_STATIONS - len(self.errors), 0))
        return max(float((missing[good] / each[good]).min()), least)


Statistic = Literal["rms", "p95"]
# The 95th percentile over the RMS of a squared error that varies from station to station as the square of one normal
# number does: the widest law that the proof allows for, and the one with the longest tail
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


Ending = Literal["proven", "budget", "no_station_helps"]
UNEXPLAINED = 1.5  # mean square left over the most that the floor may be, from which something is to be found still


@dataclass(frozen=True)
class End:
    """How it ended, and why, in a sentence."""

    ending: Ending
    sentence: str


def proven(goal: Goal, proof: Proof, measured: int) -> End:
    """The goal is proven. measured: stations in all."""
    assert goal.accuracy is not None
    assert proof.rms is not None
    bound = proof.bound or 0.0
    return End(
        "proven",
        f"{1e3 * goal.accuracy:g} mm is proven: at {len(proof.errors)} random stations that no fit has seen "
        f"the {_said(goal, proof.rms)}, at most {1e3 * goal.of_tool(bound):.3f} mm with "
        f"{100 * goal.confidence:g} % confidence, from {measured} stations in all.",
    )


def spent(goal: Goal, measured: int, expected: float | None) -> End:
    """The budget is gone. expected: RMS error of a reading [m], None where there is no fit yet."""
    said = f"The budget is gone after {measured} stations"
    if expected is None:
        return End("budget", f"{said}: too few for a fit.")
    return End("budget", f"{said}: {_said(goal, expected)} is expected, and not proven.")


def no_station_helps(goal: Goal, expected: float, floor: Floor | None, left: float) -> End:
    """Why more stations would change nothing. expected, left: RMS [m] of a new reading's error, and of the fit's."""
    reached = _said(goal, expected)
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


def _said(goal: Goal, rms: float) -> str:
    """An RMS error of readings [m] as the statistic of the tool's that was asked for."""
    name = "95th percentile" if goal.statistic == "p95" else "RMS error"
    return f"{name} {1e3 * goal.of_tool(rms):.3f} mm"
