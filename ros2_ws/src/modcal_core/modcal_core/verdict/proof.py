"""Which effects of a fitted model may be named as causes: those that stations which were not used ask for.

All stations judge, in folds of neighbours in time, several times over: geometry and all other effects are fitted to the
other folds, with the effect and without it. It is proved where its gain is surely positive, and more than what is
surely predictable of what is left, and nothing takes its place. While a part is predictable, *none of these* is as
likely: an effect is no cause if something else predicts more, by odds of twenty to one, and it adds hardly anything
beside that. Others are every place with every driver, alone and in groups; of groups that hold the effect itself only
the one that predicts what is left. Where too many stations were rejected besides, nothing is proved.

Where nothing is left, what predicts as much, within these odds or more, is a rival: the effect is one of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.effects import Effect
from modcal_core.effects import columns as effect_columns
from modcal_core.geometry import Array
from modcal_core.robots import is_serial_arm
from modcal_core.verdict.account import resampled
from modcal_core.verdict.case import Case, by_sample
from modcal_core.verdict.crossfit import Baseline, Ridge
from modcal_core.verdict.drivers import OTHER_JOINTS, Part
from modcal_core.verdict.grounds import too_many
from modcal_core.verdict.predictable import MIN_STATIONS, RestStudy
from modcal_core.verdict.rest import rows_asked
from modcal_core.verdict.verdict import MAX_PREDICTABLE, Verdict

_MAX = 250  # samples, for time; more are thinned evenly
_ODDS = float(np.log(20.0))  # nats, beyond which another explanation is no rival
_BLOCKS = 25  # of neighbours in time: five in a fold
_MOST = 100.0  # times the noise's variance, up to which a ridge follows what an effect makes: ten times its size
_NEARLY = 0.9  # of what must be gained, by the first of the deals
_HELD = 1e-3  # ridge in units of a column's square
_IN_WORDS = {"direction": "arrived", "time": "order"}  # drivers of effects, as drivers of parts are called
_LIKE = 0.5  # share of an effect's motion that a place and driver must be able to make to be asked in its place


class Proofs:
    """Asks effects of a fitted case, of what its verdict says is surely predictable of the rest."""

    def __init__(self, case: Case, judged: Verdict) -> None:
        both = judged.predictable_both
        self._case, self._source = case, judged.source
        self._share = both.share if judged.source and both is not None else 0.0
        self._rows = rows_asked(case, _MAX)
        few = case.samples.select(self._rows).stations < MIN_STATIONS
        self._asked = case.fitted and not few and is_serial_arm(case.model.chain)
        self._lost = bool(judged.source) and too_many(case.wrong, case.samples)

    def of(self, numbers: Sequence[int], others: Sequence[Effect] = ()) -> tuple[str, ...] | None:
        """What predicts as much as the effects of these numbers in the model, taken as one; None where they are not
        proved. Where too few stations can be asked they are. others: effects that may be as good.
        """
        if not self._asked or self._lost:
            return None if self._lost else tuple(other.label for other in others)
        study, effects = self._study, self._case.model.effects
        ends = len(self._case.known.parameters) + np.cumsum([0, *(len(e.values) for e in effects)])
        own = np.concatenate([np.arange(ends[i], ends[i] + len(effects[i].amplitudes)) for i in numbers])
        gone = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in numbers])
        columns, first = study.J[own], effects[numbers[0]]
        made = -np.tensordot(np.concatenate([effects[i].amplitudes for i in numbers]), columns, axes=1)
        trial = _Trial.of(study, study.parameters[np.setdiff1d(np.arange(len(study.J)), gone)], made)
        alone = trial.gains(columns)
        if not trial.surely(alone) or alone.sum() < self._share * np.sum(study.rest.residual**2):
            return None
        odds = 2.0 * _ODDS * trial.noise
        least, most = float(alone.sum()) - odds, float(alone.sum()) + odds
        # groups that hold it predict it, whatever else they hold
        held = {part.group for part in self._parts if _is_itself(part, first)} - {self._source}
        groups = [some for group, some in self._groups if group not in held]
        if any(trial.takes(some, columns, alone, most) for some in groups):
            return None
        rivals: dict[str, float] = {}
        found = [(other.label, self._columns(other)) for other in others]
        found += [(part.name, part.columns) for part in self._parts if not _is_itself(part, first)]
        for name, some in found:
            gained = trial.takes(some, columns, alone, least) if trial.alike(some) else 0.0
            if gained > most and self._source:
                return None
            if gained:
                rivals[name] = max(gained, rivals.get(name, gained))
        return tuple(sorted(rivals, key=lambda name: -rivals[name]))

    def _columns(self, effect: Effect) -> Array:
        """What a unit of each amplitude of an effect does to the readings, in units of the noise, (m, 6, N)."""
        rest, at = self._study.rest, self._study.drivers.at
        rows = [rest.view.moved_by(terms) for terms in effect_columns(effect, at)]
        return np.stack([by_sample(row, rest.view.pose, len(rest.samples)) * rest.weight for row in rows])

    @cached_property
    def _study(self) -> RestStudy:
        return RestStudy(self._case, self._rows, True)

    @cached_property
    def _parts(self) -> list[Part]:
        drivers = self._study.drivers
        every = (*drivers.grouped(), *drivers.alone(constant=False), *drivers.beside())
        return [part for part in every if part.place]

    @cached_property
    def _groups(self) -> list[tuple[str, Array]]:
        """Names and columns of groups that may take an effect's place; none where nothing is left to predict."""
        return self._study.groups() if self._source else []


