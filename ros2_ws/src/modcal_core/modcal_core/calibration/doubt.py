"""How well a full model knows itself at a posture, beside what geometry alone leaves: outside what was seen its
parameters may be so uncertain that geometry alone is the safer one, whatever the recording's own ends said.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.typical import outside_drivers
from modcal_core.calibration.uncertainty import Uncertainty
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.recording import POINT
from modcal_core.measurements.samples import Samples

# Of the squares that geometry alone leaves: what a covariance says of a model is too little by several times where
# the model is not quite right, so that at a fifth in RMS the better of the two is no longer known.
# A judgement, made on parts of one real UR10's series. On 180 parts of other arms and recordings, it is worse than
# geometry alone in three (bench/fits/outside.md).
UNSURE = 0.05
_CHUNK = 500  # samples, for memory


@dataclass(frozen=True)
class Doubt:
    """model: calibrated, in its own frames. known: its uncertainty. alone: squared error [m²] of geometry alone."""

    model: Model
    known: Uncertainty
    alone: float

    def share(self, samples: Samples) -> Array:
        """How much geometry alone should count for that reason at these samples, in [0, 1], (N,)."""
        of = np.array([self.model.frames.index(f) if f in self.model.frames else 0 for f in samples.frames])
        N = len(samples)
        seen = replace(
            samples, frames=self.model.frames, frame=of[samples.frame], sockets=(),
            kind=np.full(N, POINT, dtype=KIND_NAMES), reading=np.zeros((N, 3)),
        )  # fmt: skip
        parts = [self._variance(seen.select(np.arange(k, min(k + _CHUNK, N)))) for k in range(0, N, _CHUNK)]
        doubted = np.concatenate([np.zeros(0), *parts]) / (UNSURE * self.alone)
        u = np.clip(doubted, 0.0, 1.0)
        return np.asarray(u * u * (3.0 - 2.0 * u))

    def _variance(self, samples: Samples) -> Array:
        """Of predicted positions, (N,) [m²]: of all that postures alone tell.

        What a free curve itself is not known there counts nothing, for geometry alone lacks it as well.
        """
        of = self._told
        J = linearise(of.model, of.parameters, of.values, samples).J[:, : 3 * len(samples)]
        return np.minimum(_spread(J, of.covariance), _spread(J[of.stated], of.covariance_stated))

    @functools.cached_property
    def _told(self) -> _Told:
        """The part of model and uncertainty that postures alone tell: the same for every posture."""
        parameters, effects = self.known.parameters, self.model.effects
        kept = [k for k, p in enumerate(parameters) if p.instrument < 0]
        rows = list(kept)
        first, told = len(parameters), []
        for effect in effects:
            if not outside_drivers(effect):
                told.append(effect)
                rows += range(first, first + len(effect.values))
            first += len(effect.values)
        C = self.known.covariance[np.ix_(rows, rows)]
        free = np.concatenate([np.zeros(len(kept), bool), *(np.full(len(e.values), e.shape.is_free) for e in told)])
        stated = np.flatnonzero(~free)
        return _Told(
            model=replace(self.model.with_effects(tuple(told)), instruments=()),
            parameters=[parameters[k] for k in kept],
            values=np.concatenate([np.zeros(len(kept)), *(e.values for e in told)]),
            covariance=C,
            stated=stated,
            covariance_stated=C[np.ix_(stated, stated)],
        )


@dataclass(frozen=True)
class _Told:
    """A model whose parameters and effects postures alone drive, and their covariance.

    values: of parameters and effects, (K,). covariance: (K, K). stated: which of them belong to no free curve, and
    covariance_stated: theirs.
    """

    model: Model
    parameters: list[ModelParameter]
    values: Array
    covariance: Array
    stated: np.ndarray
    covariance_stated: Array


def _spread(J: Array, C: Array) -> Array:
    """Trace of J C Jᵀ of each sample, (N,), with J (K, 3 N)."""
    return np.asarray(np.einsum("kr,kr->r", J, C @ J).reshape(3, -1).sum(axis=0))
