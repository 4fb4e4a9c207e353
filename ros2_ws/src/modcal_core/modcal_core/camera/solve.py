"""The main path from corners and joints to a calibrated arm, and what it is worth in millimetres.

Lens by homographies, the target's pose in each image, mounting and places in closed form, then one fit of everything;
the same with the nominal arm, to compare with; what was moved, what fits nothing, what the images leave open.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.canonical import least_change
from modcal_core.calibration.model import Model
from modcal_core.camera.arm_class import arm_size
from modcal_core.camera.arm_poses import ArmPoses, arm_poses
from modcal_core.camera.beside import LEAST, ReadingsBeside
from modcal_core.camera.causes import CameraCause, find_causes
from modcal_core.camera.changes import MovedHalf, moved_half
from modcal_core.camera.clean import bad_images, corner_weights, enough_corners, strangers
from modcal_core.camera.contradicted import SIZE, Doubt, contradictions, doubts, in_doubt, is_stated
from modcal_core.camera.corners import READOUT, SHAPE, CornerTable
from modcal_core.camera.decision import APPLY, Decision, decide
from modcal_core.camera.findings import CameraFinding, findings
from modcal_core.camera.fit import CameraFit, fit_camera, missed_pixels
from modcal_core.camera.intrinsics import LensFit, first_lens, fit_lens
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import FISHEYE, PINHOLE, Lens
from modcal_core.camera.moments import NOTHING_KNOWN, ImageMoments
from modcal_core.camera.mounting import LEAST_VIEWS, Mounting, find_mounting
from modcal_core.camera.pnp import board_poses
from modcal_core.camera.priors import FREE, CommonPrior, common_prior
from modcal_core.camera.target import PrintedTarget
from modcal_core.camera.tool_error import (
    ToolError,
    parameter_draws,
    postures_anywhere,
    postures_in_view,
    tool_error,
)
from modcal_core.camera.views import BoardView
from modcal_core.camera.weakness import RestsOn, rests_on, shares, weak_directions
from modcal_core.diagnosis.choice import EffectChoice
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import forward
from modcal_core.robots.urdf_inertias import Inertias

_HELD_OUT = 4  # every fourth image
_MANY_OUT = 0.05  # share of images left out beyond which a verdict is open (verdict.md)
_APART_OF_REACH = 0.03  # misfit of images and arm, as a share of the reach: no arm is built that badly
_CORNERS_OUT = 0.05  # share of corners left out beyond which the target is another
_CLEANED = 3  # times that other instruments' readings are looked through for those far off
_UNSTEADY = 2e-3  # rad (or m) a joint that an image differs from the fit: ten times what gears and springs do
_MOSTLY = 0.5  # of the mean square error at the tool
_SCALE_SIGMAS = 4.0  # by how many standard deviations the sheet's size may differ from what is stated of it


@dataclass(frozen=True)
class CameraSolution:
    """fit: of everything. geometric: the same without effects. nominal: the same images, the nominal arm. mounting:
    found first. lens_fit: from the images alone. left_out: images by reason. corners_out: share of corners left out.
    in_view, anywhere: error at the tool over the joint ranges of the images where the target is in view, and over all
    joint limits. decision: of the former. moved: what was moved between images. weak: sentences. shares: see weakness.
    held_out_px: (nominal, calibrated) RMS on images that neither fit has seen [px]. findings: what target and
    camera are not as stated. causes: effects beyond geometry.
    left: what is significant and could not be turned into one. notes: what was done to the images, in sentences.
    rests_on: what the sheet's stated size is worth, where the images do not show it.
    """

    fit: CameraFit
    geometric: CameraFit
    nominal: CameraFit
    mounting: Mounting
    lens_fit: LensFit
    target: PrintedTarget
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
    target: PrintedTarget,
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
) -> CameraSolution:
    """The calibration of an arm from views of a target at joint positions q (N, n).

    size: of the images [px]. velocity: of the joints at the images, (N, n); None: it stood. lens: as stated, with what
    becomes of it: free (a start), tolerance, fixed; None: found from the images. arm_m: RMS error of the nominal arm
    [m], as stated. camera_on_tip: the mounting where it is stated. flat: the sheet is known to be flat. fixed:
    parameters that stay as they are. moments, inertias: for effects. beside: readings of other instruments.
    fisheye: whether the lens is one, where nothing is stated of it. Raises ModcalError for images that cannot carry a
    fit.
    """
    velocity = np.zeros_like(q) if velocity is None else velocity
    keep = np.array([enough_corners(target.points[v.ids]) for v in views], dtype=bool)
    left_out = {v.name: "too few corners of the target" for v, k in zip(views, keep, strict=True) if not k}
    _require_views(int(keep.sum()))
    table = CornerTable.of([v for v, k in zip(views, keep, strict=True) if k], target)
    q, velocity, moments = q[keep], velocity[keep], moments.select(keep)

    progress("lens")
    model = FISHEYE if fisheye else PINHOLE
    prior = common_prior(
        lens or first_lens(table, size, model), target.scale, stated if lens is not None else None, flat
    )
    lens_fit, table = _lens(table, lens, prior, size, model)
    poses = board_poses(table, lens_fit.lens, prior.mean[LENS:READOUT])
    if (bad := bad_images(table, poses.rms)).any():
        left_out |= {n: "the target fits this image badly" for n, b in zip(table.names, bad, strict=True) if b}
        table, q, velocity, moments = table.select(~bad), q[~bad], velocity[~bad], moments.select(~bad)
        _require_views(table.views)
        lens_fit, table = _lens(table, lens, prior, size, model)
        poses = board_poses(table, lens_fit.lens, prior.mean[LENS:READOUT])

    progress("mounting")
    mounting = find_mounting(forward(chain, q), poses, camera_on_tip)
    if mounting.misfit_m > _APART_OF_REACH * max(chain.reach(), 0.3):
        said = f"they are {1e3 * mounting.misfit_m:.0f} mm off the arm's motion in the median"
        remedy = "check that each row of joints belongs to its image, joint units and order, and the square's size"
        raise BadRecording("images", said, remedy)

    progress("fit")
    start = (chain, q, velocity, mounting.T_frame_base, mounting.T_tip_tool, mounting.camera_on_tip, fixed)
    arm = replace(arm_poses(*start, moments=moments, inertias=inertias), beside=beside)
    size_of_arm = None if arm_m is None else arm_size(arm, arm_m, q)
    fit = fit_camera(table, arm, lens_fit.lens, prior, arm=size_of_arm)
    if (strange := strangers(fit)).any() and (~strange).sum() >= LEAST_VIEWS:
        left_out |= {n: "far from where the arm has it" for n, s in zip(table.names, strange, strict=True) if s}
        table, arm = table.select(~strange), arm.select(~strange)
        fit = fit_camera(table, arm, lens_fit.lens, prior, fit.sizes, arm=size_of_arm)
    fit, arm = _without_far(fit, arm, lens_fit.lens, prior, size_of_arm)
    still = replace(arm, parameters=arm_poses(*start, hand_eye_only=True).parameters, further=(), faults=None)
    nominal = fit_camera(table, still, lens_fit.lens, prior)

    geometric = fit
    causes: tuple[CameraCause, ...] = ()
    left: EffectChoice | None = None
    if look_for_effects:
        progress("effects")
        fit, causes, left = find_causes(fit, rng, size_of_arm, progress)

    progress("verdict")
    moved = moved_half(fit, size_of_arm)
    near, _ = postures_in_view(fit, rng)
    used_lens = lens or lens_fit.lens
    doubted = doubts(fit, used_lens, is_stated(lens, stated), size_of_arm)
    draws = parameter_draws(fit, rng, doubted)
    in_view = tool_error(fit, nominal, near, draws)
    anywhere = tool_error(fit, nominal, postures_anywhere(chain, rng), draws, both_ends=True)
    corners_out = 1.0 - float(table.weight.mean())
    metric = _metric(target, arm_m, beside)
    other_length = arm_m is not None or (beside is not None and beside.metric)
    wrong = contradictions(fit, doubted, used_lens, target.scale, size_of_arm)
    problems = _problems(fit, nominal, moved, wrong, left_out, len(views), corners_out, target)
    shared = shares(fit, near)
    rests = rests_on(fit, doubted, near, in_view)
    doubtful = in_doubt(fit, doubted, target.scale)
    doubtful += () if rests is None else (rests.sentence(in_view.nominal_interval[0]),)
    size_open = _size_open(target, doubted, in_view, shared, arm_m)
    decision = decide(in_view, bool(metric), problems, arm_m, doubtful, size_open)
    return CameraSolution(
        *(
            fit,
            geometric,
            nominal,
            mounting,
            lens_fit,
            target,
            left_out,
            corners_out,
            in_view,
            anywhere,
            decision,
            moved,
        ),
        weak_directions(fit, mounting),
        shared,
        _held_out(fit, nominal, size_of_arm),
        metric,
        findings(fit, target.scale, other_length, near, size_of_arm),
        causes,
        left,
        rests_on=rests,
    )


def _size_open(
    target: PrintedTarget,
    doubted: Sequence[Doubt],
    error: ToolError,
    shared: dict[str, tuple[float, float]],
    arm_m: float | None,
) -> str:
    """What to do about the sheet's size where it is what keeps the arm from being clearly better, else nothing."""
    if target.scale.measured:
        likeliest_doubt = max(doubted, key=lambda d: d.chance).what == SIZE
        if likeliest_doubt and decide(error.as_stated, True, (), arm_m).word == APPLY:
            return (
                "If the sheet has the size that is stated, it is clearly better; these images leave that open: measure "
                "the sheet again, or add a length of another kind, such as a few tracker points."
            )
        return ""
    whole, known = shared.get("print scale", (0.0, 0.0))
    if known < _MOSTLY * whole:
        return (
            f"Most of that is the sheet's size, which nobody has measured: measure its rulers (modcal target "
            f"--measured); with it, {1e3 * known**0.5:.2f} mm are left."
        )
    return ""


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
        if not far.any() or (~far).sum() < LEAST:
            break
        arm = replace(arm, beside=arm.beside.without(far))
        fit = fit_camera(fit.table, arm, lens, prior, fit.sizes, arm=size)
    return fit, arm


