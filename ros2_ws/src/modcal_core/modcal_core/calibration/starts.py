"""The geometry's least cost over base, tool, sockets and arm together, not only the one nearest to a first guess.

Base and tool of the nominal arm are a guess: where the tool hardly turns, a millimetre of the arm's error moves it by
half a metre. Their priors are therefore so wide that they hold nothing that the readings show, and where the first fit
moved them, or knows them no better than an arm is known from its drawing, fits are begun at other tools too: at the
tip itself and around it. With known distances each is fitted without them first, for a distance is far from linear in
where its ends are. All are compared by what they leave of the same samples; the best is then fitted to all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from modcal_core.calibration.cell import Cell, with_bases
from modcal_core.calibration.distances import distance_cost
from modcal_core.calibration.fit import CONVERGED, FITTED, Fit, identify, identify_moved
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import NoiseModel, errors, squared_residuals
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.stated import as_stated
from modcal_core.effects import is_move
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import forward, is_serial_arm

_AROUND = (0.1, 0.4)  # of the arm's reach; tools are between nothing and half as long as the arm
_NEARBY = 0.03  # the same about a ball that was located in sockets, which is linear in where it is
_AGREED = 3  # starts that end alike, from which no further one is tried
_ALIKE = 1.0  # of the cost; less is no difference that the readings can show
_NEAR = 0.5  # of what is usual; the prior then costs no value more than a quarter of a squared deviation
_EACH = 6  # samples for each parameter, from which a start is judged
_FEWEST = 400  # samples, of which the same is said
_CAP = 100.0  # squared deviations; no sample may rule alone
_UNIT = NoiseModel(1.0, 1.0)  # m, rad; squares in it are squares of the residuals

Parameters = Sequence[ModelParameter]


def fit_geometry(
    start: Model, samples: Samples, parameters: Parameters, cell: Cell, tolerance: float = CONVERGED
) -> Fit:
    """The fit of the whole geometry; its start is the model that the best of several fits was begun from.

    start: base and tool as the nominal arm has them. parameters: as of :func:`free_cell`; those of the fit have the
    usual priors where the readings bear out where the nominal arm has base and tool, and where these are known to have
    moved, for a model is then begun about where they are.
    """
    start = as_stated(start, cell.tool, cell.known)
    if any(is_move(effect) for effect in start.effects):
        return identify_moved(start, samples, _usual(parameters), cell.distances, tolerance)
    fitted = partial(identify, samples=samples, distances=cell.distances, tolerance=tolerance)
    first = fitted(start, parameters=parameters)
    # whether where the tool is has to be found at all, and is not stated
    free = any(p.name.startswith("tool/") and not p.turns and p.prior_std > p.expected for p in parameters)
    if is_serial_arm(start.chain) and free and _far(first):
        best = _best(start, samples, parameters, cell, first)
        if best is not None:
            return fitted(best.start, parameters=parameters, begin=best.values)
    return fitted(start, parameters=_usual(parameters)) if _borne_out(first) else first


def _best(start: Model, samples: Samples, parameters: Parameters, cell: Cell, first: Fit) -> Fit | None:
    """The best of fits that begin with the tool elsewhere, to some of the samples; None where the first is as good."""
    some = _some(samples, len(parameters))
    found = [_fitted(start, some, parameters, cell, first.values)]
    for other in _others(start, some, cell):
        found.append(_fitted(other, some, parameters, cell, None))
        cost = _costs(found, some, cell)
        if np.sum(cost < cost.min() + _ALIKE) >= _AGREED:
            break
    cost = _costs(found, some, cell)
    return None if cost[0] <= cost.min() + _ALIKE else found[int(np.argmin(cost))]


def _usual(parameters: Parameters) -> list[ModelParameter]:
    """The parameters with the prior that arms have from their drawing, where nothing better is stated."""
    return [replace(p, prior_std=min(p.prior_std, p.expected)) for p in parameters]


def _borne_out(fit: Fit) -> bool:
    """Whether the readings put base and tool where the nominal arm had them, and know them so well."""
    rows = [k for k, p in enumerate(fit.parameters) if p.name.startswith(("frame ", "tool/"))]
    usual = np.array([fit.parameters[k].expected for k in rows])
    return bool(np.all(np.abs(fit.values[rows]) < _NEAR * usual) and np.all(fit.std[rows] < _NEAR * usual))


def _far(fit: Fit) -> bool:
    """Whether any value is farther from where the fit began, or known less well, than arms are from their drawing."""
    usual = np.array([p.expected for p in fit.parameters])
    return not fit.converged or bool(np.any(np.abs(fit.values) > usual) or np.any(fit.std > usual))


def _some(samples: Samples, parameters: int) -> Samples:
    """So many of the samples as a start needs, of every frame the same share."""
    most = max(_FEWEST, _EACH * parameters)
    if len(samples) <= most:
        return samples
    share = most / len(samples)
    rows = [np.flatnonzero(samples.frame == f) for f in range(len(samples.frames))]
    few = [r[spread_rows(len(r), max(3, round(share * len(r))))] for r in rows if len(r)]
    return samples.select(np.sort(np.concatenate([np.unique(r) for r in few])))


def _others(start: Model, samples: Samples, cell: Cell) -> Iterator[Model]:
    """Models with the tool elsewhere, and base and instruments where the nominal arm then has them."""
    reach = float(np.linalg.norm(forward(start.chain, samples.q)[:, :3, 3], axis=1).mean())
    ways = np.concatenate([np.eye(3), -np.eye(3)])
    if all(samples.is_same_point(f) for f in range(len(samples.frames))):
        points = start.T_tip_tool[:3, 3] + _NEARBY * reach * ways
    else:
        points = np.concatenate([np.zeros((1, 3)), *(share * reach * ways for share in _AROUND)])
    for point in points:
        tool = se3.transform(start.T_tip_tool[:3, :3], point)
        yield with_bases(replace(start, T_tip_tool=tool), samples, cell)


def _fitted(start: Model, samples: Samples, parameters: Parameters, cell: Cell, begin: Array | None) -> Fit:
    """A fit that begins here; where distances are known, without them first."""
    fitted = partial(identify, start, samples, parameters, tolerance=FITTED)
    if cell.distances:
        with suppress(NotEnoughData):  # nothing but the distances tells some of the parameters
            begin = fitted(begin=begin).values
    return fitted(cell.distances, begin=begin)


def _costs(fits: Sequence[Fit], samples: Samples, cell: Cell) -> Array:
    """What each fit leaves of the samples, of its priors and of known distances, in squared deviations.

    All by the spread of the one with the least, so that none is better for having rejected more.
    """
    least = min(fits, key=lambda fit: float(np.median(squared_residuals(errors(fit.model, samples), samples, _UNIT))))
    out = []
    for fit in fits:
        square = squared_residuals(errors(fit.model, samples), samples, least.noise)
        prior = np.array([p.prior_std for p in fit.parameters])
        cost = float(np.minimum(square, _CAP).sum() + np.sum((fit.values / prior) ** 2))
        if cell.distances:
            cost += distance_cost(fit.start, fit.parameters, fit.values, cell.distances)
        out.append(cost)
    return np.array(out)
