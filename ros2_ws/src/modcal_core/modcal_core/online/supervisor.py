"""Which model is trusted, and when to calibrate again: the policy of the calibrator node, without ROS.

    learning  ──solve──▶  trusted  ──the watch sees a change──▶  suspected  ──solve──▶  trusted (or still suspected)

A result is accepted by policy when it is surely better on stations that its fit has not seen, or when somebody says so.
Until then the last trusted model stands.
"""

from __future__ import annotations

from dataclasses import dataclass

from modcal_core.calibration.store import Calibration
from modcal_core.measurements.samples import Samples
from modcal_core.online.change_hypothesis import ChangeHypothesis
from modcal_core.online.estimator import RandomWalk
from modcal_core.online.live import Live

ASKED, BETTER = "asked", "better"
LEARNING, TRUSTED, SUSPECTED = "learning", "trusted", "suspected"


@dataclass(frozen=True)
class Policy:
    """accept: "asked" or "better". first_solve: stations after which the first solve begins by itself; 0: when asked.
    after_change: stations since a change after which the diagnosis is opened again; 0: when asked.
    """

    accept: str = BETTER
    first_solve: int = 0
    after_change: int = 20


class Supervisor:
    """Holds the trusted calibration and the candidate, and says when to solve."""

    def __init__(self, policy: Policy, random_walk: RandomWalk | None = None) -> None:
        self.policy = policy
        self._random_walk = random_walk
        self.live: Live | None = None
        self.candidate: Calibration | None = None
        self.stations = 0
        self._last_station = -1
        self._wait = policy.first_solve

    def follow(self, policy: Policy) -> None:
        """Go by another policy from now on; what it counts begins with the last solve, or the last change."""
        before, self.policy = self.policy, policy
        learning = self.live is None
        old, new = (p.first_solve if learning else p.after_change for p in (before, policy))
        if old != new:
            since = self._wait - old if old else 0  # stations that had been counted when the wait began
            self._wait = max(since, 0) + new if new else 0

    @property
    def trusted(self) -> Calibration | None:
        """The calibration that is published."""
        return self.live.calibration if self.live else None

    @property
    def state(self) -> str:
        """learning, trusted or suspected."""
        if self.live is None:
            return LEARNING
        return SUSPECTED if self.hypothesis else TRUSTED

    @property
    def hypothesis(self) -> ChangeHypothesis | None:
        """What seems to have changed since the model was trusted."""
        return self.live.hypothesis if self.live else None

    @property
    def changed(self) -> float | None:
        """Since when [s]."""
        return self.live.changed if self.live else None

    def add(self, sample: Samples) -> None:
        """Take in one sample (a row)."""
        station = int(sample.station[0])
        self.stations += station != self._last_station
        self._last_station = station
        if self.live is not None:
            self.live.add(sample)

    def wants_solve(self) -> bool:
        """Whether it is time to calibrate again."""
        if self.live is None:
            return 0 < self._wait <= self.stations and self.candidate is None
        if self.hypothesis is None or self.hypothesis.mistake:  # of readings that are written wrongly nothing is solved
            return False
        return 0 < self._wait <= self.live.since

    def solved(self, calibration: Calibration, better: bool) -> bool:
        """Take a result; returns whether it is trusted from now on."""
        self.candidate = calibration
        if self.policy.accept == BETTER and better:
            return self.accept()
        self.failed()
        return False

    def failed(self) -> None:
        """A solve brought nothing: wait for as many stations again."""
        if self.live is None:
            self._wait = self.stations + self.policy.first_solve if self.policy.first_solve else 0
        else:
            self._wait = self.live.since + self.policy.after_change if self.policy.after_change else 0

    def accept(self) -> bool:
        """Trust the candidate; returns whether there was one."""
        if self.candidate is None:
            return False
        self.trust(self.candidate)
        return True

    def trust(self, calibration: Calibration) -> None:
        """Trust this calibration, and watch it from now on."""
        self.live = Live(calibration, self._random_walk)
        self.candidate = None
        self._wait = self.policy.after_change

    def reset(self) -> None:
        """Forget the candidate and what was suspected; what is trusted stays."""
        self.candidate = None
        self.stations = 0
        self._wait = self.policy.first_solve
        if self.live is not None:
            self.trust(self.live.calibration)
