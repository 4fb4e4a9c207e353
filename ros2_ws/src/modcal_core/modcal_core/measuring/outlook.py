"""What a station would be worth now: how much it lowers the error of the tool that the fit still leaves, in mm².

As in :mod:`modcal_core.planning.worth`, but about the model that has been fitted, with its effects and its noise, and
with *suspects* beside them: effects that the fit does not have but an arm may (a spring, a wobble, backlash in each
joint), and the rivals of those that it has. Suspects are as large as the goal; what the stations so far say of them is
in the information matrix like everything else. So a station is worth something where the geometry is known badly, where
two explanations part, and where an effect that would matter has not been looked at. The fit's own error comes from the
model's parameters alone.

Where the instrument lost the tool the same posture is not asked for again: what has been seen and what has not, near
where a tool would be and face, gives the chance that it is seen (a kernel estimate), by which a station's worth counts.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Model, RowView, Uncertainty, exact_samples, geometry_rows
from modcal_core.effects import Drivers, Effect, all_columns, candidates, columns, prior_stds
from modcal_core.geometry import Array
from modcal_core.measurements import POINT, Samples
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.measuring.refit import Refit

# Suspects: smooth ones of each joint; a gear's thousand harmonics have no better postures than random ones
_TURNING = {("axis_wobble", "turn"), ("gear_harmonic", "turn")}
_PLAIN = {("compliance", "linear"), ("backlash", "sign"), ("gear_ratio", "linear"), *_TURNING}
_CYCLES = 2.0  # a turn, at most, of a suspected wobble or harmonic
_EFFORT = re.compile("(^|,)effort(:|,|$)")  # of a driver: what no posture asks for
_ROUNDS = 40  # in which stations are chosen, at most; up to as many they are chosen one by one
_WIDEST = 10.0  # m, rad; a prior beyond it holds nothing
_NEAR, _FACING = 0.3, 0.7  # m, rad: places and directions that a tracker sees alike
_SEEN_FIRST = 0.95  # chance that a posture is seen where nothing near was tried; weighs as much as one station


@dataclass(frozen=True)
class Outlook:
    """model, known: the fitted model and its parameters. suspects: effects it does not have, of unit size. noise:
    standard deviations (position [m], rotation [rad]) of readings. scale: of all values, the priors' deviations (K,).
    fitted: how many of the K values the fit has. H: information (K, K) of the stations so far and the priors. gamma:
    mean of GᵀG where accuracy counts, (K, K) [m²].
    """

    model: Model
    known: Uncertainty
    suspects: tuple[Effect, ...]
    noise: tuple[float, float]
    scale: Array
    fitted: int
    H: Array
    gamma: Array
    kind: str
    like: Samples

    def rows(self, q: Array, approach: Array) -> Array:
        """Derivatives (N, c, K) of readings at postures q (N, n), over their deviations, per prior's deviation."""
        samples = at_postures(self.model, q, approach, self.kind, self.like)
        J = _rows(self.model, self.known, self.suspects, samples)
        N = len(q)
        J = J.reshape(len(J), -1, N).transpose(2, 1, 0) * self.scale
        J[:, :3] /= self.noise[0]
        if J.shape[1] > 3:
            J[:, 3:] /= self.noise[1]
        return J

    def error(self, H: Array | None = None) -> float:
        """RMS error of the tool [m] that the fit's own values leave, by this information (default: that so far)."""
        k = self.fitted
        known = (self.H if H is None else H)[:k, :k]
        return float(np.sqrt(max(np.sum(np.linalg.inv(known) * self.gamma[:k, :k]), 0.0)))

    def best(self, J: Array, weight: Array, count: int, H: Array | None = None) -> tuple[list[int], list[Array]]:
        """Numbers of the ``count`` stations, of those with rows J (N, c, K), that lower the error most together, and
        the information (K, K) after each. weight: chance of each to be measured, (N,); 0 leaves it out.
        """
        H = self.H if H is None else H
        chosen: list[int] = []
        after: list[Array] = []
        free = np.array(weight, dtype=float)
        count = min(count, int(np.sum(free > 0.0)))
        while len(chosen) < count:
            P = np.linalg.inv(H)
            JP = (J.reshape(-1, J.shape[2]) @ P).reshape(J.shape)
            S = JP @ J.transpose(0, 2, 1) + np.eye(J.shape[1])
            seen = (JP.reshape(-1, J.shape[2]) @ self.gamma).reshape(J.shape) @ JP.transpose(0, 2, 1)
            gained = free * np.trace(np.linalg.solve(S, seen), axis1=1, axis2=2)
            # of many stations several are taken at once, for time
            for j in np.argsort(-gained, kind="stable")[: min(max(1, count // _ROUNDS), count - len(chosen))].tolist():
                free[j] = 0.0
                H = H + J[j].T @ J[j]
                chosen.append(j)
                after.append(H)
        return chosen, after


def outlook(refitted: Refit, where: Array, size: float, rng: np.random.Generator) -> Outlook:
    """What further stations would be worth. where: postures (M, n) at which accuracy counts. size: RMS [m] at the tool
    that a suspect may have.
    """
    calibration, samples = refitted.calibration, refitted.samples
    known = calibration.uncertainty
    assert known is not None
    model = calibration.calibrated
    here = at_postures(model, where, rng.choice([-1.0, 1.0], where.shape), POINT, samples)
    own = {effect.key for effect in model.effects}
    plain = [e for e in candidates(model.drivers(here)) if (e.family, e.shape.kind) in _PLAIN]
    suspects = [e for e in plain if e.shape.settings.get("cycles", 0.0) <= _CYCLES]
    suspects += [e for group in calibration.rivals for e in group if not _EFFORT.search(e.driver)]
    suspects = [e for e in suspects if e.key not in own]
    G = _rows(model, known, suspects, here)
    M = len(where)
    around = model.drivers(samples)
    prior = [np.array([p.prior_std for p in known.parameters]), *(prior_stds(e, around) for e in model.effects)]
    fitted = sum(map(len, prior))
    # a suspect's unit moves the tool by so much; its prior is that it moves it as far as the size
    moves = np.sqrt(np.sum(G[fitted:] ** 2, axis=1) / M)
    scale = np.minimum(np.concatenate([*prior, np.where(moves > 1e-9, size / np.maximum(moves, 1e-9), 0.0)]), _WIDEST)
    noise = calibration.noise
    each = np.sqrt(noise.position**2 + np.mean(np.nan_to_num(samples.sigma_position) ** 2)), noise.rotation
    kind = str(samples.kind[0])
    G = G.reshape(len(G), -1, M).transpose(2, 1, 0) * scale
    flat = G.reshape(-1, G.shape[2])
    bare = Outlook(
        model, known, tuple(suspects), (float(max(each[0], 1e-7)), float(max(each[1], 1e-7))), scale, fitted,
        np.eye(len(scale)), flat.T @ flat / M, kind, samples,
    )  # fmt: skip
    right = samples.select(~refitted.wrong)
    J = bare.rows(right.q, right.approach).reshape(-1, len(scale))
    return replace(bare, H=np.eye(len(scale)) + J.T @ J)


def at_postures(model: Model, q: Array, approach: Array, kind: str, like: Samples) -> Samples:
    """Readings as the geometry makes them at postures q (N, n), come to in these ways; time and signals as they were at
    the end of the samples so far.
    """
    N = len(q)
    exact = exact_samples(model, q, np.zeros(N, dtype=int), np.full(N, kind, dtype=KIND_NAMES))
    return replace(
        exact,
        approach=approach,
        effort=np.full(q.shape, np.nan),
        stamps=np.full(N, float(like.stamps.max())),
        signals=like.signals,
        clock=like.clock,
    )


def chance_seen(p: Array, facing: Array, tried_p: Array, tried_facing: Array, seen: np.ndarray) -> Array:
    """Chance (N,) that an instrument sees a tool at p (N, 3) [m] with its z axis along facing (N, 3), from where it did
    and did not see one: tried_p, tried_facing (M, 3), seen (M,).
    """
    if not len(seen) or seen.all():
        return np.ones(len(p))
    apart = np.sum((p[:, None] - tried_p) ** 2, axis=2) / _NEAR**2
    turned = np.sum((facing[:, None] - tried_facing) ** 2, axis=2) / _FACING**2
    weight = np.exp(-0.5 * (apart + turned))
    return np.asarray((weight @ seen + _SEEN_FIRST) / (weight.sum(axis=1) + 1.0))


def _rows(model: Model, known: Uncertainty, suspects: Sequence[Effect], samples: Samples) -> Array:
    """Derivatives (K, 3 N or 6 N) of the tool's motion: parameters, values of effects, amplitudes of suspects."""
    at = Drivers(samples, model.drivers(samples).arm)
    view = RowView.of(model.with_effects(()), samples, at)
    P = len(known.parameters)
    parts = [geometry_rows(view, model, known.parameters, np.zeros(P))]
    parts += [view.moved_by(terms)[None] for terms in all_columns(model.effects, at)]
    parts += [view.moved_by(terms)[None] for effect in suspects for terms in columns(effect, at)]
    return np.concatenate(parts)
