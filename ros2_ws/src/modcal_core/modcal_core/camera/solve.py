"""From corners and joints to a calibrated arm, and what it is worth in millimetres: problem in, solution out.

Each camera's images are prepared (lens, poses of the target, mounting), everything is fitted at once, and once more
with the nominal arm, to compare with. Effects of the arm are looked for; what was moved, what fits nothing and what the
images leave open decide about the advice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Model, least_change
from modcal_core.camera.arm_poses import FurtherCamera, with_stated
from modcal_core.camera.bundle import CalibrationTarget, MarkerBundle
from modcal_core.camera.causes import CameraCause, HiddenSpring, find_causes, hidden_springs
from modcal_core.camera.changes import FoundChange, find_change
from modcal_core.camera.claim import RestsOn, ToolError, arm_draws, rests_on, shares, tool_error
from modcal_core.camera.corners import BOW, COMMON, FREE, READOUT, SCALE, CameraState
from modcal_core.camera.decision import (
    CANNOT_TELL,
    Decision,
    Grounds,
    contradictions,
    decide,
    in_doubt,
    left_out_images,
    metric_of,
    problems,
    size_open,
)
from modcal_core.camera.equations import numbered
from modcal_core.camera.fit import CameraFit, fit_camera
from modcal_core.camera.intrinsics import LensFit
from modcal_core.camera.mounting import Mounting, held_out
from modcal_core.camera.other_readings import MIN, ReadingsBeside
from modcal_core.camera.outliers import LeftOutPoints, PreparedImages, first_fit, left_out_points
from modcal_core.camera.prepared import CameraImages, prepare_images
from modcal_core.camera.statements import SIZE, CameraFinding, StatedCamera, doubts, findings
from modcal_core.camera.views import postures_anywhere, postures_in_view, weak_directions
from modcal_core.diagnosis import EffectChoice
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.robots import Chain, Inertias

_CLEANED = 3  # times that other instruments' readings are looked through for those far off


@dataclass(frozen=True)
class CameraProblem:
    """chain: nominal. cameras: what each saw of the arm; the error at the tool is over what the first one sees. arm_m:
    RMS error of the nominal arm, as stated [m]. fixed: parameters that stay as they are. inertias: for effects. beside:
    readings of other instruments.
    """

    chain: Chain
    cameras: tuple[CameraImages, ...]
    arm_m: float | None = None
    fixed: Sequence[str] = ()
    inertias: Inertias | None = None
    beside: ReadingsBeside | None = None
    look_for_effects: bool = True


def only_seen(cameras: Sequence[CameraImages]) -> list[CameraImages]:
    """The same images, bodies with those of their markers only that some camera saw, which all that see it share.

    Raises BadTable for a body of which too little was seen.
    """
    out = []
    for one in cameras:
        if isinstance(one.target, MarkerBundle):
            ids = [v.ids for other in cameras if other.target == one.target for v in other.views]
            target = one.target.of_points(np.unique(np.concatenate([np.empty(0, int), *ids])).astype(int))
            one = replace(one, target=target, views=target.renumbered(one.views, one.target))
        out.append(one)
    return out


def with_stops(cameras: Sequence[CameraImages]) -> list[CameraImages]:
    """The same images, those of several cameras that were taken at one stop of the arm numbered as such."""
    if len(cameras) == 1:
        return list(cameras)
    names = [[v.name for v in one.views] for one in cameras]
    stops = numbered([one.q for one in cameras], names, [one.moments.stamps for one in cameras])
    return [replace(one, moments=replace(one.moments, stop=stop)) for one, stop in zip(cameras, stops, strict=True)]


@dataclass(frozen=True)
class FurtherSeen:
    """A further camera after the fit of all. std: of lens, shape, readout and places, those of the first camera as in
    its fit, (15 + Z,). given: images in which the target was found. rms_px: of its corners.
    """

    ready: PreparedImages
    name: str
    target: CalibrationTarget
    state: CameraState
    std: Array
    given: int
    rms_px: float

    @property
    def mounting(self) -> Mounting:
        """As found from its images."""
        return self.ready.mounting

    @property
    def left_out(self) -> dict[str, str]:
        """Images that are left out, by reason."""
        return self.ready.left_out

    @property
    def used(self) -> int:
        """Number of images in the fit."""
        return self.ready.table.views


@dataclass(frozen=True)
class _Further:
    """A further camera. camera: for the fit of all. problems: what its own images contradict, in sentences."""

    camera: FurtherCamera
    images: CameraImages
    ready: PreparedImages
    problems: tuple[str, ...]

    def seen_by(self, fit: CameraFit) -> FurtherSeen:
        """What the fit of all makes of it."""
        every = zip(fit.poses.further_at(fit.state), fit.equations.cameras[1:], strict=True)
        (camera, columns, state), rows = next(one for one in every if one[0][0].name == self.camera.name)
        columns = columns[len(state.values) + 1 :]
        std = np.where(columns >= 0, np.sqrt(np.diag(fit.covariance))[columns], 0.0)
        rms = camera.table.rms(rows.pixels)
        one = self.images
        return FurtherSeen(self.ready, one.name, one.target, state, std, len(one.views), rms)


def further_of(problem: CameraProblem, images: CameraImages, of_first: PreparedImages) -> _Further:
    """A further camera, from a fit of its own. of_first: the first camera's images.

    Raises ModcalError for images that cannot carry a fit by themselves.
    """
    first = problem.cameras[0]
    if images.name == first.name:
        raise BadRecording(images.name, "is given twice", "give each camera once")
    ready = prepare_images(problem.chain, images, problem.fixed, problem.inertias)
    fit, ready = first_fit(replace(ready, poses=with_stated(ready.poses, problem.arm_m)))
    out = [] if fit.converged else [f"The fit of {images.name} by itself did not reach its minimum."]
    if (change := find_change(fit)) is not None:
        out.append(change.sentence(fit, f" of {images.name}"))
    out += left_out_images(ready.left_out, len(images.views), f" of {images.name}")
    same_target = images.target == of_first.target
    same_side = ready.mounting.camera_on_tip == of_first.mounting.camera_on_tip
    shared = np.zeros(len(fit.prior.mean), bool)
    shared[SCALE] = same_target
    shared[BOW] = same_target and same_side
    shared[COMMON:] = same_target and same_side  # two bodies of one drawing have markers glued each by itself
    prior = replace(fit.prior, free=fit.prior.free & (fit.poses.moves | (np.arange(len(shared)) != READOUT)))
    camera = FurtherCamera(images.name, fit.table, fit.poses, prior, fit.state, shared)
    return _Further(camera, images, ready, tuple(out))


@dataclass(frozen=True)
class CameraSolution:
    """fit: of everything. geometric: the same without effects. nominal: the same images, the nominal arm. mounting:
    found first. lens_fit: from the images alone. left_out: images by reason. corners_out: share of corners left out.
    in_view, anywhere: error at the tool over the joint ranges of the images where the target is in view, and over all
    joint limits. decision: of the former. moved: what was moved between images. weak: sentences. shares: of claim.
    held_out_px: (nominal, calibrated) RMS on images that neither fit has seen [px]. findings: what target and
    camera are not as stated. causes: effects beyond geometry.
    left: what is significant and could not be turned into one. notes: what was done to the images, in sentences.
    rests_on: what the sheet's stated size is worth, where the images do not show it. further: of other cameras.
    hidden: springs that these images would not show. alone: as in_view, the frame put where it suits best.
    open_points: of a body, what a verdict may not pass over of points that were left out, in sentences.
    """

    fit: CameraFit
    geometric: CameraFit
    nominal: CameraFit
    mounting: Mounting
    lens_fit: LensFit
    target: CalibrationTarget
    left_out: dict[str, str]
    corners_out: float
    in_view: ToolError
    anywhere: ToolError
    decision: Decision
    moved: FoundChange | None
    weak: tuple[str, ...]
    shares: dict[str, tuple[float, float]]
    held_out_px: tuple[float, float]
    metric: tuple[str, ...]
    findings: tuple[CameraFinding, ...] = ()
    causes: tuple[CameraCause, ...] = ()
    left: EffectChoice | None = None
    notes: tuple[str, ...] = ()
    rests_on: RestsOn | None = None
    further: tuple[FurtherSeen, ...] = ()
    hidden: tuple[HiddenSpring, ...] = ()
    alone: ToolError | None = None
    open_points: tuple[str, ...] = ()

    @property
    def judged(self) -> ToolError:
        """The error that counts: where the target is in view, with a body the arm's by itself, for fixed cameras are
        there for the arm, wherever they stand.
        """
        return self.alone if self.fit.table.places and self.alone is not None else self.in_view

    @property
    def model(self) -> Model:
        """The calibrated model, with the least change to the drawing that gives these kinematics."""
        return _nearest(self.fit)

    @property
    def geometric_model(self) -> Model:
        """The model that is best by geometry alone, for readers that know no effects."""
        return _nearest(self.geometric)

    @property
    def nominal_model(self) -> Model:
        """The nominal arm with camera and target placed by the same images."""
        return self.nominal.poses.model_at(self.nominal.state.values)


def solve_camera(
    problem: CameraProblem, rng: np.random.Generator, progress: Callable[[str], None] = lambda _: None
) -> CameraSolution:
    """The calibration of an arm from what cameras saw. Raises ModcalError for images that cannot carry a fit."""
    images, *further = with_stops(only_seen(problem.cameras))
    problem = replace(problem, cameras=(images, *further))
    target = images.target
    ready = prepare_images(problem.chain, images, problem.fixed, problem.inertias, progress)

    progress("fit")
    others = [further_of(problem, one, ready) for one in further]
    poses = replace(ready.poses, beside=problem.beside, further=tuple(one.camera for one in others))
    fit, ready = first_fit(replace(ready, poses=with_stated(poses, problem.arm_m)))
    fit = _without_far(fit, ready)
    still = replace(fit.poses, parameters=ready.placed, further=(), faults=None)
    nominal = fit_camera(ready.table, still, ready.prior, ready.lens_fit.lens)

    geometric = fit
    causes: tuple[CameraCause, ...] = ()
    left: EffectChoice | None = None
    if problem.look_for_effects:
        progress("effects")
        fit, causes, left = find_causes(fit, rng, progress)

    progress("verdict")
    near, _ = postures_in_view(fit, rng)
    lens = ready.lens_fit.lens if images.lens is None else images.lens
    became = images.stated if images.lens is not None and images.stated != FREE else None
    stated = StatedCamera(lens, became, target.scale)
    doubted = doubts(fit, stated)
    draws = arm_draws(fit, rng, doubted)
    in_view = tool_error(fit, nominal, near, draws)
    anywhere = tool_error(fit, nominal, postures_anywhere(problem.chain, rng), draws)
    alone = tool_error(fit, nominal, near, draws, arm_alone=True)
    change = find_change(fit)
    wrong = contradictions(fit, doubted, stated)
    against = problems(fit, nominal, change, wrong, left_out_images(ready.left_out, len(images.views)), target)
    against += tuple(said for one in others for said in one.problems)
    points_out = LeftOutPoints()
    if isinstance(target, MarkerBundle):
        same = [(f" of {one.images.name}", one.camera.table) for one in others if one.images.target == target]
        points_out = left_out_points([(" of the first camera" if same else "", fit.table), *same], target)
        against += points_out.problems
    metric = metric_of(target, problem.arm_m, problem.beside)
    shared = shares(fit, near)
    rests = rests_on(fit, doubted, near, in_view)
    body = fit.table.places > 0  # fixed cameras and a body are there for the arm, wherever they stand
    doubtful = in_doubt(fit, doubted, target.scale)
    doubtful += () if rests is None else (rests.sentence(in_view.nominal_interval[0], body),)
    judged = alone if body else in_view
    size = size_open(target, doubted, judged, shared, problem.arm_m)
    grounds = Grounds(bool(metric), against, problem.arm_m, doubtful, size, body)
    decision = decide(judged, grounds)
    # the size decides: what is said holds either way
    if metric and decision.word == CANNOT_TELL and target.scale.measured:
        in_view, anywhere, alone = (error.either_way(SIZE) for error in (in_view, anywhere, alone))
        decision = decide(alone if body else in_view, grounds)
    other_length = problem.arm_m is not None or (problem.beside is not None and problem.beside.metric)
    return CameraSolution(
        *(fit, geometric, nominal, ready.mounting, ready.lens_fit, target, ready.left_out, fit.table.left_out),
        *(in_view, anywhere, decision, None if change is None or change.each else change),
        weak_directions(fit, ready.mounting),
        shared,
        held_out(fit, nominal),
        metric,
        findings(fit, target.scale, other_length, near),
        causes,
        left,
        rests_on=rests,
        further=tuple(one.seen_by(fit) for one in others),
        hidden=hidden_springs(fit) if problem.look_for_effects else (),
        alone=alone,
        open_points=points_out.open,
    )


def _nearest(fit: CameraFit) -> Model:
    """The model of a fit, with the least change to the drawing that gives its kinematics."""
    return least_change(fit.poses.model_at(fit.state.values), fit.poses.model.chain)


def _without_far(fit: CameraFit, ready: PreparedImages) -> CameraFit:
    """The fit without readings of other instruments that are nowhere near the arm."""
    for _ in range(_CLEANED):
        beside, rows = fit.poses.beside, fit.equations.beside
        if beside is None or rows is None:
            break
        far = beside.far(rows, fit.sizes.other)
        if not far.any() or (~far).sum() < MIN:
            break
        poses = replace(fit.poses, beside=replace(beside, samples=beside.samples.select(~far)))
        fit = fit_camera(fit.table, poses, ready.prior, ready.lens_fit.lens, fit.sizes)
    return fit
