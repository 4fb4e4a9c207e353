"""Changes taken up in a model, and what the readings then say of others: worked out once for the same changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modcal_core.checking.evidence import ChangeCandidate, ChangeJudge, JudgedChange, log_priors
from modcal_core.checking.fitting import bends, fitted, taken_up
from modcal_core.checking.hypotheses import NOISE, CellChange
from modcal_core.checking.state import CheckState
from modcal_core.geometry import Array


@dataclass
class ChangedState:
    """state: with the changes taken up. fits: these changes as fitted. judge: of what is left."""

    state: CheckState
    fits: Sequence[ChangeCandidate]
    judge: ChangeJudge
    _judged: dict[tuple[int, bool], tuple[CellChange, JudgedChange]] = field(default_factory=dict)

    def judge_all(self, asked: Sequence[CellChange], bent: bool = False) -> tuple[list[JudgedChange], Array]:
        """What speaks for each, and the logarithms of their prior probabilities. bent: fit each by itself where changes
        are so large that their motions bend.
        """
        large = bent and bends(self.judge)
        return [self._one(h, large and (h.sizes > 0 or h.curve >= 0)) for h in asked], log_priors(asked)

    def _one(self, hypothesis: CellChange, alone: bool) -> JudgedChange:
        """What speaks for one change. alone: fit it by itself first."""
        key = id(hypothesis), alone
        if key not in self._judged:  # kept with its key: the number of an object is another's once it is gone
            self._judged[key] = hypothesis, self._ask(hypothesis, alone)
        return self._judged[key][1]

    def _ask(self, hypothesis: CellChange, alone: bool) -> JudgedChange:
        if hypothesis.kind == NOISE:
            return self.judge.noisier(hypothesis)
        if alone:
            return self.judge.judged(fitted([hypothesis], self.state, self.judge, bent=True)[0][0])
        columns = self.state.columns(hypothesis)
        residual = self.state.null.residual
        return self.judge.judged(ChangeCandidate(hypothesis, residual, columns, np.zeros(columns.shape[1])))


class ChangedStates:
    """What stands once changes are taken up, on top of a model beside the readings."""

    def __init__(self, plain: CheckState) -> None:
        self.plain = ChangedState(plain, (), ChangeJudge(plain.null))
        self._known: dict[tuple[int, ...], tuple[list[JudgedChange], ChangedState]] = {}

    def after(self, picked: Sequence[JudgedChange]) -> ChangedState:
        """With these changes taken up."""
        if not picked:
            return self.plain
        key = tuple(map(id, picked))
        if key not in self._known:
            state, fits = taken_up(self.plain.state, self.plain.judge, picked)
            self._known[key] = list(picked), ChangedState(state, fits, ChangeJudge(state.null))
        return self._known[key][1]
