"""The model from the stations measured so far: the flow of ``modcal calibrate``, with nothing held out.

What scores it are the stations of the proof, which it never sees; so all others fit and choose effects. With too few of
them to choose effects the geometry alone is fitted, held by its priors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import (
    EQUATIONS_PER_PARAMETER,
    Calibration,
    Cell,
    Readmitted,
    choose_parameters,
    finalise,
    fit_cell,
    fit_geometry,
    free_cell,
    outlying,
    readmitted,
    right_after_all,
    sharpened,
    views_of,
)
from modcal_core.diagnosis import Sought, causes_of_moves, diagnose, with_residual_curves
from modcal_core.effects import Effect
from modcal_core.geometry import Array
from modcal_core.hypotheses import proved
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import dimensions
from modcal_core.moves import find_regimes
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
    wherever they are drawn from. Else geometry alone would count beyond the few stations of the fit, unproven.
    """
    known = refitted.calibration
    low, high = np.minimum(known.seen[0], where.min(axis=0)), np.maximum(known.seen[1], where.max(axis=0))
    return replace(refitted, calibration=replace(known, seen=np.array([low, high])))
