"""Which effects of a fitted model may be named as causes: those that stations which were not used ask for.

All stations judge, block by block of neighbours in time: each block is predicted from all others. What is left of
geometry is taken for a Gaussian process of everything else that may err: every place with every driver (:mod:`drivers`)
and all other effects, each expected to make as much as any other; geometry is fitted with it. An effect is proved where
the blocks are likelier with it than without it, surely, and by odds of twenty to one. It has then been asked beside
everything that could take its place, so what is named does not hang on what else a search found. Only what is the
effect's own place and driver in other words stays out.

What is as likely in its place, within these odds, is a rival: the effect is one of these. Where something in its place
is likelier beyond the odds, it is no cause. Where an effect makes less beside the others than what is predictable of
the rest, or may be, *none of these* is as likely, and it is no cause either. Where too many stations were rejected
besides, nothing is proved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.effects import Effect, is_move
from modcal_core.effects import columns as effect_columns
from modcal_core.geometry import Array
from modcal_core.robots import is_serial_arm
from modcal_core.verdict.account import DRAWS
from modcal_core.verdict.case import Case, by_sample
from modcal_core.verdict.drivers import ON_BASE, OTHER_JOINTS, Part
from modcal_core.verdict.grounds import too_many
from modcal_core.verdict.predictable import MIN_STATIONS, RestStudy
from modcal_core.verdict.rest import rows_asked
from modcal_core.verdict.verdict import MAX_PREDICTABLE, Verdict

_MAX = 250  # poses, or twice as many points, for time; more are thinned evenly
_ODDS = float(np.log(20.0))  # nats, beyond which another explanation is no rival
_LEAST = 1.0  # %; lower end of what blocks gain: one of thousands of candidates was chosen for these stations
_BLOCKS = 25  # of neighbours in time
_SHARES = (0.05, 0.5)  # of the squares, which everything may be expected to make; the likelier counts
_OWN_SHARE = 0.5  # the same of one effect
_LIKE = 0.5  # share of an effect's motion that a place and driver must be able to make to be asked in its place
_HELD = 1e-3  # ridge in units of a column's square
# drivers of effects, as drivers of parts are called
_IN_WORDS = {"direction": "arrived", "path": "arrived", "velocity": "fast", "acceleration": "fast", "time": "order"}
_IN_WORDS |= {f"tip_acceleration_{axis}": "accelerated" for axis in "xyz"}


class Proofs:
    """Asks effects of a fitted case, of what its verdict says is surely predictable of the rest."""

    def __init__(self, case: Case, judged: Verdict) -> None:
        self._case = case
        self._rows = rows_asked(case, _MAX if case.samples.is_pose.any() else 2 * _MAX)
        few = case.samples.select(self._rows).stations < MIN_STATIONS
        self._asked = case.fitted and not few and is_serial_arm(case.model.chain)
        self._lost = bool(judged.source) and too_many(case.wrong, case.samples)
        both = judged.predictable_both
        self._least = max(both.share if judged.source and both is not None else 0.0, MAX_PREDICTABLE)

    def of(self, numbers: Sequence[int], others: Sequence[Effect] = ()) -> tuple[str, ...] | None:
        """What predicts as much as the effects of these numbers in the model, taken as one; None where they are not
        proved. Where too few stations can be asked they are. others: effects that may be as good.
        """
        if not self._asked or self._lost:
            return None if self._lost else tuple(other.label for other in others)
        beside = self._everything.beside(numbers, others)
        gained, sure = _sure(beside.gains())
        if not sure or beside.size < self._least * self._everything.left:
            return None
        rivals: dict[str, float] = {}
        for name, columns in beside.alike():
            instead = float(beside.gains(columns).sum())
            if instead > gained - _ODDS and not _sure(beside.gains(after=columns))[1]:
                if instead > gained + _ODDS:
                    return None
                rivals[name] = max(instead, rivals.get(name, instead))
        return tuple(sorted(rivals, key=lambda name: -rivals[name]))

    @cached_property
    def _everything(self) -> _Everything:
        return _Everything(self._case, RestStudy(self._case, self._rows, True))


def _sure(gains: Array) -> tuple[float, bool]:
    """Sum of what blocks gain [nats], and whether it is more than the odds, and positive in any draw of the blocks."""
    gained = float(gains.sum())
    draws = np.random.default_rng(0).integers(len(gains), size=(DRAWS, len(gains)))
    return gained, gained > _ODDS and float(np.percentile(gains[draws].sum(axis=1), _LEAST)) > 0.0


def _is_itself(part: Part, effect: Effect) -> bool:
    """Whether a part is an effect's own place and driver in other words, or a group that has them."""
    kind, _, whose = effect.public_driver.partition(":")
    if part.driver == ON_BASE:
        return effect.place == "base" and kind == "load"
    same = whose in part.driver or (whose != effect.place and OTHER_JOINTS in part.driver)
    return bool(part.place) and same and effect.place in part.place.split() and _IN_WORDS.get(kind, kind) in part.driver