def _require_views(count: int) -> None:
    if count < LEAST_VIEWS:
        said = f"{count} show enough of the target, at least {LEAST_VIEWS} are needed"
        raise NotEnoughData("images", said, "take more images, the whole target sharp and in view")


def _lens(
    table: CornerTable, lens: Lens | None, prior: CommonPrior, size: tuple[int, int], model: str
) -> tuple[LensFit, CornerTable]:
    """The lens from the images alone, and the corners with those left out that fit no pose."""
    start = Lens(prior.mean[:LENS], size, model) if lens is None else lens
    information = prior.information[:LENS, :LENS]
    shape = np.zeros(SHAPE)
    for _ in range(3):
        fit = fit_lens(table, start, prior.free[:LENS], information)
        weight = corner_weights(table, fit.lens, shape, fit.T_camera_target)
        if (weight == table.weight).all():
            break
        table = table.with_weight(weight)
    return fit, table


def _metric(target: PrintedTarget, arm_m: float | None, beside: ReadingsBeside | None) -> tuple[str, ...]:
    """What has a length that somebody measured or states."""
    out = ["the sheet's rulers were measured"] if target.scale.measured else []
    if beside is not None and beside.metric:
        out.append(f"readings of {beside.label}")
    return (*out, "the arm's accuracy is stated") if arm_m is not None else tuple(out)