def _is_itself(part: Part, effect: Effect) -> bool:
    """Whether a part is an effect's own place and driver in other words, or a group that has them."""
    kind, _, whose = effect.public_driver.partition(":")
    same = whose in part.driver or (whose != effect.place and OTHER_JOINTS in part.driver)
    return same and effect.place in part.place.split() and _IN_WORDS.get(kind, kind) in part.driver


@dataclass(frozen=True)
class _Trial:
    """A rest with an effect in it, whole (6, N), of which it made a part. deals: of the parameters and other effects.
    noise: mean square of the rest. unit: blocks, (N,).
    """

    deals: Sequence[Baseline]
    whole: Array
    made: Array
    noise: float
    unit: np.ndarray

    @classmethod
    def of(cls, study: RestStudy, free: Array, made: Array) -> _Trial:
        """Of what an effect makes (6, N), beside what is fitted again, (K, 6, N)."""
        rest = study.rest
        unit = np.unique(np.minimum(study.drivers.rank * _BLOCKS, _BLOCKS - 1).astype(int), return_inverse=True)[1]
        deals = study.deals(free[free.any(axis=(1, 2))], unit)
        # samples that were brought in stay as near
        near = np.linalg.norm(rest.residual, axis=0) / np.maximum(np.linalg.norm(rest.raw, axis=0), 1e-300)
        noise = float(np.mean(rest.residual[rest.weight > 0.0] ** 2))
        return cls(deals, rest.residual + made * near, made, noise, unit)

    @cached_property
    def _variance(self) -> float:
        deal = self.deals[0]
        return float(np.clip(np.mean(deal.left(deal.layout.flat(self.whole)) ** 2), 1.0, _MOST))

    def alike(self, columns: Array) -> bool:
        """Whether columns can make most of what the effect makes."""
        deal = self.deals[0]
        new, left = deal.new(columns), deal.left(deal.layout.flat(self.made)).astype(np.float32)
        along = new @ left
        held = new @ new.T + _HELD * np.eye(len(new), dtype=new.dtype)
        return float(along @ np.linalg.solve(held, along)) >= _LIKE * float(left @ left)

    def gains(self, *columns: Array, least: float = -np.inf) -> Array:
        """Squares that columns gain at samples that were not used, mean over the deals, (N,); none where the first deal
        gains clearly less than a least.
        """
        each: list[Array] = []
        for deal in self.deals:
            each.append(self._gains(deal, np.concatenate([deal.new(some) for some in columns])))
            if each[0].sum() < _NEARLY * least:
                return np.zeros(len(self.unit))
        return np.asarray(np.mean(each, axis=0))

    def _gains(self, deal: Baseline, new: Array) -> Array:
        if not len(new):
            return np.zeros(len(self.unit))
        trials = deal.trials(deal.layout.flat(self.whole)[:, None])
        made = Ridge(new, deal, self._variance).predictions(trials)
        best = max((p * (2.0 * trials.left - p) for p in made), key=np.sum)
        return deal.layout.grid(best[:, 0]).sum(axis=0)

    def surely(self, gains: Array) -> bool:
        """Whether gains (N,) are positive in any draw of the blocks."""
        return resampled(gains, self.unit)[1][0] > 0.0

    def takes(self, columns: Array, own: Array, alone: Array, least: float) -> float:
        """What columns gain, where that is more than a least and the effect, which gains ``alone`` (N,) by itself, adds
        hardly anything to them; else nothing.
        """
        gained = self.gains(columns, least=least)
        if gained.sum() <= max(least, 0.0):
            return 0.0
        more = self.gains(columns, own) - gained
        adds = self.surely(more) and more.sum() > MAX_PREDICTABLE * alone.sum()
        return 0.0 if adds else float(gained.sum())
