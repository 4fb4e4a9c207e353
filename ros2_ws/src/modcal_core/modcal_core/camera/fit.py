"""The fit: arm, base, tool, clock, lens and the sheet's shape from all corners of all images, in one vector of values.

Every camera has base and tool, clock, lens, shape of its target, readout and places of markers of its own; all share
the arm and its effects. Two that see the same target file share the size of the print; from the same side it is one
sheet, whose bow is shared as well, and one body. What a camera shares stands where the first camera has it; its own
values stand behind those of the cameras before.

The fit has its covariance about where its values ended, from the drawing on; a calibration is written with the least
change to its drawing. The one is brought to the other by the derivatives of readings at general postures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize

from modcal_core.calibration import Model, Uncertainty, View, general_samples, linearise
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
from modcal_core.camera.equations import BesideRows, CameraRows, Equations, ReadingsBeside, Sizes, SolvedEquations
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import Mounting
from modcal_core.effects import Effect
from modcal_core.geometry import Array, combined, descend, se3
from modcal_core.measurements import POSE


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
    def expected(self) -> ValuePrior:
        """The prior of its values, clock, lens, shape, readout and places, (P + 16 + Z,), and where a fit begins."""
        _, mean, information, free = self.poses.values
        whole = block_diag(information, np.array([[CLOCK_S**-2]]), self.prior.information)
        free = np.r_[free, self.poses.moves, self.prior.free]
        free[len(mean) + 1 + READOUT] &= self.poses.moves
        return ValuePrior(self.begin.vector, np.r_[mean, 0.0, self.prior.mean], whole, free)

    def rows(self, state: CameraState, columns: np.ndarray) -> CameraRows:
        """Its factors at a state. columns: where its values stand among those of all."""
        poses, table = self.poses, self.table
        T, motions = poses.tool_motions(state.values, state.offset_s)
        own = poses.own_motions(state.values, T)
        by_clock = own[:, :, :-3] @ poses.velocity[:, :, None]
        moved = poses.as_twists(T, np.concatenate([motions, by_clock], axis=2))
        sweep = moved[:, :, -1] if poses.moves else None
        rows = corner_rows(table, state.lens, state.shape, poses.seen(T), state.readout_s, sweep)
        stop = poses.moments.stop if len(poses.moments.stop) else np.arange(len(T))
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

    def with_effects(self, effects: Sequence[Effect]) -> Cameras:
        """The same with these effects of the arm in place of those it has."""
        return replace(self, every=tuple(one.with_effects(effects) for one in self.every))

    @cached_property
    def columns(self) -> tuple[np.ndarray, ...]:
        """Where the values of each camera stand among all, (P + 16 + Z,): what cameras share at one place."""
        at, out = dict[tuple[str | int, str | int], int](), []
        for k, one in enumerate(self.every):
            names: list[tuple[str | int, str | int]]
            names = [("arm" if p.of_arm else k, p.name) for p in one.poses.parameters]
            names += [("effects", i) for i in range(one.poses.count - len(names))]
            names += [(0 if shared else k, i) for i, shared in enumerate(_shared(self.first, one))]
            out.append(np.array([at.setdefault(name, len(at)) for name in names]))
            if k == 0 and self.beside is not None:
                at |= {("beside", i): len(at) + i for i in range(len(self.beside.own))}
        return tuple(out)

    @cached_property
    def expected(self) -> ValuePrior:
        """The prior of all V values, and where a fit begins."""
        own = np.empty(0) if self.beside is None else self.beside.prior_std
        known = len(self.columns[0]) + len(own)
        count = max(known, 1 + max(int(columns.max()) for columns in self.columns))
        out = ValuePrior(np.zeros(count), np.zeros(count), np.zeros((count, count)), np.ones(count, bool))
        instruments = np.arange(known - len(own), known)
        out.information[instruments, instruments] = own**-2.0
        # what several share is as the first of them has it
        for one, at in list(zip(self.every, self.columns, strict=True))[::-1]:
            out.start[at], out.mean[at], out.information[np.ix_(at, at)], out.free[at] = one.expected
        return out

    def states(self, x: Array) -> list[CameraState]:
        """The state of each camera at values (V,) of all."""
        return [one.begin.at(x[columns]) for one, columns in zip(self.every, self.columns, strict=True)]

    def equations(self, x: Array) -> Equations:
        """The equations at values (V,) of all cameras and other instruments."""
        first, (_, mean, information, free) = self.first, self.expected
        every = zip(self.every, self.states(x), self.columns, strict=True)
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
        poses, own = self.first.poses, len(self.columns[0]) + np.arange(len(self.beside.own))
        arm, effects = np.flatnonzero(poses.of_arm), np.arange(len(poses.parameters), poses.count)
        columns = np.r_[arm, effects, own]
        among = [poses.parameters[i] for i in arm]
        return self.beside.rows(among, x[columns], poses.model.effects, columns, len(x))


def _shared(first: Camera, one: Camera) -> np.ndarray:
    """Which of clock, lens, shape, readout and places a camera shares with the first, (16 + Z,) bool."""
    out, same = np.zeros(1 + len(one.prior.mean), bool), one.table.target == first.table.target
    out[1:][SCALE] = same
    same_side = same and one.poses.camera_on_tip == first.poses.camera_on_tip
    out[1:][BOW] = out[1:][COMMON:] = same_side  # two bodies of one drawing have markers glued each by itself
    return out


START = Sizes(1.0, 1e-4, 1e-4, 0.1)  # to begin with: an arm that repeats to 0.1 mrad and is 1 mm off a parameter
# What is known of the sizes before: middle, and by what factor they usually differ from it. Wide, and there to keep a
# size that the data say nothing of where arms and cameras have it.
_USUAL_LOGS = START.logs  # asked for with every step of the search
# Lengths and angles of an arm are as faulty as each other, in units of 10 mm and 20 mrad, to a factor of two: from
# industrial arms (0.3 mm, 0.5 mrad) to printed ones (1 mm, 5 mrad).
# Markers on a body are off by a tolerance that is mostly a guess, as the arm's is.
_FACTOR = np.log([10.0, 10.0, 10.0, 10.0, 10.0, 2.0, 10.0])
_MIN = np.log([0.02, 1e-7, 1e-7, 1e-3, 1e-7, 0.1, 1e-3])
_MAX = np.log([50.0, 0.03, 0.03, 5.0, 0.03, 10.0, 30.0])
_NO_SIZES = 1e12  # of −2 log likelihood
_DOWNHILL: Any = {"ftol": 1e-7, "gtol": 0.02, "eps": 1e-4}  # −2 log likelihood moves by 1 at a standard deviation


def usual(sizes: Sizes) -> float:
    """−2 log of how usual these sizes are."""
    off = (sizes.logs - _USUAL_LOGS) / _FACTOR
    return float(off @ off)


def likeliest(
    equations: Equations,
    start: Sizes,
    misfit_of: Callable[[SolvedEquations], float] = SolvedEquations.misfit,
) -> Sizes:
    """The sizes that make the data likeliest.

    misfit_of: −2 log likelihood of the equations with their sizes. A size that is far too small is nowhere seen to
    matter, so slopes alone may leave it there: each is tried larger first.
    """
    faults = equations.faults
    begin = start if faults is None or faults.stated is None else replace(start, arm=faults.stated)
    free = faults is not None and faults.stated is None
    asked = [True] * 3 + [free, equations.beside is not None, free, equations.places is not None]  # as Sizes has them
    unknown, known = np.flatnonzero(asked), begin.logs

    def inside(logs: Array) -> Array:
        full = known.copy()
        full[unknown] = np.clip(logs, _MIN[unknown], _MAX[unknown])
        return full

    def misfit(logs: Array) -> float:
        full = inside(logs)
        try:
            found = misfit_of(equations.solve(Sizes.of_logs(full)))
        except np.linalg.LinAlgError:  # far beyond what errors are, rounding is all that is left of an equation
            found = _NO_SIZES
        return found + usual(Sizes.of_logs(full)) + float(np.abs(logs - full[unknown]).sum())

    first = known[unknown]
    first = min((first, *(first + np.eye(len(first)))), key=misfit)
    bounds = list(zip(_MIN[unknown], _MAX[unknown], strict=True))
    return Sizes.of_logs(inside(minimize(misfit, first, method="L-BFGS-B", bounds=bounds, options=_DOWNHILL).x))


LIKELIER = 6.0  # of −2 log likelihood, the price of what is set free taken off: odds of 20 : 1
_STEPS = 30  # at the same sizes
_FIT_MET = 1e-4  # gain of −2 log likelihood
_ROUNDS = 4  # of fitting and finding the sizes; they settle in two or three
_SETTLED = 0.05  # change of a size's logarithm


@dataclass(frozen=True)
class CameraFit:
    """cameras: what was fitted. x: where the values of all ended, (V,). sizes: of the errors. covariance: of the
    values, (V, V). equations: at them. converged: whether it met.
    """

    cameras: Cameras
    x: Array
    sizes: Sizes
    covariance: Array
    equations: Equations
    converged: bool

    @property
    def table(self) -> CornerTable:
        """Corners of the first camera."""
        return self.cameras.first.table

    @property
    def poses(self) -> ArmPoses:
        """The arm at the images of the first camera."""
        return self.cameras.first.poses

    @property
    def model(self) -> Model:
        """The arm's model, with the effects that were added to it."""
        return self.poses.model

    @cached_property
    def states(self) -> list[CameraState]:
        """Where each camera ended."""
        return self.cameras.states(self.x)

    @property
    def state(self) -> CameraState:
        """Where the first camera ended."""
        return self.states[0]

    @property
    def common(self) -> np.ndarray:
        """Where lens, shape, readout and places of markers of the first camera stand among all values, (15 + Z,)."""
        return self.cameras.columns[0][self.poses.count + 1 :]

    @cached_property
    def std(self) -> list[Array]:
        """Standard deviations of the values of each camera, (P + 16 + Z,), 0 of what was not fitted."""
        std = np.sqrt(np.diag(self.covariance))
        return [std[columns] for columns in self.cameras.columns]

    @property
    def pixels(self) -> Array:
        """By how much corners (M, 2) of the first camera differ from the model, images' own twists not put in [px]."""
        return self.equations.cameras[0].pixels

    @property
    def rms_px(self) -> list[float]:
        """RMS distance of corners from the model, of each camera [px]."""
        every = zip(self.cameras.every, self.equations.cameras, strict=True)
        return [one.table.rms(rows.pixels) for one, rows in every]

    @property
    def misfit(self) -> float:
        """−2 log of the likelihood of the images, everything integrated out, and of sizes as usual as these."""
        return self.equations.solve(self.sizes).misfit() + usual(self.sizes)

    @property
    def tool(self) -> Array:
        """T_frame_tool at every image, (N, 4, 4)."""
        return self.poses.tool_at(self.state.values, self.state.offset_s)

    def tool_at(self, q: Array) -> Array:
        """T_frame_tool at postures q (M, n), the arm standing, (M, 4, 4)."""
        return self.poses.at_postures(q).tool_at(self.state.values)

    def seen_at(self, q: Array) -> Array:
        """T_camera_target at postures q (M, n), the arm standing, (M, 4, 4)."""
        return self.poses.seen(self.tool_at(q))

    @property
    def flange(self) -> Array:
        """The flange in the frame of whatever the arm carries, (3,) [m]."""
        return np.asarray(se3.inverse(self.poses.model_at(self.state.values).T_tip_tool)[:3, 3])

    def at_flange(self, T: Array, motions: Array) -> Array:
        """Motion of the flange along the frame, (M, 3, K), for motions (M, 6, K) of the tool at poses T (M, 4, 4)."""
        away = T[:, :3, :3] @ self.flange
        return np.asarray(motions[:, :3] - np.cross(away[:, :, None], motions[:, 3:], axisa=1, axisb=1, axisc=1))

    def flange_motions(self, q: Array) -> Array:
        """Motion of the flange at postures q (M, n) per parameter of arm, effects and other instruments, (M, 3, P)."""
        return self.at_flange(*self.poses.at_postures(q).tool_motions(self.state.values))

    def weighed(
        self,
        equations: Equations | None = None,
        misfit_of: Callable[[SolvedEquations], float] = SolvedEquations.misfit,
    ) -> tuple[SolvedEquations, float]:
        """(equations, −2 log likelihood) with the sizes of all errors found again. equations: None: as they are."""
        equations = equations or self.equations
        sizes = likeliest(equations, self.sizes, misfit_of)
        solved = equations.solve(sizes)
        return solved, misfit_of(solved) + usual(sizes)