class _Everything:
    """A rest with all effects in it but moves, and its covariance by geometry, moves, and all that may err.

    Components of samples (6, N) lie in one vector (R,).
    """

    def __init__(self, case: Case, study: RestStudy) -> None:
        self._effects, self._study, self._J, rest = case.model.effects, study, study.J, study.rest
        self._seen = rest.weight > 0.0
        unit = np.unique(np.minimum(study.drivers.rank * _BLOCKS, _BLOCKS - 1).astype(int), return_inverse=True)[1]
        of = np.broadcast_to(unit, self._seen.shape)[self._seen]
        self._blocks = [np.flatnonzero(of == k) for k in range(int(of.max()) + 1)]
        first = len(case.known.parameters)
        ends = first + np.cumsum([0, *(len(e.values) for e in self._effects)])
        own = [np.arange(a, a + len(e.amplitudes)) for a, e in zip(ends[:-1], self._effects, strict=True)]
        self._amplitudes, self._moves = own, [is_move(effect) for effect in self._effects]
        back = [self._made(i) for i, move in enumerate(self._moves) if not move]
        self._whole = np.sum([rest.residual[self._seen], *back], axis=0)
        drivers = study.drivers
        self._parts = [*drivers.grouped(), *drivers.alone(constant=False), *drivers.beside()]
        self._rows = [self._together(part.columns) for part in self._parts]
        self._power = float(self._whole @ self._whole)
        self._of_effects = [
            self._flat(study.parameters[rows]) if move else self._together(self._J[rows])
            for rows, move in zip(own, self._moves, strict=True)
        ]
        both = list(zip(self._of_effects, self._moves, strict=True))
        many = [*self._rows, *(x for x, move in both if not move)]
        X = np.concatenate(many)
        F = np.concatenate([self._flat(study.parameters[:first]), *(x for x, move in both if move)])
        gram = (X.T @ X).astype(float)
        self.left = float(np.sum(rest.residual[self._seen] ** 2))
        self._noise, self._fitted = self.left / len(of), self._flat(study.parameters)
        steady = self._noise * np.eye(len(of)) + F.T @ F
        sizes = [share * self._power / len(many) for share in _SHARES]
        found: list[tuple[float, Array]] = [(size, np.linalg.inv(steady + size * gram)) for size in sizes]
        self._size, self._P = max(found, key=lambda pair: _scores(pair[1], self._whole, self._blocks).sum())

    def beside(self, numbers: Sequence[int], others: Sequence[Effect]) -> _Beside:
        """Everything but the effects of these numbers, taken as one, and what is them in other words.

        others: effects that may be as good.
        """
        effect = self._effects[numbers[0]]
        itself = [_is_itself(part, effect) for part in self._parts]
        held = {part.group for part, own in zip(self._parts, itself, strict=True) if own and part.group}
        # a part without a place is of its whole group, and may be the effect as well
        gone = [
            np.sqrt(self._size) * x
            for x, part, own in zip(self._rows, self._parts, itself, strict=True)
            if own or (not part.place and part.group in held)
        ]
        y = self._whole
        for i in numbers:
            gone.append(self._of_effects[i] * (1.0 if self._moves[i] else np.sqrt(self._size)))
            y = y + self._made(i) if self._moves[i] else y
        P = _updated(self._P, np.concatenate(gone), -1.0)
        own_rows = np.concatenate([self._amplitudes[i] for i in numbers])
        own = self._together(self._J[own_rows])
        new = [(other.label, self._together(self._columns(other))) for other in others]
        new += [
            (part.name, x)
            for x, part, own_part in zip(self._rows, self._parts, itself, strict=True)
            if part.place and not own_part and part.name
        ]
        made = np.sum([self._made(i) for i in numbers], axis=0)
        F = np.delete(self._fitted, own_rows, axis=0)
        new_to_it = made - np.linalg.solve(self._noise * np.eye(len(F)) + F @ F.T, F @ made) @ F
        return _Beside(P, y, own, made, float(new_to_it @ new_to_it), new, self._power, self._blocks)

    def _made(self, i: int) -> Array:
        """What an effect of the model makes of the rest, (R,)."""
        own = self._effects[i].amplitudes
        return np.asarray(np.tensordot(own, self._J[self._amplitudes[i]], axes=1)[self._seen])

    def _columns(self, effect: Effect) -> Array:
        """What a unit of each amplitude of an effect does to the readings, in units of the noise, (m, 6, N)."""
        rest, at = self._study.rest, self._study.drivers.at
        rows = [rest.view.moved_by(terms) for terms in effect_columns(effect, at)]
        return np.stack([by_sample(row, rest.view.pose, len(rest.samples)) * rest.weight for row in rows])

    def _flat(self, columns: Array) -> Array:
        return np.asarray(columns[:, self._seen])

    def _together(self, columns: Array) -> Array:
        """Columns (D, 6, N) as (D, R), of equal length, and of unit length together."""
        x = self._flat(columns)
        size = np.linalg.norm(x, axis=1)
        x, size = x[size > 0.0], size[size > 0.0]
        return np.asarray(x / (size[:, None] * np.sqrt(max(len(x), 1))), np.float32)


