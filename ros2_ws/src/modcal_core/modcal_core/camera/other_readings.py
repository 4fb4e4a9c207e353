"""Readings of other instruments beside the images: tracker, points, sockets, ranges, bearings, in the same fit.

They share the arm and its effects with the camera and have base frames, tool and constants of their own, so one more
block of rows stands below those of the images. How much they scatter beyond what they state of themselves is one more
size that the data decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import (
    INSTRUMENT,
    Cell,
    Model,
    ModelParameter,
    choose_parameters,
    fit_cell,
    linearise,
    views_of,
    with_sockets,
)
from modcal_core.effects import Effect
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array
from modcal_core.hypotheses import proved
from modcal_core.measurements import BEARING, Samples
from modcal_core.measurements.kinds import dimensions, kinds
from modcal_core.robots import Chain, Inertias

MIN = 3  # readings, from which base and tool of an instrument can be placed about an arm that is known
_LEVER = 0.3  # m; an instrument that scatters by so much in position scatters by as much over this in orientation
_FAR = 8.0  # standard deviations, beyond which a reading is left out
_MEDIAN = 2.366  # of a χ² of three
_PLACED = 1.0  # m, rad; how far base and tool may be from where the nominal arm puts them


@dataclass(frozen=True)
class BesideRows:
    """Rows of other instruments. J: (R, K). residual: (R,). known: variance that each row states, (R,). unit: variance
    per square of the size of what else they scatter, (R,). share: of a row in the directions that are seen, (R,).
    """

    J: Array
    residual: Array
    known: Array
    unit: Array
    share: Array

    def variance(self, size: float) -> Array:
        """Variance of each row, (R,)."""
        return np.asarray(self.known + size**2 * self.unit)


@dataclass(frozen=True)
class ReadingsBeside:
    """Readings of other instruments. model: where the nominal arm puts their frames and tool. own: parameters of these
    and of the instruments. samples: the readings.
    """

    model: Model
    own: tuple[ModelParameter, ...]
    samples: Samples

    @property
    def prior_std(self) -> Array:
        """Prior standard deviations of the readings' own parameters."""
        return np.array([p.prior_std if p.place == INSTRUMENT else _PLACED for p in self.own])

    @property
    def metric(self) -> bool:
        """Whether the readings determine a length; directions alone do not."""
        return bool((self.samples.kind != BEARING).any())

    @property
    def label(self) -> str:
        """Description of the readings as text."""
        pairs = zip(self.samples.kind, self.samples.frame, strict=True)
        kinds_in = {(str(kind), self.samples.frames[f]) for kind, f in pairs}
        return ", ".join(f"{kind} in {frame}" for kind, frame in sorted(kinds_in))

    def rows(
        self, arm: Sequence[ModelParameter], values: Array, effects: Sequence[Effect], columns: Array, count: int
    ) -> BesideRows:
        """The rows with the arm's parameters, effects and own ones at these values, in that order. columns: where each
        of these stands among ``count``.
        """
        order, samples = np.roll(np.arange(len(values)), len(self.own)), self.samples
        model = self.model.with_effects(tuple(effects))
        at = linearise(model, (*self.own, *arm), values[order], samples)
        J = np.zeros((at.residual.size, count))
        J[:, columns[order]] = at.J.T
        pose = samples.is_pose
        turned = np.array([kinds()[str(k)].unit == "rad" for k in samples.kind])

        def rows(of_position: Array, of_rotation: Array | float) -> Array:
            return np.r_[np.tile(of_position, 3), np.tile(np.broadcast_to(of_rotation, (int(pose.sum()),)), 3)]

        return BesideRows(
            J,
            at.residual,
            rows(np.nan_to_num(samples.sigma_position) ** 2, np.nan_to_num(samples.sigma_rotation[pose]) ** 2),
            rows(np.where(turned, _LEVER**-2.0, 1.0), _LEVER**-2.0),
            rows(np.where(pose, 3.0, dimensions(samples)) / 3.0, 1.0),
        )

    def far(self, rows: BesideRows, size: float) -> np.ndarray:
        """Which readings are nowhere near the arm, (N,), the others' scatter being the scale: one that is far off makes
        ``size`` large.
        """
        z = rows.residual**2 / rows.variance(size)
        N, pose = len(self.samples), self.samples.is_pose
        worst = z[: 3 * N].reshape(3, N).sum(axis=0)
        worst[pose] = np.maximum(worst[pose], z[3 * N :].reshape(3, -1).sum(axis=0))
        return np.asarray(worst > _FAR**2 * float(np.median(worst)) / _MEDIAN)


def beside(chain: Chain, samples: Samples, inertias: Inertias | None = None) -> ReadingsBeside:
    """Readings of other instruments, their frames and tool placed about the nominal arm.

    Raises NotEnoughData for fewer than three of them in a frame, or of a kind that needs more.
    """
    samples, _ = proved(with_sockets(samples, Cell(), chain), chain)
    for f, frame in enumerate(samples.frames):
        rows = samples.frame == f
        least = max([MIN, *(kinds()[str(k)].least for k in np.unique(samples.kind[rows]))])
        if rows.sum() < least:
            said = f"{int(rows.sum())} readings in it, at least {least} are needed"
            raise NotEnoughData(f"frame {frame}", said, "take more, or leave the topic out (--ignore)")
    model = fit_cell(chain, samples, Cell(), inertias).model
    own = choose_parameters(model, views_of(samples), (), (), among=lambda p: not p.of_arm).parameters
    return ReadingsBeside(model, own, samples)
