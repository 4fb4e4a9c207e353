"""What is left of a case, in units of its noise, and how motions of places would show in it.

One view serves everything that looks for a pattern in the rest: what predicts it (:mod:`crossfit`) and what scatters
(:mod:`scatter`). A *place* is what may err: the base, a joint, the tool. Its motions are columns of the same units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Model, RowView
from modcal_core.effects import place_index
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import Mechanism
from modcal_core.verdict.case import Case, by_sample, weights

_FARTHEST = 5.0  # times the median size; no sample may rule alone


@dataclass(frozen=True)
class Rest:
    """The rest of some samples.

    weight: inverse deviations of their six components, (6, N); zero where there is no orientation. raw: residuals in
    units of the noise, (6, N). residual: the same with samples beyond several times the usual size brought in to there.
    """

    model: Model
    samples: Samples
    view: RowView
    weight: Array
    raw: Array
    residual: Array

    @classmethod
    def of(cls, case: Case, rows: np.ndarray) -> Rest:
        """The rest of a case at some rows (N,) of its samples."""
        samples = case.samples.select(rows)
        view = RowView.of(case.model, samples, case.model.drivers(samples))
        weight = weights(case.noise, samples)
        flat = view.residual
        raw = by_sample(flat, view.pose, len(samples)) * weight
        size = np.linalg.norm(raw, axis=0)
        limit = _FARTHEST * float(np.median(size)) if len(size) else 0.0
        return cls(case.model, samples, view, weight, raw, raw * np.minimum(1.0, limit / np.maximum(size, 1e-300)))

    @property
    def chain(self) -> Mechanism:
        """The arm."""
        return self.model.chain

    def without(self, predicted: Array) -> Rest:
        """The rest beside what is predicted of it, (6, N)."""
        return replace(self, residual=self.residual - predicted)

    def motion(self, place: int, direction: int) -> Array:
        """What a unit of a direction of a place does to the readings, (6, N)."""
        if place in self.view.f.loops:  # the shoulder of a Delta turns and does nothing else
            direction = 5
        column = self.view.unit_column(place, direction)
        return np.asarray(by_sample(column, self.view.pose, len(self.samples)) * self.weight)

    def axis(self, j: int) -> Array:
        """What a joint along its axis does, (6, N)."""
        return self.motion(self.place(j), self.direction(j))

    def place(self, j: int) -> int:
        """The place of a joint."""
        return place_index(self.chain.names[j], self.chain)

    def direction(self, j: int) -> int:
        """The direction of a joint's own motion."""
        return 5 if self.chain.revolute[j] else 2

    def body(self, place: int) -> Array:
        """What all directions of a place do, (6, 6, N)."""
        return np.stack([self.motion(place, d) for d in range(6)])

    def ends(self) -> Array:
        """The same of base and tool, (12, 6, N)."""
        return np.concatenate([self.body(0), self.body(self.chain.tool_place)])

    def read(self, columns: Array) -> Array:
        """Columns (…, 3, N) [m] of positions that are read along the root's axes, (…, 6, N)."""
        out = np.zeros((*columns.shape[:-2], 6, columns.shape[-1]))
        out[..., :3, :] = columns
        return np.asarray(out * self.weight)

    def turned(self, columns: Array) -> Array:
        """The same of columns (…, 3, N) [rad] of orientations alone."""
        out = np.zeros((*columns.shape[:-2], 6, columns.shape[-1]))
        out[..., 3:, :] = columns
        return np.asarray(out * self.weight)


def rows_asked(case: Case, most: int, moving: bool | None = None) -> np.ndarray:
    """Rows whose rest is looked at: of a fitted case all that were not rejected, of a frozen one those that are scored.

    most: more are thinned evenly. moving: whether only those in motion, or only those at rest, are taken.
    """
    rows = np.flatnonzero(~case.wrong) if case.fitted else case.held_out
    if moving is not None:
        rows = rows[case.samples.moving[rows] == moving]
    return np.asarray(rows[spread_rows(len(rows), most)])
