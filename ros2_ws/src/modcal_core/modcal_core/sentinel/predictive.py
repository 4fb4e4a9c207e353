"""What a new recording says of a change while nothing has changed, as the reference recordings tell it.

Each of m reference recordings, predicted by the others, says something of every change, and none is there. So far the
next may lie from nothing: in standard deviations of these numbers it has a Student distribution of m − 1 degrees of
freedom, over all directions of a change together where it has several. Whatever the numbers of a recording have in
common, the warmth of the day or its task, is in their scatter. Of few recordings far numbers are no proof: with twelve
a change needs twice the size that it would need with a known scatter, with fifty a tenth more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from modcal_core.geometry import Array
from modcal_core.sentinel.normal import FEWEST_BAGS, Moments, Normal, differing

_UNSEEN = 1e-9  # of what the reference shows of a direction


@dataclass(frozen=True)
class Spoken:
    """What some recordings say of all changes together: information (K, K) and its vector (K,), of named columns."""

    names: tuple[str, ...]
    information: Array
    vector: Array

    def beside(self, sums: Array) -> Spoken:
        """What is said beside a change of whatever size, a sum (K, k) of the columns."""
        along = self.information @ sums
        gain = along @ np.linalg.pinv(sums.T @ along, hermitian=True)
        return Spoken(self.names, self.information - gain @ along.T, self.vector - gain @ (sums.T @ self.vector))


def spoken_since(normal: Normal, bags: Sequence[Mapping[str, Moments]]) -> list[Spoken]:
    """What later recordings from each of them on say of all changes, the reference period's coefficients being known
    as well as they are.
    """
    names = tuple(sorted({name for of in normal.signals.values() for name in of.names}))
    at = {name: k for k, name in enumerate(names)}
    A, b = np.zeros((len(bags), len(names), len(names))), np.zeros((len(bags), len(names)))
    for signal, of in normal.signals.items():
        p, k = len(of.beta), np.array([at[name] for name in of.names])
        size = p + len(k) + 1
        S, before, D = np.zeros((size, size)), np.arange(p), np.arange(p, size - 1)
        for i in reversed(range(len(bags))):
            if signal in bags[i] and bags[i][signal].share > 0.0:
                S = S + differing(bags[i][signal], of)
            left = S[:, -1] - S[:, :p] @ of.beta
            known = np.column_stack([S[np.ix_(before, D)], left[:p]])
            gain = np.linalg.solve(of.precision + S[:p, :p], known)
            A[i][np.ix_(k, k)] += S[np.ix_(D, D)] - S[D, :p] @ gain[:, :-1]
            b[i][k] += left[D] - S[D, :p] @ gain[:, -1]
    return [Spoken(names, *pair) for pair in zip(A, b, strict=True)]


def left_out(normal: Normal) -> list[Spoken]:
    """What each reference recording says of all changes, by the others."""
    return [spoken_since(normal.without(i), [own])[0] for i, own in enumerate(normal.moments)]


@dataclass(frozen=True)
class Number:
    """What recordings say of one change, in standard deviations of what they say while there is none. square: of their
    length. directions: that are seen. positive: whether it is larger than zero, where it is one. freedom: degrees.
    """

    square: float
    directions: int
    positive: bool
    freedom: int

    def evidence(self, square: float | None = None) -> float:
        """How much more probable a change of the best size makes it [nats]. square: if it were of this length."""
        of = self.square if square is None else square
        return 0.5 * (self.freedom + self.directions) * float(np.log1p(of / self.freedom))

    def log_factor(self, sizes: Array, grows: bool) -> Array:
        """Bayes factors of changes whose sizes have these standard deviations, over all directions together, (S,).

        grows: whether it is not below zero.
        """
        k, n = max(self.directions, 1), self.freedom
        spread = sizes**2 / k
        left = self.square / (1.0 + spread)
        out = 0.5 * (n + self.directions) * (np.log1p(self.square / n) - np.log1p(left / n))
        out -= 0.5 * self.directions * np.log1p(spread)
        if grows and self.directions == 1:  # half of the prior, and what is left of it behind zero
            z = np.sqrt(spread * left * (n + 1.0) / (n + left)) * (1.0 if self.positive else -1.0)
            out += np.log(2.0 * stdtr(n + 1.0, z))
        return np.asarray(out)


@dataclass(frozen=True)
class Scatter:
    """How far from nothing reference recordings are in what they say of a change. sums (K, k): its columns, in units in
    which the information of one recording is about 1. root (k, k): from the model's standard deviations to those of the
    recordings. freedom: degrees; 0 where too few of them show it.
    """

    sums: Array
    root: Array
    freedom: int

    @classmethod
    def of(cls, sums: Array, reference: Sequence[Spoken]) -> Scatter:
        """Of a change with these columns (K, k). The model's own scatter is the least."""
        k, told = sums.shape[1], [_standard(sums, one) for one in reference]
        z = np.array([x for x, _, rank in told if rank])
        if len(z) < FEWEST_BAGS:
            return cls(sums, np.eye(k), 0)
        alike = k * np.mean(z**2) * np.eye(k)  # as many directions as recordings would leave some without a scatter
        squares, vectors = np.linalg.eigh((z.T @ z + alike) / (len(z) + k))
        return cls(sums, (vectors * np.maximum(squares, 1.0) ** -0.5) @ vectors.T, len(z) - 1)

    def number(self, said: Spoken) -> Number:
        """What recordings say of it; of what too few of the reference show there are no directions."""
        z, _, rank = _standard(self.sums, said)
        u = self.root @ z
        return Number(float(u @ u), rank if self.freedom else 0, bool(u[0] > 0.0), max(self.freedom, 1))

    def sizes(self, said: Spoken) -> tuple[Array, Array]:
        """Sizes (k,), and by how much they scatter from one reference recording to the next; not what is not seen."""
        z, inverse, _ = _standard(self.sums, said)
        return inverse @ z, np.linalg.norm(inverse @ np.linalg.inv(self.root), axis=1)


def _standard(sums: Array, said: Spoken) -> tuple[Array, Array, int]:
    """Sizes (k,) in standard deviations of the model, from these to sizes (k, k), and how many directions are seen."""
    squares, vectors = np.linalg.eigh(sums.T @ said.information @ sums)
    kept = squares > _UNSEEN * len(squares)
    inverse = (vectors * np.where(kept, np.maximum(squares, 1e-300) ** -0.5, 0.0)) @ vectors.T
    return inverse @ (sums.T @ said.vector), inverse, int(kept.sum())
