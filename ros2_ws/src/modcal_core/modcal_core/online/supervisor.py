"""Which model is trusted, and when to calibrate again: the policy of the calibrator node, without ROS.

    learning  ──solve──▶  trusted  ──the watch sees a change──▶  suspected  ──solve──▶  trusted (or still suspected)

A result is accepted by policy when it is surely better on stations that its fit has not seen, or when somebody says so.
Until then the last trusted model stands.

A tracker's driver that is restarted with another setting looks like a base that has moved by metres, or like a load.
Once there are enough samples, the same question is asked as of a recording that is checked.

Every sample's residual is compared with what the model and its covariance expect. For each direction of each place, and
each moment since when it might have moved, the sum of all residuals along that motion is tested (a generalised
likelihood ratio, Willsky & Jones 1976). Two things keep it quiet where nothing happened: one sample can say only so
much, so a glint is no change; and a posture speaks once, by its latest sample, for a model that misses there by a
little does so every time.

What has changed is asked of the same rows and by the same evidence as in a check (:mod:`modcal_core.moves`), of the
samples that are remembered. It is a suspicion: the diagnosis decides on more data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from modcal_core.calibration import INSTRUMENT, Calibration, Model, ModelParameter, NoiseModel, errors
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.hypotheses import MIN, MISREAD, ArmMiss, inverse_pose, recognised
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import is_direct
from modcal_core.moves import (
    BASE,
    FRAME,
    LENGTH,
    LOAD,
    PAYLOAD,
    TOOL,
    ZERO,
    CheckState,
    FrozenKnowledge,
    MoveSearch,
    hypotheses,
    named,
)
from modcal_core.online.estimator import Estimator, FixedLinearisation, RandomWalk, spread

POSTURES = 48  # distinct postures that are remembered
_SAME = 0.03  # rad or m; postures closer than this are one
_MAX_SAID = 6.0  # standard deviations that one sample may say at most
# Of the largest of some thousand sums of squares: 7.7 standard deviations, which no noise reaches, with room for a
# model that misses a little more than it says
ALARM = 60.0
_MIN = 3  # postures that must agree
_KINDS = (BASE, FRAME, TOOL, ZERO, LENGTH, LOAD, PAYLOAD)  # what happens within hours, and shows at a few postures
_MIN_GAP = 0.2  # s between samples of an arm in motion, whose residuals are alike


class ChangeDetector:
    """Watches the residuals of a model that is trusted."""

    def __init__(
        self, model: Model, parameters: Sequence[ModelParameter], covariance: Array, noise: NoiseModel
    ) -> None:
        """covariance: of the parameters, (P, P); what effects add to it is left out. noise: of the fit."""
        self.model = model
        # constants of instruments move nothing that is watched here
        moving = [i for i, p in enumerate(parameters) if p.place != INSTRUMENT]
        every = {_key(p): p for p in (*all_directions(model), *(parameters[i] for i in moving))}
        names, self.directions = list(every), tuple(every.values())
        self._known = np.array([names.index(_key(parameters[i])) for i in moving], dtype=int)
        own = covariance[np.ix_(moving, moving)]
        self.known = FrozenKnowledge(noise, tuple(parameters[i] for i in moving), own)
        self._frozen = FixedLinearisation(model, self.directions, np.zeros(len(self.directions)))
        self.seen: list[Samples] = []  # of the postures that are remembered, a row each
        self.largest = 0.0
        C = len(self.directions)
        self._q, self._b, self._A = np.empty((0, model.chain.n)), np.empty((0, C)), np.empty((0, C))

    def add(self, sample: Samples) -> float | None:
        """Take in one sample; returns the stamp since when something is different, or None."""
        if self.seen and sample.moving[0] and 0.0 <= sample.stamps[0] - self.seen[-1].stamps[0] < _MIN_GAP:
            return None
        residual, motions = self._whitened(sample)
        far = np.flatnonzero(np.abs(self._q - sample.q).max(axis=1) > _SAME)[-POSTURES + 1 :]
        self.seen = [*(self.seen[i] for i in far), sample]
        said = residual * min(1.0, _MAX_SAID / max(float(np.linalg.norm(residual)), 1e-300))
        self._q = np.concatenate([self._q[far], sample.q])
        self._b = np.concatenate([self._b[far], said[None] @ motions])
        self._A = np.concatenate([self._A[far], np.sum(motions**2, axis=0)[None]])
        return self._since()

    def samples(self, since: float) -> Samples:
        """What is remembered of the samples since a stamp [s]."""
        return reduce(Samples.followed_by, [row for row in self.seen if row.stamps[0] >= since])

    def _whitened(self, sample: Samples) -> tuple[Array, Array]:
        """(residual (3 or 6,), motions by all directions (3 or 6, C)) of a sample in standard deviations."""
        r, J = self._frozen(sample)
        part = J[:, self._known]
        L = np.linalg.cholesky(part @ self.known.covariance @ part.T + np.diag(spread(self.known.noise, sample) ** 2))
        rows = np.linalg.solve(L, np.c_[r, J])
        return rows[:, 0], rows[:, 1:]

    def _since(self) -> float | None:
        if len(self.seen) < _MIN:
            return None
        b, A = np.cumsum(self._b[::-1], axis=0), np.cumsum(self._A[::-1], axis=0)  # newest first
        gain = (b**2 / np.maximum(A, 1e-300))[_MIN - 1 :]
        self.largest = float(gain.max())
        if self.largest < ALARM:
            return None
        suffix = int(np.argmax(gain.max(axis=1))) + _MIN
        return float(self.seen[-suffix].stamps[0])


def _key(parameter: ModelParameter) -> tuple[int, int, int]:
    return parameter.place, parameter.direction, parameter.frame


def all_directions(model: Model) -> tuple[ModelParameter, ...]:
    """All six directions of every frame, of every place of the arm, and of the tool."""
    frames = [ModelParameter(f"frame {name}/{d}", 0, d, f) for f, name in enumerate(model.frames) for d in range(6)]
    n = model.chain.tool_place
    places = [ModelParameter(f"place {k}/{d}", k, d) for k in range(1, n + 1) for d in range(6)]
    return (*frames, *places)


@dataclass(frozen=True)
class ChangeHypothesis:
    """place, direction, driver: as in reports. since: [s]. size: RMS of how far the tool is moved [m]. same_as: what
    would explain it as well. sentence: for people. mistake: whether nothing has changed but how readings are written.
    """

    place: str
    direction: str
    driver: str
    since: float
    size: float
    same_as: tuple[str, ...]
    sentence: str
    mistake: bool = False

    @property
    def label(self) -> str:
        """Name of the change without its size."""
        return f"{self.place} {self.direction} by {self.driver}"


def find_change(detector: ChangeDetector, since: float) -> ChangeHypothesis:
    """The row of the catalogue that explains best what the watch has seen since this stamp [s]."""
    model, samples = detector.model, detector.samples(since)
    # in proportion: what grows with time has no size that a model could take
    state = CheckState(model, samples, detector.known, linear=True)
    rows = [h for h in hypotheses(model, samples) if h.kind in _KINDS]
    growing = [replace(h, growing=True) for h in rows if h.motions]
    change = MoveSearch(state, asked=[*rows, *growing]).nearest()
    h, columns = change.hypothesis, state.columns(change.hypothesis)
    said = named(change, columns, 3 * len(samples))
    direction, driver = {ZERO: "axis", LENGTH: "length"}.get(h.kind, "all"), "time (at once)"
    if h.kind in (LOAD, PAYLOAD):
        direction, driver = "axis", f"load:{h.place}"
    elif h.growing:
        driver = "time (growing)"
    return ChangeHypothesis(h.place, direction, driver, since, 1e-3 * said.moved_mm[0], said.same_as, said.sentence)


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
