"""Which model is trusted, and when to calibrate again: the policy of the calibrator node, without ROS.

    learning  ──solve──▶  trusted  ──the watch sees a change──▶  suspected  ──solve──▶  trusted (or still suspected)

A result is accepted by policy when it is surely better on stations that its fit has not seen, or when somebody says so.
Until then the last trusted model stands.

A tracker's driver that is restarted with another setting looks like a base that has moved by metres, or like a load.
Once there are enough samples, the same question is asked as of a recording that is checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Calibration, Model, NoiseModel, errors
from modcal_core.errors import BadRecording
from modcal_core.hypotheses import MIN, MISREAD, ArmMiss, inverse_pose, recognised
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import is_direct
from modcal_core.online.change_detector import ChangeDetector, ChangeHypothesis, find_change
from modcal_core.online.estimator import Estimator, RandomWalk

_UNTOLD = "readings in another unit or convention"
_STRANGE = 3  # readings in a row from an unknown frame, after which it stands for a known one


def or_misread(change: ChangeHypothesis, model: Model, samples: Samples, noise: NoiseModel) -> ChangeHypothesis:
    """The change; the mistake in its place, where the samples since then are of the arm once that is undone.

    While there are too few to tell, a change that is larger than an arm's own is said to be either.
    """
    off, reach = errors(model, samples), model.chain.reach()
    if len(samples) < MIN:
        turned = float(np.median(off.rotation_norm)) if samples.is_pose.all() else 0.0
        near = ArmMiss(float(np.median(off.position_norm)), turned).size(reach) < MISREAD * reach
        also = f"{change.sentence} It may as well be {_UNTOLD}."
        return change if near else replace(change, same_as=(_UNTOLD, *change.same_as), sentence=also)
    try:
        if recognised(model, samples, noise).undone is None:
            return change
        said = f"{inverse_pose().what}: {inverse_pose().remedy}"
    except BadRecording as mistake:
        said = str(mistake)
    size = float(np.sqrt(np.mean(off.position_norm**2)))
    return ChangeHypothesis("tracker", "convention", change.driver, change.since, size, (), said, mistake=True)


def renamed(sample: Samples, known: Sequence[str]) -> ChangeHypothesis:
    """What readings say that come from a frame that the calibration does not know, and no more from those it does."""
    name = sample.frames[sample.frame[0]]
    said = f"frame '{name}' is read in place of {', '.join(known)}: give it its name of then, or calibrate again"
    return ChangeHypothesis(name, "all", "time (at once)", float(sample.stamps[0]), 0.0, (), said, mistake=True)


_RIDGE = 1e-12  # of each variance; a covariance that was written down may have lost its last digits


class Live:
    """Follows one calibration with every sample.

    estimator: the parameters as they stand now. detector: whether the calibration still holds. hypothesis: what has
    changed, None while nothing has. changed: since when [s]. since: samples taken in after that. strange: samples of
    frames that the calibration does not know, and of kinds that are no positions.
    """

    def __init__(self, calibration: Calibration, random_walk: RandomWalk | None = None) -> None:
        """Begin with a calibration that carries its uncertainty; raises ValueError for one that does not."""
        known = calibration.uncertainty
        if known is None:
            raise ValueError("a calibration without its uncertainty cannot be followed")
        covariance = known.covariance + _RIDGE * np.diag(np.diag(known.covariance))
        self.calibration = calibration
        model, noise = calibration.calibrated, calibration.noise
        self.estimator = Estimator(model, known.parameters, noise, covariance, random_walk, calibration.kind)
        self.detector = ChangeDetector(model, known.parameters, covariance, noise)
        self.hypothesis: ChangeHypothesis | None = None
        self.changed: float | None = None
        self.since = 0
        self.strange = self._in_a_row = 0

    def add(self, sample: Samples) -> None:
        """Take in one sample (a row)."""
        frames = self.calibration.calibrated.frames
        known = int(sample.frame[0]) < len(frames)
        if not known or not is_direct([str(sample.kind[0])]):
            self.strange += 1
            self._in_a_row += not known
            if self._in_a_row >= _STRANGE and self.changed is None:
                self.since, self.hypothesis = self._in_a_row, self.hypothesis or renamed(sample, frames)
            return
        self._in_a_row = 0
        self.estimator.update(sample)
        changed = self.detector.add(sample)
        if changed is not None and self.hypothesis is None:
            self.changed = changed
        if self.changed is None:
            return
        self.since += 1
        # asked again as samples come in: the first answer rests on very few
        if self.hypothesis is None or (self.since & (self.since - 1)) == 0:
            since, model = min(self.changed, float(self.detector.seen[-1].stamps[0])), self.detector.model
            change, samples = find_change(self.detector, since), self.detector.samples(since)
            self.hypothesis = or_misread(change, model, samples, self.calibration.noise)


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
        self._begun = 0  # stations, or those since a change, at the last solve that brought nothing

    @property
    def _every(self) -> int:
        """Stations after which a solve begins by itself; 0: none does."""
        return self.policy.first_solve if self.live is None else self.policy.after_change

    @property
    def _count(self) -> int:
        """Stations that count towards it."""
        return self.stations if self.live is None else self.live.since

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
            wanted = self.candidate is None
        else:  # of readings that are written wrongly nothing is solved
            wanted = self.hypothesis is not None and not self.hypothesis.mistake
        return wanted and 0 < self._every <= self._count - self._begun

    def solved(self, calibration: Calibration, better: bool) -> bool:
        """Take a result; returns whether it is trusted from now on."""
        self.candidate = calibration
        if self.policy.accept == BETTER and better:
            return self.accept()
        self.failed()
        return False

    def failed(self) -> None:
        """A solve brought nothing: wait for as many stations again."""
        self._begun = self._count

    def accept(self) -> bool:
        """Trust the candidate; returns whether there was one."""
        if (candidate := self.candidate) is not None:
            self.trust(candidate)
        return candidate is not None

    def trust(self, calibration: Calibration) -> None:
        """Trust this calibration, and watch it from now on."""
        self.live = Live(calibration, self._random_walk)
        self.candidate = None
        self._begun = 0

    def reset(self) -> None:
        """Forget the candidate and what was suspected; what is trusted stays."""
        self.candidate = None
        self.stations = self._begun = 0
        if self.live is not None:
            self.trust(self.live.calibration)
