"""A frozen model beside the readings of a check: residuals, derivatives, and what the readings scatter by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import Model, ModelParameter, NoiseModel, RowView
from modcal_core.checking.hypotheses import NOISE, CellChange, curve_root, hypothesis_columns
from modcal_core.checking.noise import FrozenKnowledge, NullModel, null, parameter_rows
from modcal_core.geometry import Array
from modcal_core.measurements import Samples


class CheckState:
    """A model beside the samples, what its readings scatter by, and its derivatives.

    curves: by joint, angles (S,) at the stations about which a large curve is linearised; it is none of the model's,
    so the residual is what it would be if readings moved in proportion to it.
    """

    def __init__(
        self,
        model: Model,
        samples: Samples,
        known: FrozenKnowledge,
        of: NullModel | None = None,
        curves: Mapping[int, Array] | None = None,
    ) -> None:
        self.model, self.samples, self.known = model, samples, known
        self.curves = dict(curves or {})
        self._station = np.unique(samples.station, return_inverse=True)[1]
        q = samples.q.copy()
        for joint, angles in self.curves.items():
            q[:, joint] += angles[self._station]
        bent = replace(samples, q=q) if self.curves else samples
        self.drivers = model.drivers(bent)
        self.view = RowView.of(model, bent, self.drivers)
        self._of = of

    @cached_property
    def null(self) -> NullModel:
        """What its readings scatter by while nothing else has changed."""
        return null(self.model, self.samples, self.view, self.drivers, self.known) if self._of is None else self._of

    def parameter_rows(self, parameters: tuple[ModelParameter, ...]) -> Array:
        """Derivatives of the predictions by these parameters of the geometry, (P, n)."""
        return parameter_rows(self.model, self.view, self.drivers, parameters, ())

    @property
    def residual(self) -> Array:
        """Residuals of the readings, (n,), in the rows of the linearisation."""
        out = np.concatenate([self.view.position.ravel(), self.view.rotation.ravel()])
        for joint, angles in self.curves.items():
            out = out + self.turned(joint) @ angles
        return out

    def turned(self, joint: int) -> Array:
        """What readings move by per unit of a joint's angle or travel at each station, (n, S)."""
        chain, view = self.model.chain, self.view
        unit = view.unit_column(chain.first_place + joint, 5 if chain.revolute[joint] else 2)
        sample = np.concatenate([np.tile(np.arange(len(self.samples)), 3), np.tile(view.pose, 3)]).astype(int)
        out = np.zeros((len(unit), int(self._station.max()) + 1))
        out[np.arange(len(unit)), self._station[sample]] = unit
        return out

    def columns(self, hypothesis: CellChange) -> Array:
        """Columns of a change at this model; none for noise, which has no size."""
        if hypothesis.kind == NOISE:
            return np.zeros((len(self.residual), 0))
        if hypothesis.curve >= 0:
            return self.turned(hypothesis.curve) @ curve_root(hypothesis.curve, self.model, self.samples)
        return hypothesis_columns(hypothesis, self.model, self.view, self.drivers)


def state_at(q: Array, model: Model, samples: Samples, noise: NoiseModel, kind: str | None = None) -> CheckState:
    """The model at other postures (k, n), with exact readings as the first of the samples is, or of this kind."""
    like = samples.select(np.zeros(len(q), int))
    if kind is not None:
        like = replace(like, kind=np.full(len(q), kind, dtype=like.kind.dtype))
    poses = replace(
        like, q=q, station=np.arange(len(q)), velocity=np.zeros_like(q), effort=np.full(q.shape, np.nan),
        acceleration=np.zeros_like(q), approach=np.zeros_like(q), following=np.full(q.shape, np.nan),
    )  # fmt: skip
    T = model.predict_samples(poses)
    poses = replace(poses, reading=T[:, :3, 3], R=np.where(poses.is_pose[:, None, None], T[:, :3, :3], np.eye(3)))
    return CheckState(model, poses, FrozenKnowledge((), np.zeros((0, 0)), (), noise))
