"""Curves of many knots: columns of which every sample has but a few that are not zero.

Of two such curves with a weight for each sample, ``Φ diag(w) Ψᵀ`` is a sum over the samples of small blocks, 4 × 4 of
cubic curves. Where these blocks stand, and what they are beside w, stays from step to step of a fit, so it is kept as
one sparse matrix that w is multiplied by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Term
from modcal_core.effects.knots import Knots, knots_of
from modcal_core.geometry.so3 import Array

_MAX_KEPT = 8e6  # numbers of what is kept of two curves; of more it is made each time


@dataclass(frozen=True)
class Curve:
    """All functions of a shape along one direction of a place. at: their numbers among the columns of effects. numbers:
    (b, N). knots: of a curve of many; None where whole matrices are quicker.
    """

    place: int
    direction: int
    at: slice
    numbers: Array
    knots: Knots | None

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def key(self) -> tuple[int, int]:
        """Its place and direction."""
        return self.place, self.direction

    @property
    def functions(self) -> Array | scipy.sparse.csr_array:
        """Its functions as a matrix (b, N), sparse where most are zero."""
        return self.numbers if self.knots is None else self.knots.whole


def curves_of(terms: Sequence[list[Term]], at: Drivers) -> tuple[list[Curve], list[int]]:
    """The curves among columns of effects, and the numbers of all other columns."""
    found, others = whole_shapes(terms)
    return [
        Curve(term.place, term.direction, slice(j, j + len(of)), of, knots_of(of, at)) for j, term, of in found
    ], others


def whole_shapes(terms: Sequence[list[Term]]) -> tuple[list[tuple[int, Term, Array]], list[int]]:
    """Where all functions of a shape stand along one direction: the first's number, it, and all (b, N); and the numbers
    of all other columns.
    """
    found: list[tuple[int, Term, Array]] = []
    others: list[int] = []
    j = 0
    while j < len(terms):
        of = terms[j][0].of if len(terms[j]) == 1 else None
        if of is None or not _is_whole(terms[j : j + len(of)], of):
            others.append(j)
            j += 1
            continue
        found.append((j, terms[j][0], of))
        j += len(of)
    return found, others


def _is_whole(terms: Sequence[list[Term]], of: Array) -> bool:
    """Whether these are the columns of all functions of one direction, which stand one after another: the last says."""
    last = terms[-1]
    same = len(last) == 1 and last[0].of is of and last[0].direction == terms[0][0].direction
    return same and len(terms) == len(of)


def product(one: Curve, other: Curve, weight: Array, at: Drivers) -> Array:
    """``Φ diag(weight) Ψᵀ``, (b, c), of the functions of curves at the samples of these drivers."""
    if one.knots is None:
        return np.asarray((other.functions @ (one.numbers * weight).T).T)
    if other.knots is None:
        return np.asarray(one.functions @ (other.numbers * weight).T)
    if one.knots.value.size * other.knots.value.shape[1] > _MAX_KEPT:
        blocks = _blocks(one.knots, other.knots)
    else:
        blocks = at.made_of((one.knots, other.knots), _blocks)
    return np.asarray(blocks @ weight).reshape(len(one), len(other))


def _blocks(one: Knots, other: Knots) -> scipy.sparse.csc_array:
    """Matrix (b c, N) that maps sample weights to products of functions."""
    value = one.value[:, :, None] * other.value[:, None, :]
    at = one.at[:, :, None] * np.int32(len(other)) + other.at[:, None, :]
    each = value[0].size
    begins = np.arange(0, value.size + 1, each, dtype=np.int32)
    shape = len(one) * len(other), len(value)
    return scipy.sparse.csc_array((value.ravel(), at.ravel(), begins), shape=shape)
