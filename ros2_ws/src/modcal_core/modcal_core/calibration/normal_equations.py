"""JᵀWJ and JᵀWr without ever holding all of J.

Samples are taken block by block, so memory stays flat however long the recording is. Most columns of an effect are one
direction at one place times a number for each sample, ``u φ``. Products of such columns need the six components of u
only once: ``(u φ)ᵀ W (v ψ) = φᵀ diag(uᵀWv) ψ``, six times less work where an effect is a curve with a hundred knots.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from copy import copy
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

BLOCK = 4000  # samples
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
    groups = _groups(terms, view, at, P)
    for a, group in enumerate(groups):
        seen = view.products(JW, group.unit).T
        weighted = (group.unit * weight)[None]
        missed = view.products(weighted, residual)[0]
        for piece in group.parts:
            cross = piece.numbers @ seen
            _put(H, piece.index, dense, cross)
            _put(H, dense, piece.index, cross.T)
            g[piece.index] += piece.numbers @ missed
        for other in groups[a:]:
            both = view.products(weighted, other.unit)[0]
            for i, piece in enumerate(group.parts):
                for one in other.parts[i if other is group else 0 :]:
                    block = _product(piece.numbers, both, one.numbers)
                    _put(H, piece.index, one.index, block)
                    if one is not piece:
                        _put(H, one.index, piece.index, block.T)


def _put(H: Array, rows: Index, columns: Index, block: Array) -> None:
    """Add a block to some rows and columns of H."""
    if isinstance(rows, slice) or isinstance(columns, slice):
        H[rows, columns] += block
    else:
        H[np.ix_(rows, columns)] += block


def gradient(
    start: Model, parameters: Sequence[ModelParameter], values: Array, view: RowView, at: Drivers, row_weight: Array
) -> Array:
    """JᵀWr alone, of the parameters, then of the effects' values where there are any, at these values.

    view: readings and frames there. at: drivers of its samples. row_weight: as in :func:`normal_equations`. No product
    of two columns is needed: the weighted residual is contracted with each direction of a place once.
    """
    P = len(parameters)
    weighted = np.concatenate([view.position.ravel(), view.rotation.ravel()]) * row_weight
    g = np.zeros(len(values))
    g[:P] = geometry_rows(view, start, parameters, values) @ weighted
    if len(values) == P:
        return g
    seen: dict[tuple[int, int], Array] = {}

    def along(place: int, direction: int) -> Array:
        key = place, direction
        if key not in seen:
            seen[key] = view.products(weighted[None], view.unit_column(place, direction))[0]
        return seen[key]

    terms = all_columns(model_at(start, parameters, values).effects, at)
    for j, several in enumerate(terms):
        if len(several) != 1:
            g[P + j] = sum(float(term.size @ along(term.place, term.direction)) for term in several)
    for (place, direction), index in _members(terms).items():
        for part in _parts(terms, index, at, P):
            g[part.index] = part.numbers @ along(place, direction)
    return g


Index = slice | np.ndarray


@dataclass(frozen=True)
class _Part:
    """Columns of one direction at one place. numbers: (b, N), sparse of a curve of many knots. index: among all
    values; of such a curve they stand beside each other.
    """

    numbers: Array | sparse.csr_array
    index: Index


@dataclass(frozen=True)
class _Group:
    """All columns of one direction at one place. unit: (3 N + 3 M,)."""

    unit: Array
    parts: tuple[_Part, ...]


def _product(numbers: Array | sparse.csr_array, weight: Array, others: Array | sparse.csr_array) -> Array:
    """``numbers diag(weight) othersᵀ``, (b, c)."""
    if isinstance(numbers, np.ndarray):
        if isinstance(others, np.ndarray):
            return np.asarray((numbers * weight) @ others.T)
        return np.asarray((others @ (numbers * weight).T).T)
    if isinstance(others, np.ndarray):
        return np.asarray(numbers @ (others * weight).T)
    weighted = copy(numbers)  # with the same places: making another looks through them all
    weighted.data = numbers.data * weight[numbers.indices]
    return np.asarray((weighted @ others.T).toarray())


def _parts(terms: Sequence[list[Term]], index: Sequence[int], at: Drivers, P: int) -> tuple[_Part, ...]:
    """Columns with these numbers among the terms, each of one: every curve of many knots, then all others together."""
    parts: list[_Part] = []
    others: list[int] = []
    first = 0
    while first < len(index):
        j = index[first]
        of = terms[j][0].of
        count = 1 if of is None else len(of)
        if of is not None and of.size >= _LEAST_THINNED and _is_whole(terms, index[first : first + count], of):
            parts.append(_Part(at.thinned(of, _thinned), slice(P + j, P + j + count)))
        else:
            count = 1
            others.append(j)
        first += count
    if others:
        parts.append(_Part(np.stack([terms[j][0].size for j in others]), P + np.array(others)))
    return tuple(parts)


def _is_whole(terms: Sequence[list[Term]], index: Sequence[int], of: Array) -> bool:
    """Whether these are the columns of all functions, one after the other."""
    beside = len(index) == len(of) and index[-1] - index[0] == len(of) - 1
    return beside and all(terms[i][0].of is of for i in index)


def _thinned(numbers: Array) -> Array | sparse.csr_array:
    """Numbers (b, N) as a sparse array where that is less work."""
    return numbers if np.count_nonzero(numbers) > _FULL * numbers.size else sparse.csr_array(numbers)


def _groups(terms: list[list[Term]], view: RowView, at: Drivers, P: int) -> list[_Group]:
    return [_Group(view.unit_column(*key), _parts(terms, index, at, P)) for key, index in _members(terms).items()]


def _members(terms: list[list[Term]]) -> dict[tuple[int, int], list[int]]:
    """The columns of one term, by place and direction."""
    members: dict[tuple[int, int], list[int]] = {}
    for j, t in enumerate(terms):
        if len(t) == 1:
            members.setdefault((t[0].place, t[0].direction), []).append(j)
    return members
