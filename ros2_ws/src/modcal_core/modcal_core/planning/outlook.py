"""What a station would be worth: how much it lowers the error of the tool that is to be expected, in mm².

The values are those of the claim (:mod:`modcal_core.claim`): geometry, effects of the fit, and for each joint what
effects nobody named may look like, as large as in usual arms. With H the information of the stations so far and of the
priors, and Γ the mean of GᵀG where accuracy counts, the mean square error is tr(H⁻¹ Γ). Before anything is measured the
arm is the nominal one, and the noise that of the site.

A model is fitted to the stations so far by the flow of ``modcal calibrate``, with nothing held out: the stations of the
proof score it. With too few to choose effects the geometry alone is fitted, held by its priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import (
    EQUATIONS_PER_PARAMETER,
    Calibration,
    Cell,
    Model,
    NoiseModel,
    Readmitted,
    RowView,
    View,
    choose_parameters,
    finalise,
    fit_cell,
    fit_geometry,
    free_cell,
    linearise,
    outlying,
    readmitted,
    right_after_all,
    sharpened,
    views_of,
)
from modcal_core.claim import Neighbourhood, arms_near, usual_std
from modcal_core.diagnosis import Sought, causes_of_moves, diagnose, with_residual_curves
from modcal_core.effects import Effect, of_readings
from modcal_core.geometry import Array
from modcal_core.hypotheses import proved
from modcal_core.measurements import POSE, Samples
from modcal_core.measurements.kinds import dimensions
from modcal_core.moves import find_regimes
from modcal_core.planning.pool import Pool, readings_at
from modcal_core.planning.site import Noise
from modcal_core.robots import Inertias, Mechanism, weightless
from modcal_core.verdict import sane_inertias

_EXPLAIN = 3, 8  # of ten stations these judge effects, the others fit: as for a calibration, without its test
_MIN_FREEDOM = 10  # rows beyond what is fitted, from which effects are looked for: a wrong one costs stations only


@dataclass(frozen=True)
class Refit:
    """calibration: fitted to all stations. samples: those it was fitted to, in one convention. wrong: True for those
    left out of it, (N,). taken_in: what was rejected first and is fitted after all.
    """

    calibration: Calibration
    samples: Samples
    wrong: np.ndarray
    taken_in: Readmitted

    @property
    def spread(self) -> float:
        """RMS over space [m] of what the model leaves of readings: what the arm does not repeat, the instrument's error
        and what the model lacks.
        """
        known = np.nan_to_num(self.samples.sigma_position)
        return float(np.sqrt(3.0 * (self.calibration.noise.position**2 + np.mean(known**2))))


def refit(
    samples: Samples,
    chain: Mechanism,
    seed: int,
    cell: Cell | None = None,
    inertias: Inertias | None = None,
    effects: bool = True,
) -> Refit:
    """The model of this arm from these samples. seed: of what takes part in choosing effects, by station, so that a
    station keeps its part when others are added. Raises NotEnoughData for too few.
    """
    cell = (cell or Cell()).met(samples)
    samples, _ = proved(samples, chain)
    inertias, _ = sane_inertias(inertias, chain)
    if cell.gravity is not None:
        inertias = (inertias or weightless(chain.n)).pulled(cell.gravity)
    nominal = fit_cell(chain, samples, cell, inertias)
    choice = choose_parameters(nominal.model, views_of(samples), cell.kept, cell.distances)
    choice = replace(choice, parameters=free_cell(choice.parameters, cell))
    trained = ~np.isin((samples.station + seed) % 10, _EXPLAIN)
    equations = float(dimensions(samples.select(trained)).sum())
    searched = effects and equations >= EQUATIONS_PER_PARAMETER * len(choice.parameters) and not trained.all()
    regimes = None
    rivals: tuple[tuple[Effect, ...], ...] = ()
    again = np.zeros(len(samples), bool)
    if not searched:
        final = geometric = fit_geometry(nominal.model, samples, choice.parameters, cell)
    else:
        regimes = find_regimes(samples, chain, cell, inertias, cell.moved)
        if regimes:
            nominal = fit_cell(chain, samples, cell, inertias, regimes)
        train, explain = samples.select(trained), samples.select(~trained)
        geometric = fit_geometry(nominal.model, train, choice.parameters, cell)
        known = causes_of_moves(geometric, samples)
        sought = Sought(train, explain, tuple(cell.distances), known=known, least_freedom=_MIN_FREEDOM)
        found = diagnose(geometric, sought)
        held = with_residual_curves(found.fit, train, explain, cell.distances)
        final = replace(held, model=sharpened(held.model, samples))
        rivals = tuple(cause.rivals for cause in found.causes)
        if found.again is not None:
            again[trained] = found.again
    choice = replace(choice, parameters=geometric.parameters)
    wrong = outlying(final.model, final.noise, samples)
    if wrong.sum() > 0.1 * len(samples):  # that is no longer a few wrong readings: the model is wrong, and keeps all
        wrong = np.zeros(len(samples), bool)
    if final.model.effects:
        right = right_after_all(final, samples, choice.parameters, cell.distances, wrong)[0]
        wrong, again = wrong & ~right, again | right
    shipped = finalise(samples, chain, choice, cell, inertias, final, wrong, regimes, geometric)
    if searched:
        shipped = replace(shipped, rivals=rivals)
    return Refit(shipped, samples, wrong, readmitted(shipped.calibrated, samples, again & ~wrong, wrong))


def proven_over(refitted: Refit, where: Array) -> Refit:
    """The same once its error was proven at postures drawn at random, of which these (M, n) stand for all: it is known
    wherever they are drawn from, not only about the few stations of the fit.
    """
    known = refitted.calibration
    low, high = np.minimum(known.seen[0], where.min(axis=0)), np.maximum(known.seen[1], where.max(axis=0))
    return replace(refitted, calibration=replace(known, seen=np.array([low, high])))


# --- What a station would be worth


def information(J: Array) -> Array:
    """JᵀJ of stations with rows J (N, c, K), in units of the prior, (K, K)."""
    flat = J.reshape(-1, J.shape[2])
    return np.asarray(flat.T @ flat)


@dataclass(frozen=True)
class Outlook:
    """about: the arms that this one may be, K values. own: numbers of those that a fit has (P,). noise: of readings,
    joints left out. scatter: of each number read (6,) [m, rad], of what the arm does not repeat. H: information (K, K)
    of the stations so far and the priors, in units of these. gamma: Γ in these units [m²]. kind: of reading. like: what
    the last of the samples so far came with.
    """

    about: Neighbourhood
    own: np.ndarray
    noise: Noise
    scatter: Array
    H: Array
    gamma: Array
    kind: str
    like: Samples | None = None

    @property
    def parameters(self) -> list[str]:
        """Names of the geometry's parameters that a fit has."""
        return [self.about.parameters[j].name for j in self.own if j < len(self.about.parameters)]

    def rows(self, q: Array, approach: Array | None = None) -> Array:
        """Derivatives (N, c, K) of readings at postures q (N, n), over their deviations, per prior's deviation."""
        samples = self._samples(q, approach, self.kind)
        J = self._derivatives(samples)
        distance = np.linalg.norm(samples.reading, axis=1)
        read = np.full((len(q), J.shape[1]), self.noise.rotation)
        read[:, :3] = (self.noise.position + self.noise.per_metre * distance)[:, None]
        return J / np.hypot(read, self.scatter[: J.shape[1]])[..., None]

    def motions(self, q: Array, approach: Array | None = None) -> Array:
        """How the tool moves per prior's deviation, (N, 3, K) [m]. What scales a reading moves no tool."""
        J = self._derivatives(self._samples(q, approach, POSE))[:, :3]
        k = len(self.about.parameters)
        for effect in self.about.model.effects:
            if of_readings(effect.place):
                J[..., k : k + len(effect.values)] = 0.0
            k += len(effect.values)
        return J

    def error(self, own: bool = False) -> float:
        """RMS error of the tool [m] that is to be expected; own: of the values that a fit has alone."""
        k = np.ix_(*2 * [self.own if own else np.arange(len(self.gamma))])
        return float(np.sqrt(max(np.sum(np.linalg.inv(self.H[k]) * self.gamma[k]), 0.0)))

    def beside(self, rows: Array) -> Outlook:
        """The same once stations with these rows (N, c, K) have been read."""
        return replace(self, H=self.H + information(rows))

    def reaching(self, share: float, rows: Array, step: int) -> int | None:
        """How many of the stations with these rows (N, c, K), by so many at a time, bring the expected error to a share
        of what it is now; None if all do not.
        """
        view, enough = self, share * self.error()
        for k in range(step, len(rows) + 1, step):
            view = view.beside(rows[k - step : k])
            if view.error() <= enough:
                return k
        return None

    def _samples(self, q: Array, approach: Array | None, kind: str) -> Samples:
        """Readings as the geometry makes them; time and signals as they were at the end of the samples so far."""
        N, like = len(q), self.like
        exact = readings_at(self.about.model, q, kind)
        exact = exact if approach is None else replace(exact, approach=approach)
        if like is None:
            return exact
        stamps = np.full(N, float(like.stamps.max()))
        return replace(exact, effort=np.full(q.shape, np.nan), stamps=stamps, signals=like.signals, clock=like.clock)

    def _derivatives(self, samples: Samples) -> Array:
        about = self.about
        J = linearise(about.model, about.parameters, about.values, samples).J
        return J.reshape(len(J), -1, len(samples)).transpose(2, 1, 0) * about.std


