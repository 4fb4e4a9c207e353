"""JᵀWJ and JᵀWr without ever holding all of J.

Samples are taken block by block, so memory stays flat however long the recording is. Most columns of an effect are one
direction at one place times a number for each sample, ``u φ``. Products of such columns need the six components of u
only once: ``(u φ)ᵀ W (v ψ) = φᵀ diag(uᵀWv) ψ``, six times less work where an effect is a curve with a hundred knots.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from modcal_core.calibration.linearise import RowView, geometry_rows, model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Term, all_columns
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

BLOCK = 2000  # samples
_LEAST_THINNED = 100_000  # numbers of a curve; of fewer, products of whole matrices are quicker than of sparse ones
_FULL = (
    0.3  # share of numbers that are not zero, above which they are so too; a cubic curve with 16 knots has a quarter
)


@dataclass(frozen=True)
class RowBlock:
    """Some of the samples. rows: of a linearisation of all, (3 n + 3 m,). at: their drivers, None where not kept."""

    part: Samples
    rows: np.ndarray
    at: Drivers | None = None


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
        _add(start, parameters, values, block.part, at, row_weight[block.rows], H, g)
    return H, g


def _add(
    start: Model,
    parameters: Sequence[ModelParameter],
    values: Array,
    part: Samples,
    at: Drivers,
    weight: Array,
    H: Array,
    g: Array,
) -> None:
    """Add what one block of samples says."""
    P = len(parameters)
    now = model_at(start, parameters, values)
    view = RowView.of(now, part, at)
    residual = np.concatenate([view.position.ravel(), view.rotation.ravel()])
    terms = all_columns(now.effects, at) if len(values) > P else []
    whole = [j for j, t in enumerate(terms) if len(t) != 1]
    J = np.concatenate(
        [geometry_rows(view, start, parameters, values), *(view.moved_by(terms[j])[None] for j in whole)]
    )
    dense = np.r_[np.arange(P), P + np.array(whole, dtype=int)]
    JW = J * weight
    H[np.ix_(dense, dense)] += JW @ J.T
    g[dense] += JW @ residual
    groups = _groups(terms, view, at)
    for a, group in enumerate(groups):
        index = P + group.index
        cross = group.numbers @ view.products(JW, group.unit).T
        H[np.ix_(index, dense)] += cross
        H[np.ix_(dense, index)] += cross.T
        weighted = (group.unit * weight)[None]
        g[index] += group.numbers @ view.products(weighted, residual)[0]
        for other in groups[a:]:
            block = _product(group.numbers, view.products(weighted, other.unit)[0], other.numbers)
            H[np.ix_(index, P + other.index)] += block
            if other is not group:
                H[np.ix_(P + other.index, index)] += block.T


@dataclass(frozen=True)
class _Group:
    """Columns of one direction at one place. unit: (3 N + 3 M,). numbers: (b, N), sparse where a curve of many knots is
    among them. index: among the effects' values.
    """

    unit: Array
    numbers: Array | sparse.csr_array
    index: np.ndarray


def _product(numbers: Array | sparse.csr_array, weight: Array, others: Array | sparse.csr_array) -> Array:
    """``numbers diag(weight) othersᵀ``, (b, c)."""
    if isinstance(numbers, np.ndarray):
        weighted: Array | sparse.csr_array = numbers * weight
    else:
        own = numbers.data * weight[numbers.indices], numbers.indices, numbers.indptr
        weighted = sparse.csr_array(own, shape=numbers.shape)
    if not isinstance(others, np.ndarray):
        product = others @ weighted.T
        return np.asarray(product.T if isinstance(product, np.ndarray) else product.toarray().T)
    return np.asarray(weighted @ others.T)


def _numbers(terms: Sequence[Term], at: Drivers) -> Array | sparse.csr_array:
    """The numbers (b, N) of terms; as a sparse array where functions that are mostly zero are among them."""
    parts: list[Array | sparse.csr_array] = []
    first = 0
    while first < len(terms):
        of = terms[first].of
        count = 1 if of is None else len(of)
        whole = of is not None and [t.of is of for t in terms[first : first + count]] == [True] * count
        if of is not None and whole and of.size >= _LEAST_THINNED:
            parts.append(at.thinned(of, _thinned))
        else:
            count = 1
            parts.append(terms[first].size[None])
        first += count
    if len(parts) == 1:
        return parts[0]
    dense = [part for part in parts if isinstance(part, np.ndarray)]
    if len(dense) == len(parts):
        return np.concatenate(dense)
    return sparse.csr_array(sparse.vstack([sparse.csr_array(part) for part in parts], format="csr"))


def _thinned(numbers: Array) -> Array | sparse.csr_array:
    """Numbers (b, N) as a sparse array where that is less work."""
    return numbers if np.count_nonzero(numbers) > _FULL * numbers.size else sparse.csr_array(numbers)


def _groups(terms: list[list[Term]], view: RowView, at: Drivers) -> list[_Group]:
    members: dict[tuple[int, int], list[int]] = {}
    for j, t in enumerate(terms):
        if len(t) == 1:
            members.setdefault((t[0].place, t[0].direction), []).append(j)
    return [
        _Group(view.unit_column(*key), _numbers([terms[j][0] for j in index], at), np.array(index))
        for key, index in members.items()
    ]
