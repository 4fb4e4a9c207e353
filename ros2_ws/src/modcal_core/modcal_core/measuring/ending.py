"""How a measurement ended, in a sentence: proven, out of budget, or that no further station would help, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modcal_core.measuring.goal import Goal
from modcal_core.measuring.proof import Proof
from modcal_core.verdict.floor import Floor

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
