"""What pulls on the arm, where the data show it: the way of weight and one payload for all elastic joints.

A joint's compliance and what loads it are one product. Several joints share what pulls on them, and a joint that is
loaded in many ways shows where from; so both are found together. The residual of the geometry alone says whether
another way of weight, or another load at the tip, would explain much more by elastic joints. Then effects are looked
for once more with it, and it is kept only where that predicts stations better that were not fitted, and only if it is
determined. What pulls is fitted to the end together with the arm and all effects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import (
    FITTED,
    AnyDistance,
    Cell,
    Fit,
    Model,
    RowView,
    errors,
    identify,
    linearise,
    row_weights,
    squared_residuals,
)
from modcal_core.diagnosis.causes import Diagnosis
from modcal_core.diagnosis.load_hypothesis import LoadHypothesis, Suspicion
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
_NEARLY = 1.02  # of the squares on *explain*: one payload for all joints may leave so much more than one for each
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
    at = _Weighing(geometric, train, explain, search, cell.distances)
    best: Diagnosis | None = None
    told = [
        track.name for track in train.signals if track.name.endswith(compliance.KILOGRAMS)
    ]  # topics say what is carried
    stated = {True: cell.gravity is not None, False: bool(cell.payloads or told)}
    kept = LoadHypothesis(arm, until=cell.between)
    for tilts in (True, False):
        if stated[tilts]:
            continue
        asked = replace(kept, arm=arm if best is None else _arm_of(best), tilts=tilts, carries=not tilts)
        suspicion = at.suspicion(asked)
        # 1 kg at the tip is a rough load: where no mass is known, only a large change of the way of weight is accepted
        if suspicion is None or (tilts and not arm.weighed and not suspicion.plain):
            continue
        if best is None and not suspicion.plain:
            best = search(geometric)
        if (tried := at.tried(asked, suspicion.x, best)) is not None:
            best = tried
            kept = replace(kept, tilts=kept.tilts or tilts, carries=not tilts)
    if told and not cell.payloads and arm.weighed:
        asked = replace(kept, arm=arm if best is None else _arm_of(best), tilts=False, told=told[0])
        suspicion = at.suspicion(asked)
        placed = at.placed(asked, suspicion.x, best) if suspicion else None
        if placed is None:  # other causes may hide it until they are found
            best = best or search(geometric)
            x = at.beside(asked, best)
            placed = None if x is None else at.placed(asked, x, best)
        if placed is not None:
            best, kept = placed, replace(kept, told=told[0])
    nothing = Loads(arm, arm, unknown=True) if at.undetermined else None
    if best is None or not kept.size:
        return best or search(geometric), nothing
    return at.settled(best, kept) or (search(geometric), nothing)


def _known_by_effort(samples: Samples) -> bool:
    """Whether actuators say what they hold, so that nothing need be known of what pulls."""
    return bool(np.isfinite(samples.effort).mean() > 0.5)


def _arm_of(found: Diagnosis) -> NominalArm:
    arm = found.fit.model.arm
    assert arm is not None
    return arm


@dataclass(frozen=True)
class _Weighing:
    """The fit of geometry, the sets, and how effects are looked for.

    undetermined: hypotheses on the way of weight that the stations bear out but do not determine; it is added to.
    """

    geometric: Fit
    train: Samples
    explain: Samples
    search: Search
    distances: tuple[AnyDistance, ...]
    undetermined: list[LoadHypothesis] = field(default_factory=list)

    def suspicion(self, asked: LoadHypothesis) -> Suspicion | None:
        """What the residual of geometry says of a hypothesis, None where it says little."""
        if not asked.size:
            return None
        space, drivers = self.seen
        found = asked.suspected(space, Drivers(drivers.samples, asked.arm), 0.0 if asked.places else _WORTH)
        chance = 0.0 if found is None else _SUSPICIOUS * asked.size * found.left / max(space.freedom, 1)
        return None if found is None or found.gain < chance else found

    def tried(self, asked: LoadHypothesis, x: Array, best: Diagnosis | None) -> Diagnosis | None:
        """The diagnosis with what is suspected, None where it predicts no better than the best so far."""
        new = self.search(with_arm(self.geometric, asked.pulled(x)))
        if not _by_weight(new.fit.model):
            return None
        fitted = self.fitted(new.fit, asked, x)
        if not fitted.sure(asked):
            if asked.tilts and fitted.std[:2].max() > _MAX_STD:
                self.undetermined.append(asked)
            return None
        new = replace(new, fit=fitted.fit)
        if best is None:
            return new
        before, after = self.missed(best, best), self.missed(new, best)
        plainer = asked.carries and _count(new) + asked.size <= _count(best) and after < _NEARLY * before
        least = _WORTH if asked.tilts else MIN_GAIN
        return new if after < (1.0 - least) * before or plainer else None

    def beside(self, asked: LoadHypothesis, best: Diagnosis) -> Array | None:
        """Where the effects found have the centre of a stated payload (3,), None where they do not show it.

        It is asked of them all with one centre in place of what each joint would have of it.
        """
        effects = compliance.carrying(best.fit.model.effects)
        if not any(e.shape.kind == "carried" for e in effects):
            return None
        # with the centre at the tip whole recordings may be far off: they must count, or nothing shows where it is
        alone = identify(
            best.fit.start.with_effects(effects), self.train, best.fit.parameters, self.distances,
            tolerance=FITTED, begin=best.fit.values, reject=False,
        )  # fmt: skip
        fitted = self.fitted(alone, asked, np.zeros(asked.size))
        return fitted.x if fitted.sure(asked) else None

    def placed(self, asked: LoadHypothesis, x: Array, best: Diagnosis | None) -> Diagnosis | None:
        """The diagnosis with the centre of a stated payload, None where it predicts no better than with the tip's.

        best: to compare it with; None: the same effects with the centre at the tip.
        """
        new = self.search(with_arm(self.geometric, asked.pulled(x)))
        if not any(e.shape.kind in ("carried", "product") for e in new.fit.model.effects):
            return None
        fitted = self.fitted(new.fit, asked, x)
        if not fitted.sure(asked):
            return None
        new = replace(new, fit=fitted.fit)
        if best is None:
            tip = with_arm(fitted.fit, asked.arm)
            start = tip.start.with_effects(tip.model.effects)
            alone = identify(start, self.train, tip.parameters, self.distances, tolerance=FITTED, begin=tip.values)
            best = replace(new, fit=alone)
        before, after = self.missed(best, best), self.missed(new, best)
        plainer = _count(new) + asked.size <= _count(best) and after < _NEARLY * before
        return new if after < (1.0 - MIN_GAIN) * before or plainer else None

    @cached_property
    def seen(self) -> tuple[Space, Drivers]:
        """The residual of geometry alone at some of the samples, and their drivers."""
        both = _thinned(self.train.join(self.explain), _MAX_ASKED)
        drivers = self.geometric.model.drivers(both)
        return Space.of(self.geometric, drivers), drivers

    def missed(self, found: Diagnosis, other: Diagnosis) -> float:
        """Mean square on *explain*, each sample's drawn in to a limit that is the same for the other."""
        noise = self.geometric.noise
        squares = [squared_residuals(errors(f.fit.model, self.explain), self.explain, noise) for f in (found, other)]
        limit = DRAWN_IN * float(np.median(squares[1])) + 1e-300
        return float(np.mean(np.minimum(squares[0], limit)))

    def fitted(self, fit: Fit, asked: LoadHypothesis, x: Array) -> _Fitted:
        """What pulls, fitted together with the arm and its effects from these numbers on."""
        covariance = np.diag(asked.prior_std**2)
        for _ in range(_ROUNDS):
            step, covariance = step_of(fit, self.train, asked, x)
            x = x + step
            moved = with_arm(fit, asked.pulled(x))
            start = moved.start.with_effects(fit.model.effects)
            fit = identify(start, self.train, fit.parameters, self.distances, tolerance=FITTED, begin=fit.values)
            if np.abs(step / np.sqrt(np.diag(covariance))).max() < _SETTLED:
                break
        return _Fitted(fit, x, covariance)

    def settled(self, best: Diagnosis, asked: LoadHypothesis) -> tuple[Diagnosis, Loads] | None:
        """All that was found, fitted together; None where it is not sure then."""
        fitted = self.fitted(best.fit, asked, _numbers(asked, _arm_of(best)))
        if not fitted.sure(asked):
            return None
        effects = fitted.fit.model.effects
        causes = tuple(replace(c, effect=e) for c, e in zip(best.causes, effects, strict=True))
        return replace(best, fit=fitted.fit, causes=causes), fitted.loads(asked, self.train)


