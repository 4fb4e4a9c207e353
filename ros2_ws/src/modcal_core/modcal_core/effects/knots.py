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

    whole: all of them as a sparse array, (b, N).
    """

    at: np.ndarray
    value: Array
    whole: scipy.sparse.csr_array

    @classmethod
    def of(cls, numbers: Array) -> Knots | None:
        """Those of a shape (b, N), None where many are not zero at some sample."""
        most = int(np.count_nonzero(numbers, axis=0).max(initial=0))
        if not 0 < most <= _MAX_EACH:
            return None
        whole = scipy.sparse.csr_array(numbers)
        by_sample = whole.tocsc()
        count = np.diff(by_sample.indptr)
        column = np.repeat(np.arange(len(count)), count)
        place = np.arange(len(column)) - np.repeat(by_sample.indptr[:-1], count)
        at, value = np.zeros((len(count), most), np.int32), np.zeros((len(count), most))
        at[column, place], value[column, place] = by_sample.indices, by_sample.data
        return cls(at, value, whole)

    def curves(self, amplitudes: Array) -> Array:
        """Sums of the functions times amplitudes (d, b), (d, N)."""
        out = self.value[:, 0] * amplitudes[:, self.at[:, 0]]
        for k in range(1, self.value.shape[1]):
            out += self.value[:, k] * amplitudes[:, self.at[:, k]]
        return out

    def __len__(self) -> int:
        return int(self.whole.shape[0])


def knots_of(functions: Array, at: Drivers) -> Knots | None:
    """Those of a shape's functions (b, N) at these drivers, computed once; None where whole matrices are quicker."""
    return at.made_of((functions,), Knots.of) if functions.size >= _MIN else None
