"""JᵀWJ and JᵀWr without ever holding all of J.

Samples are taken block by block, so memory stays flat however long the recording is. Columns of a curve are one
direction at one place times a number for each sample, ``u φ``. Products of such columns need the six components of u
only once: ``(u φ)ᵀ W (v ψ) = φᵀ diag(uᵀWv) ψ``, and of a curve with many knots few numbers at a sample are not zero
(:class:`~modcal_core.calibration.linearisation.Curve`). All other columns, some dozens, are one dense matrix.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.linearisation import (
    Curve,
    Linearised,
    RowView,
    curves_of,
    geometry_rows,
    model_at,
    product,
)
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects import Drivers, all_columns
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

BLOCK = 20_000  # samples taken at once, some 5 kB each; where one block is all, its view is kept for the next step
_FEW = 8  # functions of a curve; fewer are columns like others, of which one product does with all


@dataclass(frozen=True)
class RowBlock:
    """Some of the samples. rows: of a linearisation of all, (3 n + 3 m,). at: their drivers. view: readings and frames
    at the values that are asked for, None where they are not at hand.
    """

    part: Samples
    rows: np.ndarray | slice
    at: Drivers
    view: RowView | None = None


def blocks_at(samples: Samples, around: Drivers) -> Iterator[RowBlock]:
    """All samples, block by block. around: the drivers at all of them."""
    N, pose = len(samples), samples.is_pose
    if N <= BLOCK:
        yield RowBlock(samples, slice(None), around)
        return
    M = int(pose.sum())
    turned = np.cumsum(pose) - 1
    for first in range(0, N, BLOCK):
        rows = np.arange(first, min(first + BLOCK, N))
        part, angles = samples.select(rows), 3 * N + turned[rows[pose[rows]]]
        every = np.concatenate([rows, N + rows, 2 * N + rows, angles, M + angles, 2 * M + angles])
        yield RowBlock(part, every, Drivers(part, around.arm))


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
    for block in parts or blocks_at(samples, start.drivers(samples)):
        view = block.view or RowView.of(model_at(start, parameters, values), block.part, block.at)
        _add(start, parameters, values, view, block.at, row_weight[block.rows], H, g)
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


class System:
    """Equations of the same samples at different values of the same parameters and effects, (K,)."""

    def __init__(self, start: Model, parameters: Sequence[ModelParameter], samples: Samples, around: Drivers) -> None:
        """around: the drivers at the samples."""
        self._start, self._parameters, self._samples, self._around = start, parameters, samples, around
        self._last: tuple[Array, RowView] | None = None

    def residuals(self, values: Array) -> Linearised:
        """Residuals, without derivatives."""
        view = self._view(values)
        return Linearised(view.position, view.rotation, np.zeros((0, view.position.size + view.rotation.size)))

    def normal_equations(self, values: Array, row_weight: Array) -> tuple[Array, Array]:
        """(JᵀWJ, JᵀWr) with these weights of the rows, (3 N + 3 M,)."""
        parts: Iterable[RowBlock] = blocks_at(self._samples, self._around)
        if len(self._samples) <= BLOCK:
            parts = [RowBlock(self._samples, slice(None), self._around, self._view(values))]
        return normal_equations(self._start, self._parameters, values, self._samples, row_weight, parts)

    def _view(self, values: Array) -> RowView:
        """Readings and frames at these values; those asked for last are kept, where one block is all."""
        if self._last is not None and np.array_equal(self._last[0], values):
            return self._last[1]
        view = RowView.of(model_at(self._start, self._parameters, values), self._samples, self._around)
        if len(self._samples) <= BLOCK:
            self._last = np.array(values), view
        return view


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