_Place = tuple[Array, SolvedEquations]


def fit_cameras(
    cameras: Cameras, start: Array | None = None, sizes: Sizes = START, fixed_sizes: bool = False
) -> CameraFit:
    """The fit of all cameras from values (V,), or where these begin. sizes: to begin with; fixed_sizes: to keep."""
    x = cameras.expected.start if start is None else start
    stated = cameras.first.poses.arm_stated
    if stated is not None:
        sizes = replace(sizes, arm=stated)

    def stepped(here: _Place, damping: float) -> tuple[_Place, float] | None:
        there = here[0] + here[1].step(damping)
        every = cameras.states(there)
        if not all((s.lens.values[:2] > 0.0).all() and np.isfinite(s.common).all() for s in every):
            return None
        solved = cameras.equations(there).solve(sizes)
        return (there, solved), solved.cost

    def met(_: _Place, gain: float, __: float) -> bool:
        return gain <= _FIT_MET

    settled = fixed_sizes
    for k in range(_ROUNDS + 1):
        begin = x, cameras.equations(x).solve(sizes)
        found = descend(begin, lambda here: here[1].cost, stepped, met, _STEPS)
        x, equations = found.place[0], found.place[1].equations
        if settled or k == _ROUNDS:
            break
        new = likeliest(equations, sizes)
        settled = bool(np.abs(new.logs - sizes.logs).max() < _SETTLED)
        sizes = new
    return CameraFit(cameras, x, sizes, equations.solve(sizes).covariance(), equations, found.converged)


def uncertainty_about(model: Model, fit: CameraFit) -> Uncertainty:
    """The covariance of this model, which predicts as the fit does; what is unsure of lens and target is in it."""
    poses = fit.poses
    count, P = poses.count, len(poses.parameters)
    samples = general_samples(model, [View(POSE, f) for f in range(len(model.frames))], each=max(24, count))
    ended = linearise(poses.model, poses.parameters, fit.state.values[:count], samples).J
    begin = np.concatenate([np.zeros(P), *(e.values for e in model.effects)])
    written = linearise(model, poses.parameters, begin, samples).J
    to_written = combined(written.T, ended.T)
    covariance = to_written @ fit.covariance[:count, :count] @ to_written.T
    return Uncertainty(poses.parameters, 0.5 * (covariance + covariance.T))
