"""What pulls on the arm, where the data show it: the way of weight and one payload for all elastic joints.

A joint's compliance and what loads it are one product. Several joints share what pulls on them, and a joint that is
loaded in many ways shows where from; so both are found together. Each row of a short table - weight pulls another way,
the tip carries more, a stated payload hangs elsewhere - is proposed by the residual of geometry alone, or by effects
found without it. Then effects are looked for once more with it, what pulls is fitted with the arm and all effects, and
the row stands if it is determined and predicts stations that were not fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import (
    FITTED,
    Cell,
    Fit,
    RowView,
    errors,
    identify,
    linearise,
    row_weights,
    squared_residuals,
)
from modcal_core.diagnosis.causes import Diagnosis
from modcal_core.diagnosis.load_hypothesis import LoadHypothesis, Suspicion, by_weight
from modcal_core.diagnosis.pruning import DRAWN_IN, MIN_GAIN
from modcal_core.diagnosis.space import Space
from modcal_core.effects import Drivers, Effect, NominalArm, Term, motion, prior_stds
from modcal_core.effects.families import compliance
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import is_serial_arm

_MAX_ASKED = 400  # samples that a suspicion rests on; more are thinned
_SUSPICIOUS = 20.0  # gain for each number, in units of what is left for each row: chance makes one, other causes some
_WORTH = 0.2  # gain as a share of what is left: less is not worth another search, nor a word on how an arm stands
_SURE = 5.0  # standard deviations from which another way of weight or a mass is accepted
_MIN_TURN = np.radians(2.0)  # a floor is as level as that
_MAX_STD = np.radians(5.0)  # of the way of weight; known worse it is not known
_MAX_KG = 100.0  # above what all but the largest arms carry
_MAX_BESIDE = 1.0  # m; no hand holds what it carries farther from the tip
_NEARLY = 1.02  # of the squares on *explain*: fewer numbers may leave so much more
_ROUNDS = 6  # iterations
_SETTLED = 0.05  # standard deviations
Search = Callable[[Fit], Diagnosis]
_MAX_FITTED = 1000  # samples that what pulls is fitted to, for time


@dataclass(frozen=True)
class FoundPayload:
    """What the tip carries beyond the description, in one recording. since: its begin [s]. mass [kg], place (3,) [m]
    in the tip link, each with its standard deviation; place and place_std None where it is not known.
    """

    since: float
    mass: float
    mass_std: float
    place: Array | None = None
    place_std: Array | None = None


@dataclass(frozen=True)
class Loads:
    """What pulls on the arm, as far as it was found. down: unit vector (3,) in the base, None where it is as known.
    down_std: of either turn across it [rad]. turned: from what was known [rad]. payloads: one a recording; empty where
    none was found. relative: masses are in units of what was carried in the end, as nothing has a known mass. unknown:
    the stations show that weight pulls another way, but not which. arm: with all of that. before: as it was known.
    centre, centre_std: of what a recorded number says is carried, in the tip link (3,) [m]; None where it is not found.
    """

    arm: NominalArm
    before: NominalArm
    down: Array | None = None
    down_std: float = 0.0
    turned: float = 0.0
    payloads: tuple[FoundPayload, ...] = ()
    relative: bool = False
    unknown: bool = False
    centre: Array | None = None
    centre_std: Array | None = None


def weighed(
    geometric: Fit, train: Samples, explain: Samples, search: Search, cell: Cell
) -> tuple[Diagnosis, Loads | None]:
    """The diagnosis with what pulls on the arm as the data show it, and that; None where it is as it was known.

    geometric: the fit of geometry alone. search: makes a diagnosis from such a fit. cell: what is stated of it is not
    asked.
    """
    arm = geometric.model.arm
    if arm is None or not is_serial_arm(arm.chain) or _known_by_effort(train):
        return search(geometric), None
    at = _Weighing(geometric, train, explain, search, cell)
    told = [track.name for track in train.signals if track.name.endswith(compliance.KILOGRAMS)]
    best: _Weighed | None = None
    undetermined = False
    for row in _rows(cell, told, arm):
        asked = replace(row, arm=arm if best is None else best.arm)
        suspicion = at.suspicion(asked)
        plain = suspicion is not None and suspicion.plain
        # 1 kg at the tip is a rough load: where no mass is known, only a large change of the way of weight is accepted
        if not plain and (suspicion is None or (row.tilts and not arm.weighed)) and not row.places:
            continue
        if best is None and (row.places or not plain):
            best = at.plain
        starts = [suspicion.x] if suspicion is not None else []
        for x in [*starts, *(at.beside(asked, at.plain if best is None else best) if row.places else [])]:
            tried = at.tried(row, x, best)
            if tried is None:
                continue
            if not tried.determined:
                undetermined |= row.tilts and tried.std[:2].max() > _MAX_STD
            elif best is None or at.better(tried, best, _WORTH if row.tilts else MIN_GAIN):
                best = tried
                break
    if best is not None and best.row.size:
        return best.found, best.loads(train)
    return at.plain.found, Loads(arm, arm, unknown=True) if undetermined else None


def _rows(cell: Cell, told: Sequence[str], arm: NominalArm) -> list[LoadHypothesis]:
    """The table: what may pull otherwise and is not stated."""
    row = LoadHypothesis(arm, until=cell.between)
    rows = [] if cell.gravity is not None else [replace(row, tilts=True)]
    if not cell.payloads and not told:
        rows.append(replace(row, carries=True))
    if told and not cell.payloads and arm.weighed:
        rows.append(replace(row, told=told[0]))
    return [row for row in rows if row.size]


def _known_by_effort(samples: Samples) -> bool:
    """Whether actuators say what they hold, so that nothing need be known of what pulls."""
    return bool(np.isfinite(samples.effort).mean() > 0.5)


@dataclass(frozen=True)
class _Weighing:
    """The fit of geometry, the sets, and how effects are looked for."""

    geometric: Fit
    train: Samples
    explain: Samples
    search: Search
    cell: Cell

    @cached_property
    def plain(self) -> _Weighed:
        """The diagnosis with what pulls as it was known."""
        arm = self.geometric.model.arm
        assert arm is not None
        nothing = LoadHypothesis(arm, until=self.cell.between)
        return _Weighed(self.search(self.geometric), nothing, np.zeros(0), np.zeros((0, 0)))

    @cached_property
    def left(self) -> tuple[Space, Drivers]:
        """The residual of geometry alone at some of the samples, and their drivers."""
        seen = self.train.join(self.explain)
        few = seen.select(spread_rows(len(seen), _MAX_ASKED))
        drivers = self.geometric.model.drivers(few)
        return Space.of(self.geometric, drivers), drivers

    def suspicion(self, asked: LoadHypothesis) -> Suspicion | None:
        """What the residual of geometry says of a hypothesis, None where it says little."""
        space, drivers = self.left
        found = asked.suspected(space, Drivers(drivers.samples, asked.arm), 0.0 if asked.places else _WORTH)
        chance = 0.0 if found is None else _SUSPICIOUS * asked.size * found.left / max(space.freedom, 1)
        return None if found is None or found.gain < chance else found

    def beside(self, asked: LoadHypothesis, best: _Weighed) -> list[Array]:
        """Where the effects found have the centre of a stated payload (3,), which other causes may hide from geometry
        alone; empty where they do not show it.

        It is asked of them all with one centre in place of what each joint would have of it.
        """
        fit = best.found.fit
        effects = compliance.carrying(fit.model.effects)
        if not any(e.shape.kind == "carried" for e in effects):
            return []
        # with the centre at the tip whole recordings may be far off: they must count, or nothing shows where it is
        alone = self.refitted(fit, effects, reject=False)
        fitted = self.fitted(replace(best.found, fit=alone), asked, np.zeros(asked.size))
        return [fitted.x] if fitted.determined else []

    def tried(self, row: LoadHypothesis, x: Array, best: _Weighed | None) -> _Weighed | None:
        """The best so far with one more row, begun from its numbers x; None if no effect follows it."""
        both = row
        if best is not None:
            both, x = best.row.beside(row), np.concatenate([best.x, x])
        found = self.search(with_arm(self.geometric, both.pulled(x)))
        if not any(row.concerns(effect) for effect in found.fit.model.effects):
            return None
        return self.fitted(found, both, x)

    def fitted(self, found: Diagnosis, row: LoadHypothesis, x: Array) -> _Weighed:
        """What pulls, fitted together with the arm and its effects from these numbers on."""
        fit, covariance = found.fit, np.diag(row.prior_std**2)
        for _ in range(_ROUNDS):
            step, covariance = step_of(fit, self.train, row, x)
            x = x + step
            fit = self.refitted(with_arm(fit, row.pulled(x)), fit.model.effects)
            if np.abs(step / np.sqrt(np.diag(covariance))).max() < _SETTLED:
                break
        causes = tuple(replace(c, effect=e) for c, e in zip(found.causes, fit.model.effects, strict=False))
        return _Weighed(replace(found, fit=fit, causes=causes), row, x, covariance)

    def refitted(self, fit: Fit, effects: Sequence[Effect], reject: bool = True) -> Fit:
        """The fit with these effects in place of its own."""
        start, begin = fit.start.with_effects(tuple(effects)), fit.values
        distances = self.cell.distances
        return identify(start, self.train, fit.parameters, distances, tolerance=FITTED, begin=begin, reject=reject)

    def better(self, tried: _Weighed, best: _Weighed, least: float) -> bool:
        """Whether a diagnosis predicts *explain* better than the best so far by this share at least, or nearly as well
        with fewer numbers.
        """
        limit = DRAWN_IN * float(np.median(self._squares(best))) + 1e-300
        before, after = (float(np.mean(np.minimum(self._squares(at), limit))) for at in (best, tried))
        plainer = not tried.row.tilts and tried.count <= best.count and after < _NEARLY * before
        return after < (1.0 - least) * before or plainer

    def _squares(self, at: _Weighed) -> Array:
        return squared_residuals(errors(at.found.fit.model, self.explain), self.explain, self.geometric.noise)


@dataclass(frozen=True)
class _Weighed:
    """A diagnosis with what pulls: numbers x (k,) of a hypothesis and their covariance (k, k)."""

    found: Diagnosis
    row: LoadHypothesis
    x: Array
    covariance: Array

    @property
    def arm(self) -> NominalArm:
        """The arm as it is pulled."""
        arm = self.found.fit.model.arm
        assert arm is not None
        return arm

    @property
    def count(self) -> int:
        """How many numbers are fitted beyond geometry."""
        return self.row.size + sum(len(effect.values) for effect in self.found.fit.model.effects)

    @property
    def std(self) -> Array:
        """Standard deviations of the numbers, (k,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def determined(self) -> bool:
        """Whether it is determined, and surely other than what was known."""
        row = self.row
        if row.tilts:
            turn, std = float(np.linalg.norm(self.x[:2])), float(self.std[:2].max())
            if std > _MAX_STD or turn < max(_MIN_TURN, _SURE * std):
                return False
        if row.carries:
            mass, first = self._masses[0], 2 * row.tilts  # the mass, or its moment alone, may be what is known
            if np.abs(mass).max() > _MAX_KG or (np.abs(self.x[first:]) < _SURE * self.std[first:]).all():
                return False
            if row.arm.weighed and mass.max() <= 0.0:  # nothing hangs upwards
                return False
        if row.places:
            beside = self.x[-3:]
            return bool((np.abs(beside) > _SURE * self.std[-3:]).any() and np.linalg.norm(beside) < _MAX_BESIDE)
        return True

    @property
    def _masses(self) -> tuple[Array, Array]:
        each = slice(2 * self.row.tilts, None, 4 if self.row.arm.weighed else 1)
        return self.x[each], self.std[each]

    def loads(self, samples: Samples) -> Loads:
        """The loads that the fit found, as reported."""
        row, out = self.row, Loads(self.arm, self.row.arm, relative=not self.row.arm.weighed)
        if row.tilts:
            assert self.arm.inertias is not None
            turn = float(np.linalg.norm(self.x[:2]))
            out = replace(out, down=self.arm.inertias.down, down_std=float(self.std[:2].max()), turned=turn)
        if row.carries:
            begins = [float(samples.stamps.min()), *row.until]
            out = replace(out, payloads=tuple(self._payload(g, since) for g, since in enumerate(begins)))
        if row.places:
            out = replace(out, centre=self.x[-3:], centre_std=self.std[-3:])
        return out

    def _payload(self, g: int, since: float) -> FoundPayload:
        mass, std = self._masses
        if not self.row.arm.weighed:  # the last is the unit
            last = g == len(mass)
            return FoundPayload(since, 1.0, 0.0) if last else FoundPayload(since, 1.0 + float(mass[g]), float(std[g]))
        first = 2 * self.row.tilts + 4 * g
        m, moment = float(mass[g]), self.x[first + 1 : first + 4]
        if abs(m) < _SURE * std[g]:
            return FoundPayload(since, m, float(std[g]))
        # of a quotient: the moment's own deviation, and the mass's through the place
        C = self.covariance[first : first + 4, first : first + 4]
        J = np.column_stack([-moment / m**2, np.eye(3) / m])
        return FoundPayload(since, m, float(std[g]), moment / m, np.sqrt(np.diag(J @ C @ J.T)))


def with_arm(fit: Fit, arm: NominalArm) -> Fit:
    """The fit with loads computed from another arm."""
    return replace(fit, model=replace(fit.model, arm=arm), start=replace(fit.start, arm=arm))


def step_of(fit: Fit, samples: Samples, asked: LoadHypothesis, x: Array) -> tuple[Array, Array]:
    """A step of Gauss and Newton (k,) of what pulls, the arm and its effects free, and the covariance (k, k)."""
    rows = spread_rows(len(samples), _MAX_FITTED)
    few, model, P = samples.select(rows), fit.model, len(fit.parameters)
    weight = row_weights(fit.weights[rows] * (len(samples) / len(rows)), fit.noise, few)
    drivers = model.drivers(few)
    values = np.concatenate([np.zeros(P), *(e.values for e in model.effects)])
    now = linearise(model, fit.parameters, values, few, drivers=drivers)
    view = RowView.of(model, few, drivers)
    J = np.concatenate([now.J, _load_rows(view, model.effects, few, asked, x)])
    prior = np.concatenate(
        [[p.prior_std for p in fit.parameters], *(prior_stds(e, drivers) for e in model.effects), asked.prior_std]
    )
    JW = J * weight
    H = JW @ J.T + np.diag(prior**-2.0)
    g = JW @ now.residual
    k = len(H) - asked.size
    g[:k] = 0.0  # the fit is where its own gradient ends
    g[k:] -= x / asked.prior_std**2
    scale = 1.0 / np.sqrt(np.diag(H))
    covariance = np.linalg.pinv(H * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
    return (covariance @ g)[k:], covariance[k:, k:]


def _load_rows(view: RowView, effects: Sequence[Effect], samples: Samples, asked: LoadHypothesis, x: Array) -> Array:
    """Motion of the tool per unit of each number, (k, 3 N + 3 M)."""
    springs = tuple(effect for effect in effects if by_weight(effect))
    rows = []
    for i, step in enumerate(asked.steps):
        d = step * (np.arange(asked.size) == i)
        up, down = (motion(springs, Drivers(samples, asked.pulled(x + s * d)))[0] for s in (1.0, -1.0))
        terms = [
            Term(place, direction, (up[place][direction] - down[place][direction]) / (2.0 * step))
            for place in up
            for direction in range(6)
            if (up[place][direction] != down[place][direction]).any()
        ]
        rows.append(view.moved_by(terms))
    return np.stack(rows)
