"""The main path from corners and joints to a calibrated arm, and what it is worth in millimetres.

Lens by homographies, the target's pose in each image, mounting and places in closed form, then one fit of everything;
the same with the nominal arm, to compare with; what was moved, what fits nothing, what the images leave open.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Model, least_change
from modcal_core.camera.arm_poses import NOTHING_KNOWN, ArmPoses, FurtherCamera, ImageMoments, arm_size
from modcal_core.camera.bundle import BoardView, CalibrationTarget, MarkerBundle
from modcal_core.camera.causes import CameraCause, HiddenSpring, find_causes, hidden_springs
from modcal_core.camera.contradicted import SIZE, CameraFinding, contradictions, doubts, findings, in_doubt
from modcal_core.camera.corners import (
    BOW,
    COMMON,
    FREE,
    READOUT,
    SCALE,
    CameraState,
    CommonPrior,
    LeftOutPoints,
    left_out_points,
)
from modcal_core.camera.equations import numbered
from modcal_core.camera.fit import CameraFit, fit_camera, missed_pixels
from modcal_core.camera.intrinsics import LensFit
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import Mounting, held_out
from modcal_core.camera.other_readings import MIN, ReadingsBeside
from modcal_core.camera.prepared import CameraImages, PreparedImages, first_fit, prepare_images
from modcal_core.camera.problems import (
    CANNOT_TELL,
    MANY_OUT,
    Decision,
    MovedHalf,
    decide,
    metric_of,
    moved_sentence,
    problems,
    size_open,
    what_changed,
)
from modcal_core.camera.tool_error import (
    RestsOn,
    ToolError,
    parameter_draws,
    postures_anywhere,
    postures_in_view,
    rests_on,
    shares,
    tool_error,
    weak_directions,
)
from modcal_core.diagnosis import EffectChoice
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.robots import Chain, Inertias


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
    stops = numbered(
        [one.q for one in cameras],
        [[v.name for v in one.views] for one in cameras],
        [one.moments.stamps for one in cameras],
    )
    return [replace(one, moments=replace(one.moments, stop=stop)) for one, stop in zip(cameras, stops, strict=True)]


@dataclass(frozen=True)
class FurtherSeen:
    """A further camera after the fit of all. std: of lens, shape, readout and places, those of the first camera as in
    its fit, (15 + Z,). given: images in which the target was found. rms_px: of its corners.
    """

    name: str
    mounting: Mounting
    target: CalibrationTarget
    state: CameraState
    std: Array
    given: int
    used: int
    left_out: dict[str, str]
    rms_px: float


@dataclass(frozen=True)
class _Further:
    """camera: for the fit of all. problems: what its own images contradict, in sentences."""

    camera: FurtherCamera
    images: CameraImages
    ready: PreparedImages
    problems: tuple[str, ...]

    def seen_by(self, fit: CameraFit) -> FurtherSeen:
        """What the fit of all makes of it."""
        camera, first, state = next(one for one in fit.poses.further_at(fit.state) if one[0].name == self.camera.name)
        columns = camera.columns(fit.poses, first)[len(state.values) + 1 :]
        std = np.where(columns >= 0, np.sqrt(np.diag(fit.covariance))[columns], 0.0)
        gap = missed_pixels(camera.table, camera.poses.with_effects(fit.poses.model.effects), state)
        images, ready = self.images, self.ready
        return FurtherSeen(
            *(images.name, ready.mounting, images.target, state, std, len(images.views)),
            *(camera.table.views, ready.left_out, camera.table.rms(gap)),
        )


def further_of(
    chain: Chain,
    images: CameraImages,
    first: CameraImages,
    of_first: PreparedImages,
    fixed: Sequence[str],
    inertias: Inertias | None,
    arm: float | None,
) -> _Further:
    """A further camera, from a fit of its own. first, of_first: the first camera. arm: as of a fit.

    Raises ModcalError for images that cannot carry a fit by themselves.
    """
    if images.name == first.name:
        raise BadRecording(images.name, "is given twice", "give each camera once")
    ready = prepare_images(chain, images, fixed, inertias)
    fit, ready = first_fit(ready, arm)
    same_side = ready.mounting.camera_on_tip == of_first.mounting.camera_on_tip
    out = []
    if not fit.converged:
        out.append(f"The fit of {images.name} by itself did not reach its minimum.")
    moved, focus = what_changed(fit, arm)
    if moved is not None:
        out.append(moved_sentence(fit, moved, f" of {images.name}"))
    if focus is not None:
        out.append(f"{images.name}: {focus.sentence}")
    if len(ready.left_out) > MANY_OUT * len(images.views):
        out.append(f"{len(ready.left_out)} of {len(images.views)} images of {images.name} were left out.")
    same_target = images.target == first.target
    shared = np.zeros(len(fit.prior.mean), bool)
    shared[SCALE] = same_target
    shared[BOW] = same_target and same_side
    shared[COMMON:] = same_target and same_side  # two bodies of one drawing have markers glued each by itself
    moving = bool(fit.equations.free[fit.poses.count])
    prior = replace(fit.prior, free=fit.prior.free & (moving | (np.arange(len(shared)) != READOUT)))
    camera = FurtherCamera(images.name, fit.table, fit.poses, prior, fit.state, shared, moving)
    return _Further(camera, images, ready, tuple(out))


_CLEANED = 3  # times that other instruments' readings are looked through for those far off


@dataclass(frozen=True)
class CameraSolution:
    """fit: of everything. geometric: the same without effects. nominal: the same images, the nominal arm. mounting:
    found first. lens_fit: from the images alone. left_out: images by reason. corners_out: share of corners left out.
    in_view, anywhere: error at the tool over the joint ranges of the images where the target is in view, and over all
    joint limits. decision: of the former. moved: what was moved between images. weak: sentences. shares: of tool_error.
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
    moved: MovedHalf | None
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
    chain: Chain,
    q: Array,
    views: Sequence[BoardView],
    target: CalibrationTarget,
    size: tuple[int, int],
    rng: np.random.Generator,
    velocity: Array | None = None,
    lens: Lens | None = None,
    stated: str = FREE,
    arm_m: float | None = None,
    camera_on_tip: bool | None = None,
    flat: bool = False,
    fixed: Sequence[str] = (),
    progress: Callable[[str], None] = lambda _: None,
    moments: ImageMoments = NOTHING_KNOWN,
    inertias: Inertias | None = None,
    beside: ReadingsBeside | None = None,
    look_for_effects: bool = True,
    fisheye: bool = False,
    further: Sequence[CameraImages] = (),
) -> CameraSolution:
    """The calibration of an arm from views of a target at joint positions q (N, n).

    size: of the images [px]. velocity: of the joints at the images, (N, n); None: it stood. lens: as stated, with what
    becomes of it: free (a start), tolerance, fixed; None: found from the images. arm_m: RMS error of the nominal arm
    [m], as stated. camera_on_tip: the mounting where it is stated. flat: the sheet is known to be flat. fixed:
    parameters that stay as they are. moments, inertias: for effects. beside: readings of other instruments.
    fisheye: whether the lens is one, where nothing is stated of it. further: what other cameras saw of the same arm;
    the error at the tool is over what the first one sees. Raises ModcalError for images that cannot carry a fit.
    """
    images = CameraImages(*(q, views, target, size, velocity, lens, stated, camera_on_tip, flat, moments, fisheye))
    images, *further = with_stops(only_seen((images, *further)))
    target = images.target
    ready = prepare_images(chain, images, fixed, inertias, progress)

    progress("fit")
    size_of_arm = None if arm_m is None else arm_size(ready.poses, arm_m, ready.poses.q)
    others = [further_of(chain, one, images, ready, fixed, inertias, size_of_arm) for one in further]
    poses = replace(ready.poses, beside=beside, further=tuple(one.camera for one in others))
    fit, ready = first_fit(replace(ready, poses=poses), size_of_arm)
    table, lens_fit, mounting, left_out = ready.table, ready.lens_fit, ready.mounting, ready.left_out
    fit, arm = _without_far(fit, ready.poses, lens_fit.lens, ready.prior, size_of_arm)
    still = replace(arm, parameters=ready.placed, further=(), faults=None)
    nominal = fit_camera(table, still, lens_fit.lens, ready.prior)

    geometric = fit
    causes: tuple[CameraCause, ...] = ()
    left: EffectChoice | None = None
    if look_for_effects:
        progress("effects")
        fit, causes, left = find_causes(fit, rng, size_of_arm, progress)

    progress("verdict")
    moved, focus = what_changed(fit, size_of_arm)
    near, _ = postures_in_view(fit, rng)
    used_lens = lens or lens_fit.lens
    doubted = doubts(fit, used_lens, stated if lens is not None and stated != FREE else None, target.scale, size_of_arm)
    draws = parameter_draws(fit, rng, doubted)
    in_view = tool_error(fit, nominal, near, draws)
    anywhere = tool_error(fit, nominal, postures_anywhere(chain, rng), draws, both_ends=True)
    alone = tool_error(fit, nominal, near, draws, arm_alone=True)
    corners_out = 1.0 - float(table.weight.mean())
    metric = metric_of(target, arm_m, beside)
    other_length = arm_m is not None or (beside is not None and beside.metric)
    wrong = contradictions(fit, doubted, used_lens, target.scale, size_of_arm)
    against = problems(fit, nominal, moved, wrong, left_out, len(views), corners_out, target, focus)
    against += tuple(said for one in others for said in one.problems)
    points_out = LeftOutPoints()
    if isinstance(target, MarkerBundle):
        same = [(f" of {one.images.name}", one.camera.table) for one in others if one.images.target == target]
        points_out = left_out_points([(" of the first camera" if same else "", table), *same], target)
        against += points_out.problems
    shared = shares(fit, near)
    rests = rests_on(fit, doubted, near, in_view)
    doubtful = in_doubt(fit, doubted, target.scale)
    doubtful += () if rests is None else (rests.sentence(in_view.nominal_interval[0], table.places > 0),)
    body = table.places > 0  # fixed cameras and a body are there for the arm, wherever they stand
    judged = alone if body else in_view
    open_size = size_open(target, doubted, judged, shared, arm_m)
    decision = decide(judged, bool(metric), against, arm_m, doubtful, open_size, body)
    # the size decides: what is said holds either way
    if metric and decision.word == CANNOT_TELL and target.scale.measured:
        in_view, anywhere, alone = (error.either_way(SIZE) for error in (in_view, anywhere, alone))
        decision = decide(alone if body else in_view, True, against, arm_m, doubtful, open_size, body)
    return CameraSolution(
        *(fit, geometric, nominal, mounting, lens_fit, target, left_out, corners_out),
        *(in_view, anywhere, decision, moved),
        weak_directions(fit, mounting),
        shared,
        held_out(fit, nominal, size_of_arm),
        metric,
        findings(fit, target.scale, other_length, near, size_of_arm),
        causes,
        left,
        rests_on=rests,
        further=tuple(one.seen_by(fit) for one in others),
        hidden=hidden_springs(fit) if look_for_effects else (),
        alone=alone,
        open_points=points_out.open,
    )


def _nearest(fit: CameraFit) -> Model:
    """The model of a fit, with the least change to the drawing that gives its kinematics."""
    return least_change(fit.poses.model_at(fit.state.values), fit.poses.model.chain)


def _without_far(
    fit: CameraFit, arm: ArmPoses, lens: Lens, prior: CommonPrior, size: float | None
) -> tuple[CameraFit, ArmPoses]:
    """The fit, and what it was made from, without readings of other instruments that are nowhere near the arm."""
    for _ in range(_CLEANED):
        rows = fit.equations.beside
        if arm.beside is None or rows is None:
            break
        far = arm.beside.far(rows, fit.sizes.other)
        if not far.any() or (~far).sum() < MIN:
            break
        kept = replace(arm.beside, samples=arm.beside.samples.select(~far))
        arm = replace(arm, beside=kept)
        fit = fit_camera(fit.table, arm, lens, prior, fit.sizes, arm=size)
    return fit, arm