def nominal_outlook(pool: Pool, kind: str, fixed: Sequence[str] = ()) -> Outlook:
    """The outlook before anything is measured. fixed: parameters that are as the drawing has them, by name, place or
    pattern. Functions for what nobody named are no wider than the claim expects them: most arms do not have it.
    """
    model, noise, q = pool.at.model, pool.at.site.noise, pool.q[pool.offered]
    fitted = choose_parameters(model, (View(kind, 0),), fixed).parameters
    joints = unrepeated(model, q, noise)
    scatter = np.sqrt(np.repeat([np.mean(joints[:, :3] ** 2), np.mean(joints[:, 3:] ** 2)], 3) * joints.shape[2])
    planned = readings_at(model, q, kind)
    size = NoiseModel(noise.position + float(scatter[0]), noise.rotation + float(scatter[3]))
    about = arms_near(model, model.chain, planned, Cell(fixed=tuple(fixed)), noise=size)
    about = replace(about, std=usual_std(about))
    names = [p.name for p in about.parameters]
    own = np.array([names.index(p.name) for p in fitted])
    eye = np.eye(len(about.std))
    return _counting(Outlook(about, own, noise, scatter, eye, eye, kind), pool.where, None)


def outlook(refitted: Refit, where: Array, cell: Cell, rng: np.random.Generator) -> Outlook:
    """What further stations would be worth to a fitted model. where: postures (M, n) at which accuracy counts."""
    calibration, right = refitted.calibration, refitted.samples.select(~refitted.wrong)
    about = arms_near(calibration.calibrated, calibration.nominal.chain, right, cell)
    about = replace(about, std=usual_std(about))
    assert calibration.uncertainty is not None
    fitted = {p.name for p in calibration.uncertainty.parameters}
    P = len(about.parameters)
    effects = sum(len(e.values) for e in calibration.calibrated.effects)
    own = np.r_[[j for j, p in enumerate(about.parameters) if p.name in fitted], P + np.arange(effects)].astype(int)
    read = float(np.sqrt(np.mean(np.nan_to_num(right.sigma_position) ** 2)))
    scatter = np.repeat([calibration.noise.position, calibration.noise.rotation], 3)
    H, _ = about.equations(np.ones(len(about.H)))
    H = H * np.outer(about.std, about.std) + np.eye(len(about.std))
    known = Outlook(about, own, Noise(read, 0.0, 0.0), scatter, H, H, str(right.kind[0]), right)
    return _counting(known, where, rng.choice([-1.0, 1.0], where.shape))


def _counting(bare: Outlook, where: Array, approach: Array | None) -> Outlook:
    G = bare.motions(where, approach)
    return replace(bare, gamma=information(G) / len(G))


def unrepeated(model: Model, q: Array, noise: Noise) -> Array:
    """How what the joints do not repeat moves the tool at postures q (N, n), by each joint, (N, 6, n) [m, rad]."""
    samples = readings_at(model, q, POSE)
    view = RowView.of(model, samples, model.drivers(samples))
    chain = model.chain
    sizes = np.where(chain.revolute, noise.joint_turn, noise.joint_slide)
    moved = [view.unit_column(chain.first_place + k, 5 if chain.revolute[k] else 2) for k in range(chain.n)]
    return np.stack(moved, axis=1).reshape(6, len(q), chain.n).transpose(1, 0, 2) * sizes
