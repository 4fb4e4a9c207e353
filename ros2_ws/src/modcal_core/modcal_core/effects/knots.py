"""Functions of a curve with many knots: at every sample but a few are zero."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from modcal_core.effects.drivers import Drivers
from modcal_core.geometry.so3 import Array

_MIN = 100_000  # numbers of a curve; of fewer, products of whole matrices are quicker
_MAX_EACH = 8  # functions that are not zero at one sample; of more, blocks are no less work than whole matrices


@dataclass(frozen=True)
class Knots:
    """Functions (b, N) of which few are not zero at a sample. at: numbers of these few, (N, k). value: theirs, (N, k).

    whole, by_sample: all of them as a sparse array, (b, N), and the other way round, (N, b). functions: b.
    """

    at: np.ndarray
    value: Array
    whole: scipy.sparse.csr_array
    by_sample: scipy.sparse.csr_array
    functions: int

    @classmethod
    def of(cls, numbers: Array) -> Knots | None:
        """Sparse form of a shape's functions (b, N); None where too many are nonzero at some sample."""
        b, N = numbers.shape
        flat = np.flatnonzero(numbers != 0.0)
        begins = np.searchsorted(flat, N * np.arange(b + 1))
        whole = scipy.sparse.csr_array((numbers.ravel()[flat], flat % N, begins), shape=(b, N))
        by_sample = whole.T.tocsr()
        count = np.diff(by_sample.indptr)
        most = int(count.max(initial=0))
        if not 0 < most <= _MAX_EACH:
            return None
        sample = np.repeat(np.arange(N), count)
        place = np.arange(len(sample)) - by_sample.indptr[sample]
        at, value = np.zeros((N, most), np.int32), np.zeros((N, most))
        at[sample, place], value[sample, place] = by_sample.indices, by_sample.data
        return cls(at, value, whole, by_sample, b)

    def curves(self, amplitudes: Array) -> Array:
        """Sums of the functions times amplitudes (d, b), (d, N)."""
        return np.asarray((self.by_sample @ amplitudes.T).T)

    def __len__(self) -> int:
        return self.functions


def knots_of(functions: Array, at: Drivers) -> Knots | None:
    """Sparse form of a shape's functions (b, N), cached by these drivers; None where dense matrices are faster."""
    return at.made_of((functions,), Knots.of) if functions.size >= _MIN else None


def knots_if_often(functions: Array, at: Drivers) -> Knots | None:
    """The same, but None where they are not there yet and are not asked for often."""
    return at.made_of_if_often((functions,), Knots.of) if functions.size >= _MIN else None
