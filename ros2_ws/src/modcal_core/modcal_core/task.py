"""What a calibration has to fit: samples in one convention, cut into three sets, and what is known of cell and arm."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import (
    SHARES,
    Cell,
    Fit,
    Model,
    ParameterChoice,
    Split,
    enough_for_effects,
    parameter_count,
    require_enough,
    split,
    with_sockets,
)
from modcal_core.diagnosis import Diagnosis, Loads, with_stated
from modcal_core.hypotheses import proved
from modcal_core.measurements import Samples
from modcal_core.moves import find_regimes, moves_of
from modcal_core.robots import Inertias, Mechanism, weightless
from modcal_core.verdict import sane_inertias


@dataclass(frozen=True)
class Task:
    """Samples of an arm and the split of them. regimes: a model to begin from, with base and tool where they stood.

    convention: what was undone in the readings. absurd: sentences on inertias that no arm has.
    """

    chain: Mechanism
    samples: Samples
    sets: Split
    cell: Cell
    inertias: Inertias | None
    regimes: Model | None
    convention: str | None
    absurd: tuple[str, ...]

    @cached_property
    def train(self) -> Samples:
        """The samples that fit the model."""
        return self.samples.select(self.sets.train)

    @cached_property
    def explain(self) -> Samples:
        """The samples that choose what is added to it; none where all others are needed for the geometry."""
        return self.samples.select(self.sets.explain)

    @cached_property
    def held_out(self) -> Samples:
        """The samples that score it."""
        return self.samples.select(self.sets.held_out)


@dataclass(frozen=True)
class Fits:
    """Fits to the training set. chosen: parameters of the geometry. together: whether small curves came last."""

    nominal: Fit
    geometric: Fit
    final: Fit
    chosen: ParameterChoice
    diagnosis: Diagnosis
    loads: Loads | None = None
    together: bool = False


def tasks_of(
    samples: Samples,
    chain: Mechanism,
    rng: np.random.Generator,
    cell: Cell,
    inertias: Inertias | None,
    block: int | None,
) -> tuple[Task, Task]:
    """The task of what is named and shipped, whose split is the samples' own, and that of the score, whose split is
    drawn; they are one object where both splits are the same.

    Arguments are those of :func:`modcal_core.loop.calibrate`. Raises ModcalError for too few samples, or readings in a
    convention that cannot be undone.
    """
    cell.require_frames(samples.frames)
    cell = cell.met(samples)
    samples = with_sockets(samples, cell, chain)
    count = parameter_count(chain, samples, cell.kept, cell.distances)
    require_enough(samples, count, len(cell.distances), share=SHARES[0] + SHARES[1])
    samples, convention = proved(samples, chain)
    inertias, absurd = sane_inertias(inertias, chain)
    if cell.gravity is not None:
        inertias = (inertias or weightless(chain.n)).pulled(cell.gravity)
    samples = with_stated(samples, cell, inertias is not None and inertias.known)
    regimes = find_regimes(samples, chain, cell, inertias, cell.moved)
    moves = moves_of(regimes) if regimes else ()
    both = []
    for draw in (np.random.default_rng(0), rng):
        sets = split(samples, draw, block, [move.at for move in moves])
        if not enough_for_effects(samples.select(sets.train), count, len(cell.distances)):
            sets = replace(sets, train=np.union1d(sets.train, sets.explain), explain=sets.explain[:0])
        both.append(Task(chain, samples, sets, cell, inertias, regimes, convention, absurd))
    own, drawn = both
    return own, own if np.array_equal(own.sets.role, drawn.sets.role) else drawn