def _problems(
    fit: CameraFit,
    nominal: CameraFit,
    moved: MovedHalf | None,
    wrong: tuple[str, ...],
    left_out: dict[str, str],
    count: int,
    corners_out: float,
    target: PrintedTarget,
) -> tuple[str, ...]:
    """What contradicts the fit, in sentences."""
    out = []
    if not (fit.converged and nominal.converged):
        out.append("The fit did not reach its minimum.")
    if moved is not None:
        on_tip = fit.poses.camera_on_tip
        what = "target" if moved.in_world == on_tip else "camera"
        out.append(
            f"The {what} was moved before image {fit.table.names[moved.at]}, by {1e3 * moved.shift_m:.1f} mm and "
            f"{np.degrees(moved.turn_rad):.2f}°: calibrate from the images before, or from those after."
        )
    out += wrong
    if fit.sizes.joint > _UNSTEADY:
        out.append(
            f"Images are {1e3 * fit.sizes.joint:.1f} mrad a joint off any arm of this form, each by itself: check that "
            "the arm stood still, that joints and images are of the same moment, and that nothing is loose."
        )
    if len(left_out) > _MANY_OUT * count:
        out.append(f"{len(left_out)} of {count} images were left out.")
    if corners_out > _CORNERS_OUT:
        out.append(f"{100.0 * corners_out:.0f} % of all corners fit no flat target of the stated form.")
    P = fit.poses.count
    for i, axis in enumerate("" if wrong else "xy"):
        off = fit.state.shape[i] - (getattr(target.scale, axis) - 1.0)
        usual = np.hypot(target.scale.std, 0.5 * target.scale.std_apart)
        if abs(off) > _SCALE_SIGMAS * usual:
            std = float(np.sqrt(fit.covariance[P + 1 + LENS + i, P + 1 + LENS + i]))
            out.append(
                f"The sheet is {100.0 * off:+.1f} ± {100.0 * std:.1f} % off its stated size along {axis}: measure a "
                "square, and check the target file."
            )
    return tuple(out)


def _held_out(fit: CameraFit, nominal: CameraFit, arm: float | None) -> tuple[float, float]:
    """RMS of (nominal, calibrated) on every fourth image, fitted to the others at the same sizes [px]."""
    N = fit.table.views
    held = np.arange(N) % _HELD_OUT == _HELD_OUT - 1
    if held.sum() == 0 or (~held).sum() < LEAST_VIEWS:
        return float("nan"), float("nan")
    out = []
    for one, size in ((nominal, None), (fit, arm)):
        poses = one.poses.select(~held)
        table = one.table.select(~held)
        there = fit_camera(table, poses, one.state.lens, one.prior, one.sizes, size, fixed_sizes=True)
        out.append(_predicted_px(there, one.table.select(held), one.poses.select(held)))
    return out[0], out[1]


def _predicted_px(fit: CameraFit, table: CornerTable, poses: ArmPoses) -> float:
    gap = missed_pixels(table, poses, fit.state)
    return float(np.sqrt((table.weight @ (gap**2).sum(1)) / max(table.weight.sum(), 1.0)))
