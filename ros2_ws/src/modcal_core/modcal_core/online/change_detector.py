"""Has anything changed since the model was trusted?

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

from modcal_core.calibration import INSTRUMENT, Model, ModelParameter, NoiseModel
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
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
from modcal_core.online.estimator import FixedLinearisation, spread

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
