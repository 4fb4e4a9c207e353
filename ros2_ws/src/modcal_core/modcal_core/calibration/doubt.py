"""How well a full model knows itself at a posture, beside what geometry alone leaves: outside what was seen its
parameters may be so uncertain that geometry alone is the safer one, whatever the recording's own ends said.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.linearise import RowView, effect_rows, linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.typical import outside_drivers
from modcal_core.calibration.uncertainty import Uncertainty
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import all_columns, motion
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.recording import POINT
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import is_serial_arm, tool_frames

# Of the squares that geometry alone leaves: what a covariance says of a model is too little by several times where
# the model is not quite right, so that at a fifth in RMS the better of the two is no longer known.
# A judgement, made on parts of one real UR10's series. On 180 parts of other arms and recordings, it is worse than
# geometry alone in three (bench/outside.py).
UNSURE = 0.05
_CHUNK = 500  # samples, for memory


@dataclass(frozen=True)
class Doubt:
    """model: calibrated, in its own frames. known: its uncertainty. alone: squared error [m²] of geometry alone."""

    model: Model
    known: Uncertainty
    alone: float

    def share(self, samples: Samples, drivers: Drivers | None = None) -> Array:
        """How much geometry alone should count for that reason at these samples, in [0, 1], (N,).

        drivers: of the samples and of this model's arm, where they are known already.
        """
        of = np.array([self.model.frames.index(f) if f in self.model.frames else 0 for f in samples.frames])
        N = len(samples)
        if drivers is not None and self._told.places is not None and N <= _CHUNK:
            return self._doubted(self._variance(self._moved(samples, of[samples.frame], drivers)))
        seen = replace(
            samples, frames=self.model.frames, frame=of[samples.frame], sockets=(),
            kind=np.full(N, POINT, dtype=KIND_NAMES), reading=np.zeros((N, 3)),
        )  # fmt: skip
        rows = [slice(k, min(k + _CHUNK, N)) for k in range(0, N, _CHUNK)]
        parts = [self._variance(self._rows(seen if len(rows) == 1 else seen.select(chunk))) for chunk in rows]
        return self._doubted(np.concatenate([np.zeros(0), *parts]))

    def _doubted(self, variance: Array) -> Array:
        """What share of geometry alone a variance of predicted positions (N,) [m²] calls for."""
        u = np.clip(variance / (UNSURE * self.alone), 0.0, 1.0)
        return np.asarray(u * u * (3.0 - 2.0 * u))

    def _variance(self, J: Array) -> Array:
        """Variance (N,) [m²] of predicted positions, from their derivatives J and what postures alone determine.

        The uncertainty of a free curve outside its samples does not count: geometry alone lacks the curve as well.
        """
        of = self._told
        return np.minimum(_spread(J, of.covariance), _spread(J[of.stated], of.covariance_stated))

    def _rows(self, samples: Samples) -> Array:
        """d(position)/d(value), (K, 3 N): those of ``linearise`` at the model's own values."""
        of, N = self._told, len(samples)
        if of.places is None:
            return linearise(of.model, of.parameters, of.values, samples).J[:, : 3 * N]
        return self._moved(samples, samples.frame, of.model.drivers(samples))

    def _moved(self, samples: Samples, frame: np.ndarray, at: Drivers) -> Array:
        """The same of samples whose readings and orientations do not count. frame: each one's in the model, (N,)."""
        # one posture a hundred times a second: all directions at once, of a model that need not be made anew
        of, N = self._told, len(samples)
        assert of.places is not None
        twists, _ = motion(of.model.effects, at)
        f = tool_frames(of.model.chain, of.model.T_tip_tool, samples.q, twists)
        view = RowView(samples, np.empty(0, int), f, np.zeros((3, N)), np.zeros((3, 0)), np.zeros((3, N)))
        axis = view.f.axes[of.places, of.directions % 3].transpose(1, 0, 2)  # (3, parameters, N)
        arm = (view.f.p[-1] - view.f.p[of.places]).transpose(1, 0, 2)
        moved = np.where(of.directions[:, None] < 3, axis, so3.cross(axis, arm)) * of.frames[:, frame]
        J, P = np.empty((len(of.values), 3 * N)), len(of.places)
        J[:P] = moved.transpose(1, 0, 2).reshape(P, 3 * N)
        if len(J) > P:
            effect_rows(view, all_columns(of.model.effects, at), out=J[P:])
        return J

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
        F, led = len(self.model.frames), self.model.frames_led_by
        free = np.concatenate([np.zeros(len(kept), bool), *(np.full(len(e.values), e.shape.is_free) for e in told)])
        stated = np.flatnonzero(~free)
        own = [parameters[k] for k in kept]
        simple = is_serial_arm(self.model.chain) and all(p.place >= 0 and p.direction < 6 for p in own)
        return _Told(
            model=replace(self.model.with_effects(tuple(told)), instruments=()),
            parameters=own,
            places=np.array([p.place for p in own], int) if simple else None,
            directions=np.array([p.direction for p in own], int),
            frames=np.array([[p.place > 0 or f in led(p.frame) for f in range(F)] for p in own]).reshape(-1, F),
            values=np.concatenate([np.zeros(len(kept)), *(e.values for e in told)]),
            covariance=C,
            stated=stated,
            covariance_stated=C[np.ix_(stated, stated)],
        )


@dataclass(frozen=True)
class _Told:
    """A model whose parameters and effects postures alone drive, and their covariance.

    values: of parameters and effects, (K,). places, directions: of the parameters; None: some move the tool otherwise
    than as a twist at a place. frames: whether each matters in each of the model's frames. covariance: (K, K). stated:
    which of them belong to no free curve, and covariance_stated: theirs.
    """

    model: Model
    parameters: list[ModelParameter]
    values: Array
    places: np.ndarray | None
    directions: np.ndarray
    frames: np.ndarray
    covariance: Array
    stated: np.ndarray
    covariance_stated: Array


def _spread(J: Array, C: Array) -> Array:
    """Trace of J C Jᵀ of each sample, (N,), with J (K, 3 N)."""
    return np.asarray(np.einsum("kr,kr->r", J, C @ J).reshape(3, -1).sum(axis=0))
