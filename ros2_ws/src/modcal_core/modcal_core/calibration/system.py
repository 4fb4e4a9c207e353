"""What a fit asks of its equations, and the plain way to answer: residuals, gradient, normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from modcal_core.calibration.kernels.serial import SerialSystem, is_serial
from modcal_core.calibration.linearise import Linearised, RowView, model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.normal_equations import MAX_KEPT, blocks_at, gradient, normal_equations
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects.drivers import Drivers
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples


class System(Protocol):
    """Equations of the same samples at different values of the same parameters, (P,).

    quick_gradient: whether the gradient alone is had for much less than the normal equations.
    """

    quick_gradient: bool

    def residuals(self, values: Array) -> Linearised:
        """Residuals, without derivatives."""

    def normal_equations(self, values: Array, row_weight: Array) -> tuple[Array, Array]:
        """(JᵀWJ, JᵀWr) with these weights of the rows, (3 N + 3 M,)."""

    def gradient(self, values: Array, row_weight: Array) -> Array:
        """JᵀWr alone, (P,)."""

    def last_curvature(self, row_weight: Array) -> Array:
        """JᵀWJ of the last normal equations, scaled as the weights have been since, on the whole."""


class PlainSystem:
    """The equations of any model."""

    def __init__(self, start: Model, parameters: Sequence[ModelParameter], samples: Samples, around: Drivers) -> None:
        """around: the drivers at the samples."""
        self._start, self._parameters, self._samples, self._around = start, parameters, samples, around
        self._last_view: tuple[Array, RowView] | None = None
        self.quick_gradient = len(samples) <= MAX_KEPT

    def residuals(self, values: Array) -> Linearised:
        """Residuals, without derivatives."""
        view = self._view(values)
        return Linearised(view.position, view.rotation, np.zeros((0, view.position.size + view.rotation.size)))

    def _view(self, values: Array) -> RowView:
        """Readings and frames at these values; those asked for last are kept where the gradient asks for them again."""
        if self._last_view is not None and np.array_equal(self._last_view[0], values):
            return self._last_view[1]
        view = RowView.of(model_at(self._start, self._parameters, values), self._samples, self._around)
        if self.quick_gradient:
            self._last_view = np.array(values), view
        return view

    def normal_equations(self, values: Array, row_weight: Array) -> tuple[Array, Array]:
        """(JᵀWJ, JᵀWr) with these weights of the rows, (3 N + 3 M,)."""
        parts = blocks_at(self._samples, self._around)
        if isinstance(parts, list) and len(parts) == 1:
            parts = [replace(parts[0], view=self._view(values))]
        H, g = normal_equations(self._start, self._parameters, values, self._samples, row_weight, parts)
        self._last = H / float(row_weight.sum())
        return H, g

    def gradient(self, values: Array, row_weight: Array) -> Array:
        """JᵀWr alone, (P,)."""
        if not self.quick_gradient:
            return self.normal_equations(values, row_weight)[1]
        return gradient(self._start, self._parameters, values, self._view(values), self._around, row_weight)

    def last_curvature(self, row_weight: Array) -> Array:
        """JᵀWJ of the last normal equations, scaled as the weights have been since, on the whole."""
        return np.asarray(self._last * float(row_weight.sum()))


def system_of(start: Model, parameters: Sequence[ModelParameter], samples: Samples, around: Drivers) -> System:
    """The equations of these samples, by the quickest way that knows this model."""
    if is_serial(start, samples, parameters):
        return SerialSystem(start, parameters, samples)
    return PlainSystem(start, parameters, samples, around)
