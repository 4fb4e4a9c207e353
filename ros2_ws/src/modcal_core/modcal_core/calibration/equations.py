"""JᵀWJ and JᵀWr without ever holding all of J.

Samples are taken block by block, so memory stays flat however long the recording is. Columns of a curve are one
direction at one place times a number for each sample, ``u φ``. Products of such columns need the six components of u
only once: ``(u φ)ᵀ W (v ψ) = φᵀ diag(uᵀWv) ψ``, and of a curve with many knots few numbers at a sample are not zero
(:class:`~modcal_core.calibration.linearisation.Curve`). All other columns, some dozens, are one dense matrix.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from modcal_core.calibration.kernels.serial import SerialSystem, is_serial
from modcal_core.calibration.linearisation import (
    Curve,
    Linearised,
    RowView,
    curves_of,
    deviations,
    geometry_rows,
    model_at,
    product,
)
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects import Drivers, all_columns
from modcal_core.geometry import Array, local_twists
from modcal_core.measurements import Samples

BLOCK = 4000  # samples
_FEW = 8  # functions of a curve; fewer are columns like others, of which one product does with all
MAX_KEPT = 20_000  # samples whose blocks are kept from step to step, with the drivers of each; some 5 kB each


@dataclass(frozen=True)
class RowBlock:
    """Some of the samples. rows: of a linearisation of all, (3 n + 3 m,). at: their drivers, None where not kept. view:
    readings and frames at the values that are asked for, None where they are not at hand.
    """

    part: Samples
    rows: np.ndarray | slice
    at: Drivers | None = None
    view: RowView | None = None


def blocks(samples: Samples) -> Iterator[RowBlock]:
    """All samples, block by block."""
    N, pose = len(samples), samples.is_pose
    M = int(pose.sum())
    turned = np.cumsum(pose) - 1
    for first in range(0, N, BLOCK):
        rows = np.arange(first, min(first + BLOCK, N))
        part = samples if len(rows) == N else samples.select(rows)
        angles = 3 * N + turned[rows[pose[rows]]]
        yield RowBlock(part, np.concatenate([rows, N + rows, 2 * N + rows, angles, M + angles, 2 * M + angles]))


def blocks_at(samples: Samples, around: Drivers) -> Iterable[RowBlock]:
    """All samples, block by block, with their drivers where that takes little memory; made once.

    around: the drivers at all of them.
    """
    if len(samples) > MAX_KEPT:
        return blocks(samples)
    if len(samples) <= BLOCK:
        return [RowBlock(samples, slice(None), around)]

    def made() -> list[RowBlock]:
        return [replace(block, at=Drivers(block.part, around.arm)) for block in blocks(samples)]

    found: list[RowBlock] = around.kept.made_as(("blocks", BLOCK), made)
    return found


def normal_equations(
    start: Model,
    parameters: Sequence[ModelParameter],
    values: Array,
    samples: Samples,
    row_weight: Array,
    parts: Iterable[RowBlock] | None = None,
) -> tuple[Array, Array]:
    """(JᵀWJ, JᵀWr) of the parameters, then of the effects' values where there are any, at these values.

    row_weight: of the rows of a linearisation, (3 N + 3 M,). parts: the samples in blocks, where they are at hand.
    """
    H, g = np.zeros((len(values), len(values))), np.zeros(len(values))
    for block in blocks(samples) if parts is None else parts:
        at = block.at or start.drivers(block.part)
        view = block.view or RowView.of(model_at(start, parameters, values), block.part, at)
        _add(start, parameters, values, view, at, row_weight[block.rows], H, g)
    return H, g


def _add(
    start: Model,
    parameters: Sequence[ModelParameter],
    values: Array,
    view: RowView,
    at: Drivers,
    weight: Array,
    H: Array,
    g: Array,
) -> None:
    """Add what one block of samples says."""
    P = len(parameters)
    half = np.sqrt(weight)
    residual = view.residual * half
    terms = all_columns(view.effects, at) if len(values) > P else []
    curves, others = curves_of(terms, at)
    few = [curve for curve in curves if len(curve) < _FEW]
    dense = np.r_[np.arange(P), *(np.arange(P + c.at.start, P + c.at.stop) for c in few), P + np.array(others, int)]
    J = np.empty((len(dense), len(weight)))
    geometry_rows(view, start, parameters, values, out=J[:P])
    first = P
    for curve in few:
        view.times(view.unit_column(curve.place, curve.direction), curve.numbers, J[first : first + len(curve)])
        first += len(curve)
    for row, j in zip(J[first:], others, strict=True):
        view.moved_by(terms[j], out=row)
    J *= half
    H[np.ix_(dense, dense)] += J @ J.T
    g[dense] += J @ residual
    many = [(c, slice(P + c.at.start, P + c.at.stop)) for c in curves if len(c) >= _FEW]
    _add_curves(many, dense, J, residual, view, half, at, H, g)


def _add_curves(
    curves: Sequence[tuple[Curve, slice]],
    dense: np.ndarray,
    J: Array,
    residual: Array,
    view: RowView,
    half: Array,
    at: Drivers,
    H: Array,
    g: Array,
) -> None:
    """Add what curves have with each other, with all other columns J and with the residual.

    curves: each, and its columns among all. dense: the columns of J among all. half: square roots of the weights, which
    J and the residual contain already.
    """
    units = {key: view.unit_column(*key) * half for key in dict.fromkeys(curve.key for curve, _ in curves)}
    if not units:
        return
    seen = dict(zip(units, view.all_products(J, np.stack(list(units.values()))), strict=True))
    missed = {key: view.products(residual[None], unit)[0] for key, unit in units.items()}
    both: dict[object, Array] = {}
    for i, (one, columns) in enumerate(curves):
        cross = one.functions @ seen[one.key]
        H[columns, dense] += cross
        H[dense, columns] += cross.T
        g[columns] += one.functions @ missed[one.key]
        for other, more in curves[i:]:
            keys = one.key, other.key
            if keys not in both:
                both[keys] = view.products(units[one.key][None], units[other.key])[0]
            block = product(one, other, both[keys], at)
            H[columns, more] += block
            if more is not columns:
                H[more, columns] += block.T


def gradient(
    start: Model, parameters: Sequence[ModelParameter], values: Array, view: RowView, at: Drivers, row_weight: Array
) -> Array:
    """JᵀWr alone, of the parameters, then of the effects' values where there are any, at these values.

    view: readings and frames there. at: drivers of its samples. row_weight: as in :func:`normal_equations`. No product
    of two columns is needed: the weighted residual is contracted with each direction of a place once.
    """
    P = len(parameters)
    weighted = view.residual * row_weight
    g = np.zeros(len(values))
    g[:P] = _geometry_gradient(view, start, parameters, values, weighted)
    if len(values) == P:
        return g
    seen: dict[tuple[int, int], Array] = {}

    def along(place: int, direction: int) -> Array:
        key = place, direction
        if key not in seen:
            seen[key] = view.products(weighted[None], view.unit_column(place, direction))[0]
        return seen[key]

    terms = all_columns(view.effects, at)
    curves, others = curves_of(terms, at)
    for j in others:
        g[P + j] = sum(float(term.size @ along(term.place, term.direction)) for term in terms[j])
    for curve in curves:
        g[P:][curve.at] = curve.functions @ along(*curve.key)
    return g


def _geometry_gradient(
    view: RowView, model: Model, parameters: Sequence[ModelParameter], values: Array, weighted: Array
) -> Array:
    """``Jᵀ w``, (P,), of the geometry's parameters at these values. weighted: w, (3 N + 3 M,).

    Of a serial arm in plain sight the force and torque that w is at a place is all that its parameters ask for.
    """
    if model.instruments or view.f.loops:
        return np.asarray(geometry_rows(view, model, parameters, values) @ weighted)
    errors = deviations(model, parameters, values[: len(parameters)])
    of_frames, of_places = local_twists(errors.frames), local_twists(errors.places)
    wrenches: dict[tuple[int, int], Array] = {}
    out = np.empty(len(parameters))
    for j, parameter in enumerate(parameters):
        key = parameter.place, parameter.frame
        if key not in wrenches:
            several = parameter.place == 0 and len(model.frames) > 1
            wrenches[key] = view.wrench(key[0], weighted, model.frames_led_by(parameter.frame) if several else ())
        twist = (of_places[parameter.place - 1] if parameter.place else of_frames[parameter.frame])[parameter.direction]
        out[j] = twist @ wrenches[key]
    return out


# --- What a fit asks of its equations, and the plain way to answer: residuals, gradient, normal equations


class System(Protocol):
    """Equations of the same samples at different values of the same parameters, (P,).

    quick_gradient: whether the gradient alone is had for much less than the normal equations.
    """

    quick_gradient: bool

    def residuals(self, values: Array) -> Linearised:
        """Residuals, without derivatives."""

    def normal_equations(self, values: Array, row_weight: Array) -> tuple[Array, Array]:
        """(JᵀWJ, JᵀWr) with these weights of the rows, (3 N + 3 M,)."""

    def gradient(self, values: Array, row_weight: Array) -> Array:
        """JᵀWr alone, (P,)."""

    def last_curvature(self, row_weight: Array) -> Array:
        """JᵀWJ of the last normal equations, scaled as the weights have been since, on the whole."""


class PlainSystem:
    """The equations of any model."""

    def __init__(self, start: Model, parameters: Sequence[ModelParameter], samples: Samples, around: Drivers) -> None:
        """around: the drivers at the samples."""
        self._start, self._parameters, self._samples, self._around = start, parameters, samples, around
        self._last_view: tuple[Array, RowView] | None = None
        self.quick_gradient = len(samples) <= MAX_KEPT

    def residuals(self, values: Array) -> Linearised:
        """Residuals, without derivatives."""
        view = self._view(values)
        return Linearised(view.position, view.rotation, np.zeros((0, view.position.size + view.rotation.size)))

    def _view(self, values: Array) -> RowView:
        """Readings and frames at these values; those asked for last are kept where the gradient asks for them again."""
        if self._last_view is not None and np.array_equal(self._last_view[0], values):
            return self._last_view[1]
        view = RowView.of(model_at(self._start, self._parameters, values), self._samples, self._around)
        if self.quick_gradient:
            self._last_view = np.array(values), view
        return view

    def normal_equations(self, values: Array, row_weight: Array) -> tuple[Array, Array]:
        """(JᵀWJ, JᵀWr) with these weights of the rows, (3 N + 3 M,)."""
        parts = blocks_at(self._samples, self._around)
        if isinstance(parts, list) and len(parts) == 1:
            parts = [replace(parts[0], view=self._view(values))]
        H, g = normal_equations(self._start, self._parameters, values, self._samples, row_weight, parts)
        self._last = H / float(row_weight.sum())
        return H, g

    def gradient(self, values: Array, row_weight: Array) -> Array:
        """JᵀWr alone, (P,)."""
        if not self.quick_gradient:
            return self.normal_equations(values, row_weight)[1]
        return gradient(self._start, self._parameters, values, self._view(values), self._around, row_weight)

    def last_curvature(self, row_weight: Array) -> Array:
        """JᵀWJ of the last normal equations, scaled as the weights have been since, on the whole."""
        return np.asarray(self._last * float(row_weight.sum()))


def system_of(start: Model, parameters: Sequence[ModelParameter], samples: Samples, around: Drivers) -> System:
    """The equations of these samples, by the quickest way that knows this model."""
    if is_serial(start, samples, parameters):
        return SerialSystem(start, parameters, samples)
    return PlainSystem(start, parameters, samples, around)


# --- Least squares without negative values, of columns that are given by their products

_MAX_STEPS = 100  # of a column; usual are one or two


def nonnegative(A: Array, v: Array) -> Array:
    """The x ≥ 0, (..., n), with the least ``xᵀ A x − 2 vᵀ x``. A: products of the columns (..., n, n), positive
    definite. v: their products with what they are fitted to, (..., n).
    """
    from scipy.optimize import nnls  # slow to import, and of most recordings not asked for

    lower = np.linalg.cholesky(A)
    target = np.linalg.solve(lower, v[..., None])[..., 0]
    x = np.zeros(v.shape)
    for at in np.ndindex(v.shape[:-1]):
        x[at] = nnls(lower[at].T, target[at], maxiter=_MAX_STEPS * v.shape[-1])[0]
    return x
