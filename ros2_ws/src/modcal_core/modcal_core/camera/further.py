"""A further camera that watches the same arm: its images in the same fit, with lens, clock and places of its own.

What both share is the arm and its effects, and, where it is the same target file, the size of the print: two sheets of
one printer, or one sheet, are wrong by the same. Seen from the same side it is one sheet, whose bow is shared as well.
What it has of its own stands behind the values of the first camera's fit, and its images come into the equations as
theirs do (equations.OtherBlock).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from modcal_core.camera.arm_poses import ArmPoses
from modcal_core.camera.corners import SHAPE_NAMES, CornerTable
from modcal_core.camera.state import CLOCK_S, CameraState, CommonPrior
from modcal_core.geometry import Array


@dataclass(frozen=True)
class FurtherCamera:
    """name: of its topic. table, poses, prior: as of a fit of its own. begin: where that fit ended. shared: which of
    lens, shape, readout and places of markers are those of the first camera, (15 + Z,). moving: whether its images have
    a clock to find.
    """

    name: str
    table: CornerTable
    poses: ArmPoses
    prior: CommonPrior
    begin: CameraState
    shared: np.ndarray
    moving: bool

    def select(self, rows: np.ndarray) -> FurtherCamera:
        """With some of its images only."""
        return replace(self, table=self.table.select(rows), poses=self.poses.select(rows))

    @property
    def own(self) -> np.ndarray:
        """Which of its parameters, clock, lens, shape, readout and places are its own, indices (P' + 16 + Z)."""
        P = len(self.poses.parameters)
        placed = np.flatnonzero([not p.of_arm for p in self.poses.parameters])
        common = np.flatnonzero(self.prior.free & ~self.shared)
        return np.r_[placed, np.full(int(self.moving), P), P + 1 + common].astype(int)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what it has of its own."""
        every = (
            *(p.name for p in self.poses.parameters),
            *("clock", *self.begin.lens.names, *SHAPE_NAMES, "readout"),
            *(f"places/{i}" for i in range(self.table.places * self.table.markers)),
        )
        return tuple(f"{self.name} {every[i]}" for i in self.own)

    @property
    def start(self) -> Array:
        """The values of its own to begin with."""
        return np.asarray(_vector(self.begin)[self.own])

    @property
    def expected(self) -> Array:
        """What these are expected to be: places where they were found first."""
        P = len(self.poses.parameters)
        return np.asarray(np.r_[np.zeros(P + 1), self.prior.mean][self.own])

    @property
    def information(self) -> Array:
        """Information of the prior of its own values."""
        P = len(self.poses.parameters)
        size = P + 1 + len(self.prior.mean)
        whole = np.zeros((size, size))
        whole[:P, :P] = np.diag(self.poses.prior_std[:P] ** -2)
        whole[P, P] = CLOCK_S**-2
        whole[P + 1 :, P + 1 :] = self.prior.information
        return np.asarray(whole[np.ix_(self.own, self.own)])

    def state(self, first: ArmPoses, state: CameraState, own: Array) -> CameraState:
        """The state of its own fit at one of all. first: the first camera's poses. own: the values of its own."""
        P = len(self.poses.parameters)
        x = _vector(self.begin)
        at = {p.name: i for i, p in enumerate(first.parameters)}
        for i, p in enumerate(self.poses.parameters):
            if p.of_arm:
                x[i] = state.values[at[p.name]]
        x[P + 1 :][self.shared] = _of_first(state.common, len(self.shared))[self.shared]
        x[self.own] = own
        effects = state.values[len(first.parameters) : first.of_model]
        there = replace(self.begin, values=np.r_[x[:P], effects], offset_s=float(x[P]))
        return there.with_common(x[P + 1 :])

    def columns(self, first: ArmPoses, place: int) -> np.ndarray:
        """Where each of its parameters, the effects, clock, lens, shape, readout and places stand among those of all,
        −1 for what is not fitted. place: of the first of its own values.
        """
        P, effects = len(self.poses.parameters), first.of_model - len(first.parameters)
        out = np.full(P + effects + 1 + len(self.prior.mean), -1)
        at = {p.name: i for i, p in enumerate(first.parameters)}
        for i, p in enumerate(self.poses.parameters):
            if p.of_arm:
                out[i] = at[p.name]
        out[P : P + effects] = len(first.parameters) + np.arange(effects)
        common = P + effects + 1
        out[common:][self.shared] = first.count + 1 + np.flatnonzero(self.shared)
        own = self.own
        out[np.where(own < P, own, own + effects)] = place + np.arange(len(own))
        return out


def _of_first(common: Array, count: int) -> Array:
    """What all images of the first camera share, as much of it as another camera has: its target may be another."""
    return np.asarray(np.r_[common, np.zeros(max(count - len(common), 0))][:count])


def further_cameras(poses: ArmPoses) -> tuple[FurtherCamera, ...]:
    """Further cameras of a fit."""
    return cast(tuple[FurtherCamera, ...], poses.further)


def places_of(further: Sequence[FurtherCamera], end: int) -> list[int]:
    """Where the own values of each begin, the last ending at ``end``."""
    counts = [len(one.own) for one in further]
    return [end - sum(counts[i:]) for i in range(len(counts))]


def _vector(state: CameraState) -> Array:
    """Parameters without effects, clock, lens, shape, readout and places as one vector, absolute."""
    return np.r_[state.values, state.offset_s, state.common]