@dataclass(frozen=True)
class _Fitted:
    """A fit with what pulls: numbers x (k,) of a hypothesis and their covariance (k, k)."""

    fit: Fit
    x: Array
    covariance: Array

    @property
    def std(self) -> Array:
        return np.sqrt(np.diag(self.covariance))

    def sure(self, asked: LoadHypothesis) -> bool:
        """Whether it is determined, and surely other than what was known."""
        if asked.tilts:
            turn, std = float(np.linalg.norm(self.x[:2])), float(self.std[:2].max())
            if std > _MAX_STD or turn < max(_MIN_TURN, _SURE * std):
                return False
        if asked.carries:
            mass, mass_std = self._masses(asked)
            if np.abs(mass).max() > _MAX_KG or (np.abs(mass) < _SURE * mass_std).all():
                return False
            if asked.arm.weighed and mass.max() <= 0.0:  # nothing hangs upwards
                return False
        if asked.places:
            beside = self.x[-3:]
            return bool((np.abs(beside) > _SURE * self.std[-3:]).any() and np.linalg.norm(beside) < _MAX_BESIDE)
        return True

    def _masses(self, asked: LoadHypothesis) -> tuple[Array, Array]:
        each = slice(2 * asked.tilts, None, 4 if asked.arm.weighed else 1)
        return self.x[each], self.std[each]

    def loads(self, asked: LoadHypothesis, samples: Samples) -> Loads:
        """The loads that the fit found, as reported."""
        arm = self.fit.model.arm
        assert arm is not None
        out = Loads(arm, asked.arm, relative=not asked.arm.weighed)
        if asked.tilts:
            assert arm.inertias is not None
            turn = float(np.linalg.norm(self.x[:2]))
            out = replace(out, down=arm.inertias.down, down_std=float(self.std[:2].max()), turned=turn)
        if asked.carries:
            begins = [float(samples.stamps.min()), *asked.until]
            out = replace(out, payloads=tuple(self._payload(asked, g, since) for g, since in enumerate(begins)))
        if asked.places:
            out = replace(out, centre=self.x[-3:], centre_std=self.std[-3:])
        return out

    def _payload(self, asked: LoadHypothesis, g: int, since: float) -> FoundPayload:
        mass, std = self._masses(asked)
        if not asked.arm.weighed:  # the last is the unit
            last = g == len(mass)
            return FoundPayload(since, 1.0, 0.0) if last else FoundPayload(since, 1.0 + float(mass[g]), float(std[g]))
        first = 2 * asked.tilts + 4 * g
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


