"""A frozen model beside the readings of a check: residuals, derivatives, and what the readings scatter by."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from modcal_core.calibration.linearise import RowView
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.checking.hypotheses import NOISE, CellChange, curve_columns, hypothesis_columns
from modcal_core.checking.noise import FrozenKnowledge, NullModel, null, parameter_rows
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples


class CheckState:
    """A model beside the samples, what its readings scatter by, and its derivatives."""

    def __init__(self, model: Model, samples: Samples, known: FrozenKnowledge, of: NullModel | None = None) -> None:
        self.model, self.samples, self.known = model, samples, known
        self.drivers = model.drivers(samples)
        self.view = RowView.of(model, samples, self.drivers)
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
        """Of the rows of a linearisation, (n,)."""
        return np.concatenate([self.view.position.ravel(), self.view.rotation.ravel()])

    def columns(self, hypothesis: CellChange) -> Array:
        """Of a change, at this model; none of noise, which has no size."""
        if hypothesis.kind == NOISE:
            return np.zeros((len(self.residual), 0))
        if hypothesis.curve >= 0:
            return curve_columns(hypothesis.curve, self.model, self.view)
        return hypothesis_columns(hypothesis, self.model, self.view, self.drivers)
