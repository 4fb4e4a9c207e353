"""The rows of a fit beside those of another: what effects that came or went add to its projector or take from it.

A search weighs thousands of candidates against one fit after the other, each with an effect more or one less. What the
fitted columns leave of the candidates costs most of it, and is linear in the projector: so it is kept of one fit, the
anchor, and of others only what differs is computed. With ``K = L Lᵀ`` the products of the scaled columns J, priors
added, and ``Q = L⁻¹ J``, columns R that go take the directions ``F`` with them that span ``L⁻¹ I_R``; columns that come
bring what Q and F leave of them (block inverse; Golub & Van Loan, ch. 3). Each that comes brings what those before it
leave, so from fit to fit only the last are made again; whose settings are fitted, and so never the same, come last.

The columns are those at the anchor. They hold as long as geometry has not moved and noise has not changed by more than
what the shares that are weighed depend on; else there is a new anchor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve_triangular

from modcal_core.calibration import Fit, NoiseModel, linearise
from modcal_core.diagnosis.space import ROUNDING, DirectionFactor, Directions, Space, by_component, by_sample, drawn_in
from modcal_core.effects import Drivers, Effect, all_columns, is_turned
from modcal_core.geometry import Array

# How far a fit may lie from the anchor. Of the real UR5 and a made arm of 27 effects shares then differ by less than
# 1 % of themselves and scores by less than 0.1, where a hundredfold in chance is 2 (whole runs: bench/speed).
_MOVED = 5e-3  # m, rad; columns change by as much of themselves
# Of the ratio of two noises, by which rows are weighed against each other: candidates, residual and trials of a scan
# alike, so each weight is as fair as any other; with 5 % from the best one 0.2 % of what rows say is lost
_UNEVEN = 0.05
_QUIETER = 0.1  # of any noise, by which priors are weighed against readings
_MAX_NEW = 0.5  # of the columns, that may come and go; more are not worth it


@dataclass(frozen=True)
class _Step:
    """Columns of the anchor that go, or effects that come, and the directions that go or come with them."""

    gone: tuple[int, ...]
    effects: tuple[Effect, ...]
    directions: Directions


@dataclass(frozen=True)
class Anchor:
    """A fit, its rows, and what they were made by. steps: from it to the last fit beside it, each with the columns that
    go or the effects that come.
    """

    fit: Fit
    space: Space
    factor: DirectionFactor
    steps: list[_Step] = field(default_factory=list)

    @classmethod
    def of(cls, fit: Fit, drivers: Drivers) -> Anchor:
        """Anchor of a fit at the samples of these drivers."""
        return cls(fit, *Space.with_factor(fit, drivers))

    def beside(self, fit: Fit, drivers: Drivers) -> Space | None:
        """The rows of another fit at the same samples; None where it is too far away."""
        mine, others = self.fit.model.effects, list(fit.model.effects)
        if not self._is_near(fit) or any(is_turned(effect) for effect in (*mine, *others)):
            return None
        gone: list[int] = []
        at = len(self.fit.parameters)
        for effect in mine:
            same = next((i for i, other in enumerate(others) if _is_same(effect, other)), None)
            if same is None:
                gone += range(at, at + len(effect.values))
            else:
                del others[same]
            at += len(effect.values)
        count = len(gone) + sum(len(e.values) for e in others)
        ahead = fit.values is self.fit.values  # of a look ahead, which is asked once
        if count > _MAX_NEW * self.factor.columns and not ahead:
            return None
        space = self.space
        rows = space.rows
        values = np.concatenate([np.zeros(len(fit.parameters)), *(e.values for e in fit.model.effects)])
        now = linearise(fit.model, fit.parameters, values, drivers.samples, jacobian=False, drivers=drivers)
        residual = drawn_in(by_sample(now.residual, space.view) * space.weight)
        changes = self._changes(tuple(gone), others, drivers)
        if changes is None:
            return None
        free = space.freedom - round(sum(part.sign * float(np.sum(part.Q**2)) for part in changes))
        whole = space.parts[0]
        residual[:rows] -= np.sum([part.along(residual[:rows])[0] for part in (whole, *changes)], axis=0)
        return replace(space, residual=residual, freedom=free, whole=whole, changes=changes, weighed={}, alone={})

    def _changes(self, gone: tuple[int, ...], come: list[Effect], drivers: Drivers) -> tuple[Directions, ...] | None:
        """Directions of the columns that go and of the effects that come; None where these bring none of their own."""
        if not self.steps or self.steps[0].gone != gone:
            self.steps[:] = [_Step(gone, (), self._of_gone(gone))]
        kept = 1
        for step in self.steps[kept:]:
            left = _without(come, step.effects)
            if left is None:
                break
            come, kept = left, kept + 1
        del self.steps[kept:]
        for fitted in (False, True):
            if some := tuple(effect for effect in come if bool(effect.refined) == fitted):
                new = self._new(some, drivers, [step.directions for step in self.steps])
                if new is None:
                    return None
                self.steps.append(_Step((), some, Directions(new)))
        return tuple(step.directions for step in self.steps if step.directions.Q.size)

    def _of_gone(self, gone: tuple[int, ...]) -> Directions:
        """The directions that go with these columns."""
        return Directions(self.space.Q[: self.space.rows] @ self.factor.along(gone), -1.0)

    def _is_near(self, fit: Fit) -> bool:
        """Whether the columns of geometry, and how rows are weighed, are nearly the anchor's."""
        if fit.start.chain is not self.fit.start.chain or fit.parameters != self.fit.parameters:
            return False
        if fit.values is not self.fit.values and np.abs(fit.values - self.fit.values).max(initial=0.0) > _MOVED:
            return False
        if fit.noise is self.fit.noise:
            return True
        if fit.noise.others.keys() != self.fit.noise.others.keys():
            return False
        change = np.log(self._sizes(fit.noise) / self._sizes(self.fit.noise))
        return bool(np.ptp(change) < _UNEVEN and np.abs(change).max() < _QUIETER)

    def _sizes(self, noise: NoiseModel) -> Array:
        """Noise of each kind of row."""
        rotation = [noise.rotation] if self.space.rows > 3 else []
        return np.array([noise.position, *rotation, *(noise.others[kind] for kind in sorted(noise.others))])

    def _new(self, effects: Sequence[Effect], drivers: Drivers, before: Sequence[Directions]) -> Array | None:
        """Orthonormal directions (rows, N, a) that these effects bring beside those before; None for none at all."""
        space = self.space
        rows, Q = space.rows, space.Q[: space.rows]
        view = space.view
        J = by_component(np.stack([view.moved_by(terms) for terms in all_columns(effects, drivers)]), view)
        J *= space.weight[:rows]
        a = len(J)
        unit = J.reshape(a, -1)
        unit /= np.maximum(np.sqrt(np.einsum("ij,ij->i", unit, unit)), 1e-300)[:, None]
        left = unit.copy()
        for part in (Directions(Q), *before):
            flat = part.Q.reshape(unit.shape[1], -1)
            left -= part.sign * ((unit @ flat) @ flat.T)
        try:
            L = np.linalg.cholesky(unit @ left.T + ROUNDING * np.eye(a))
        except np.linalg.LinAlgError:
            return None
        out = solve_triangular(L, left, lower=True, check_finite=False)
        return np.ascontiguousarray(out.T).reshape(rows, -1, a)


def _without(effects: list[Effect], some: Sequence[Effect]) -> list[Effect] | None:
    """Effects without ``some``; None where not all of these are among them."""
    left = list(effects)
    for one in some:
        same = next((i for i, other in enumerate(left) if _is_same(one, other)), None)
        if same is None:
            return None
        del left[same]
    return left


def _is_same(effect: Effect, other: Effect) -> bool:
    """Whether two effects have the same columns."""
    if effect is other:
        return True
    if effect.key != other.key or effect.shape.kind != other.shape.kind:
        return False
    if effect.refined and not np.array_equal(effect.values, other.values):
        return False
    return effect.shape.settings == other.shape.settings