@dataclass(frozen=True)
class _Beside:
    """What an effect is asked beside: the inverse P (R, R) of the covariance of a rest y (R,), and others (name, rows).

    own: the effect's rows, of unit length together, (m, R). made: what it makes of the rest, (R,). size: its squares
    but for what geometry and other effects can make. power: squares of y.
    """

    P: Array
    y: Array
    own: Array
    made: Array
    size: float
    others: list[tuple[str, Array]]
    power: float
    blocks: list[np.ndarray]

    def gains(self, rows: Array | None = None, after: Array | None = None) -> Array:
        """By how much likelier each block is with the effect than without it [nats], (blocks,). rows: asked in its
        place. after: what is there already, as large as the effect may be.
        """
        P = self.P if after is None else self._with(self.P, after)
        without, rows = _scores(P, self.y, self.blocks), self.own if rows is None else rows
        return _scores(self._with(P, rows), self.y, self.blocks) - without

    def alike(self) -> list[tuple[str, Array]]:
        """Others that can make most of what the effect makes beside everything."""
        left, out = self.P @ self.made, []
        whole = float(self.made @ left)
        for name, rows in self.others:
            along = rows @ left
            own = rows @ self.P @ rows.T
            held = own + _HELD * np.trace(own) / max(len(own), 1) * np.eye(len(own))
            if len(rows) and float(along @ np.linalg.solve(held, along)) >= _LIKE * whole:
                out.append((name, rows))
        return out

    def _with(self, P: Array, rows: Array) -> Array:
        return _updated(P, np.sqrt(_OWN_SHARE * self.power) * rows, 1.0)


def _scores(P: Array, y: Array, blocks: Sequence[np.ndarray]) -> Array:
    """Log density of each block of y (R,) under what the others predict, but for a constant, (blocks,).

    P: inverse of the covariance.
    """
    z, out = P @ y, []
    for at in blocks:
        own = P[np.ix_(at, at)]
        out.append(0.5 * (np.linalg.slogdet(own)[1] - z[at] @ np.linalg.solve(own, z[at])))
    return np.array(out)


def _updated(P: Array, rows: Array, sign: float) -> Array:
    """The inverse (R, R) of a covariance to which products of rows (D, R) are added (sign 1) or taken away (−1)."""
    along = rows.astype(float) @ P
    return np.asarray(P - along.T @ np.linalg.solve(sign * np.eye(len(rows)) + along @ rows.T, along))