def _numbers(asked: LoadHypothesis, arm: NominalArm) -> Array:
    """The numbers of a hypothesis that make this arm of the one it begins from."""
    known, x = asked.arm, np.zeros(asked.size)
    if asked.tilts:
        assert arm.inertias is not None
        axis = np.cross(asked.down, arm.inertias.down)
        size = float(np.linalg.norm(axis))
        angle = float(np.arctan2(size, asked.down @ arm.inertias.down))
        x[:2] = asked.across @ axis * (angle / size) if size > 0.0 else [angle, 0.0]
    if asked.places:
        assert arm.centre is not None
        x[-3:] = arm.centre
    if asked.carries and not known.weighed:
        assert arm.earlier is not None
        x[2 * asked.tilts :] = arm.earlier.mass
    elif asked.carries:
        assert arm.inertias is not None
        assert known.inertias is not None
        assert is_serial_arm(known.chain)
        tip, own, old = known.chain.origins[-1], arm.inertias, known.inertias
        m = float(own.mass[-1] - old.mass[-1])
        moment = tip[:3, :3].T @ (own.mass[-1] * own.com[-1] - old.mass[-1] * old.com[-1] - m * tip[:3, 3])
        last = np.r_[m, moment]
        each = np.tile(last, (asked.recordings, 1))
        if arm.earlier is not None:
            each[:-1] += np.column_stack([arm.earlier.mass, arm.earlier.moment])
        x[2 * asked.tilts :] = each.ravel()
    return x


def _count(found: Diagnosis) -> int:
    return sum(len(effect.values) for effect in found.fit.model.effects)


def _by_weight(model: Model) -> bool:
    """Whether any effect goes by a load that is computed from weight."""
    return any(by_weight(effect) for effect in model.effects)


def _thinned(samples: Samples, most: int) -> Samples:
    return samples.select(spread_rows(len(samples), most))


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


def by_weight(effect: Effect) -> bool:
    """Whether an effect goes by a load that is computed from weight."""
    return effect.driver.partition(":")[0] in ("load", "payload", "moment") or effect.driver.startswith("offset_")
