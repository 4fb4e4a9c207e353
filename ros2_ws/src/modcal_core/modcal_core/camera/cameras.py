"""All cameras of a fit, and other instruments beside them: one vector of values, one prior, the factors of each.

Every camera has base and tool, clock, lens, shape of its target, readout and places of markers of its own; all share
the arm and its effects. Where two see the same target file, the size of the print is one: two sheets of one printer, or
one sheet, are wrong by the same. Seen from the same side it is one sheet, whose bow is shared as well, and one body.
What a camera shares stands where the first camera has it; its own values stand behind those of the cameras before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from modcal_core.camera.arm_poses import NOTHING_KNOWN, ArmPoses, ImageMoments, ValuePrior
from modcal_core.camera.bundle import BoardView, CalibrationTarget
from modcal_core.camera.corners import (
    BOW,
    CLOCK_S,
    COMMON,
    FREE,
    READOUT,
    SCALE,
    CameraState,
    CommonPrior,
    CornerTable,
    corner_rows,
    grams,
)
from modcal_core.camera.equations import ALONE, CameraRows, Equations
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import Mounting
from modcal_core.camera.other_readings import BesideRows, ReadingsBeside
from modcal_core.effects import Effect
from modcal_core.geometry import Array


@dataclass(frozen=True)
class CameraImages:
    """What one camera saw. name: of its topic, for messages. q, velocity: of the joints at each view, (N, n); None:
    they stood. size: of the images [px]. lens: as stated, with what becomes of it: free (a start), tolerance, fixed;
    None: found from the images. camera_on_tip: the mounting where it is stated. flat: the sheet is known to be flat.
    moments: for effects. fisheye: whether the lens is one, where nothing is stated of it.
    """

    q: Array
    views: Sequence[BoardView]
    target: CalibrationTarget
    size: tuple[int, int]
    velocity: Array | None = None
    lens: Lens | None = None
    stated: str = FREE
    camera_on_tip: bool | None = None
    flat: bool = False
    moments: ImageMoments = NOTHING_KNOWN
    fisheye: bool = False
    name: str = "images"


@dataclass(frozen=True)
class Camera:
    """A camera of a fit. given: all that it saw. mounting: as found. table: corners of images in use. poses: the arm at
    these, base and tool as found. prior: of lens, shape, readout and places of markers. begin: the state that a fit
    begins with. left_out: images by reason.
    """

    given: CameraImages
    mounting: Mounting
    table: CornerTable
    poses: ArmPoses
    prior: CommonPrior
    begin: CameraState
    left_out: dict[str, str]

    def with_effects(self, effects: Sequence[Effect]) -> Camera:
        """The same with these effects of the arm in place of those it has."""
        parameters = self.begin.values[: len(self.poses.parameters)]
        values = np.concatenate([parameters, *(e.values for e in effects)])
        return replace(self, poses=self.poses.with_effects(effects), begin=replace(self.begin, values=values))

    def select(self, views: np.ndarray) -> Camera:
        """The same with these images only, mask (N,)."""
        return replace(self, table=self.table.select(views), poses=self.poses.select(views))

    @property
    def free(self) -> np.ndarray:
        """Which of its values, clock, lens, shape, readout and places are fitted, (P + 16 + Z,) bool."""
        common = self.prior.free & (self.poses.moves | (np.arange(len(self.prior.free)) != READOUT))
        return np.r_[np.ones(self.poses.count, bool), self.poses.moves, common]

    @property
    def expected(self) -> ValuePrior:
        """The prior of these, and where a fit begins."""
        _, mean, information = self.poses.values
        whole = block_diag(information, np.array([[CLOCK_S**-2]]), self.prior.information)
        return ValuePrior(self.begin.vector, np.r_[mean, 0.0, self.prior.mean], whole)

    def rows(self, state: CameraState, columns: np.ndarray) -> CameraRows:
        """Its factors at a state. columns: where its values stand among those of all."""
        poses, table = self.poses, self.table
        T, motions = poses.tool_motions(state.values, state.offset_s)
        own = poses.own_motions(state.values, T)
        by_clock = own[:, :, :-3] @ poses.velocity[:, :, None]
        moved = poses.as_twists(T, np.concatenate([motions, by_clock], axis=2))
        sweep = moved[:, :, -1] if poses.moves else None
        rows = corner_rows(table, state.lens, state.shape, poses.seen(T), state.readout_s, sweep)
        stop = poses.moments.stop if len(poses.moments.stop) else np.full(len(T), ALONE)
        corners = int((table.weight > 0.0).sum())
        return CameraRows(grams(table, rows), moved, poses.as_twists(T, own), columns, corners, stop, rows.pixels)


@dataclass(frozen=True)
class Cameras:
    """What is fitted together. every: the cameras, first the one whose view is judged. beside: readings of other
    instruments. V: number of all values: those of the first camera, of the instruments, and each camera's own.
    """

    every: tuple[Camera, ...]
    beside: ReadingsBeside | None = None

    @property
    def first(self) -> Camera:
        """The camera whose view is judged."""
        return self.every[0]

    def with_first(self, first: Camera) -> Cameras:
        """The same with another first camera."""
        return replace(self, every=(first, *self.every[1:]))

    def with_effects(self, effects: Sequence[Effect]) -> Cameras:
        """The same with these effects of the arm in place of those it has."""
        return replace(self, every=tuple(one.with_effects(effects) for one in self.every))

    @cached_property
    def columns(self) -> tuple[np.ndarray, ...]:
        """Where the values of each camera stand among all, (P + 16 + Z,); -1 for one that stays as it is."""
        first = self.first
        out, count = [np.arange(len(first.free))], len(first.free)
        count += 0 if self.beside is None else len(self.beside.own)
        at = {p.name: i for i, p in enumerate(first.poses.parameters)}
        effects = list(range(len(at), first.poses.count))
        for one in self.every[1:]:
            of_arm = [at[p.name] if p.of_arm else -1 for p in one.poses.parameters]
            behind = np.arange(first.poses.count, len(one.prior.mean) + 1 + first.poses.count)
            columns = np.r_[of_arm, effects, np.where(_shared(first, one), behind, -1)].astype(int)
            own = np.flatnonzero(one.free & (columns < 0))
            columns[own] = count + np.arange(len(own))
            out.append(columns)
            count += len(own)
        return tuple(out)

    @cached_property
    def expected(self) -> ValuePrior:
        """The prior of all V values, and where a fit begins."""
        own = np.empty(0) if self.beside is None else self.beside.prior_std
        known = len(self.first.free) + len(own)
        count = max(known, 1 + max(int(columns.max()) for columns in self.columns))
        start, mean, information = np.zeros(count), np.zeros(count), np.zeros((count, count))
        instruments = np.arange(known - len(own), known)
        information[instruments, instruments] = own**-2.0
        for k, (one, columns) in enumerate(zip(self.every, self.columns, strict=True)):
            rows, (begin, middle, whole) = np.flatnonzero(columns >= known * (k > 0)), one.expected
            at = columns[rows]
            start[at], mean[at], information[np.ix_(at, at)] = begin[rows], middle[rows], whole[np.ix_(rows, rows)]
        return ValuePrior(start, mean, information)

    def states(self, x: Array) -> list[CameraState]:
        """The state of each camera at values (V,) of all."""
        every = zip(self.every, self.columns, strict=True)
        return [one.begin.at(np.where(columns >= 0, x[columns], one.begin.vector)) for one, columns in every]

    def equations(self, x: Array) -> Equations:
        """The equations at values (V,) of all cameras and other instruments."""
        first, (_, mean, information) = self.first, self.expected
        every = zip(self.every, self.states(x), self.columns, strict=True)
        free = np.ones(len(x), bool)
        free[: len(first.free)] = first.free
        return Equations(
            tuple(one.rows(state, columns) for one, state, columns in every),
            x - mean,
            information,
            free,
            np.flatnonzero(first.poses.of_arm),
            self._rows_beside(x),
            first.poses.faults,
            first.prior.places,
        )

    def _rows_beside(self, x: Array) -> BesideRows | None:
        """The rows of other instruments at values (V,) of all."""
        if self.beside is None:
            return None
        poses = self.first.poses
        arm = np.flatnonzero(poses.of_arm)
        effects = np.arange(len(poses.parameters), poses.count)
        columns = np.r_[arm, effects, len(self.first.free) + np.arange(len(self.beside.own))]
        among = [poses.parameters[i] for i in arm]
        return self.beside.rows(among, x[columns], poses.model.effects, columns, len(x))


def _shared(first: Camera, one: Camera) -> np.ndarray:
    """Which of clock, lens, shape, readout and places a further camera shares with the first, (16 + Z,) bool."""
    out = np.zeros(1 + len(one.prior.mean), bool)
    same = one.table.target == first.table.target
    same_side = one.poses.camera_on_tip == first.poses.camera_on_tip
    shared = out[1:]
    shared[SCALE] = same
    shared[BOW] = same and same_side
    shared[COMMON:] = same and same_side  # two bodies of one drawing have markers glued each by itself
    return out
