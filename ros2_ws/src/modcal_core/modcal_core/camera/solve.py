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
from modcal_core.camera.bundle import CalibrationTarget, MarkerBundle, PrintedTarget
from modcal_core.camera.changes import CameraCause, Moved, find_causes, find_change, held_out
from modcal_core.camera.claim import (
    APPLY,
    Decision,
    RestsOn,
    ToolError,
    arm_draws,
    decide,
    no_length,
    rests_on,
    shares,
    tool_error,
)
from modcal_core.camera.corners import CornerTable
from modcal_core.camera.equations import MIN, ReadingsBeside
from modcal_core.camera.fit import Camera, CameraFit, CameraImages, Cameras, fit_cameras
from modcal_core.camera.mounting import Mounting
from modcal_core.camera.prepared import MOSTLY, first_fit, nominal, prepare_images, together
from modcal_core.camera.statements import (
    SIZE,
    CameraFinding,
    DoubtedStatement,
    contradictions,
    doubts,
    findings,
    in_doubt,
)
from modcal_core.camera.views import POSTURES, ViewSpread, postures_in_view
from modcal_core.diagnosis import EffectChoice
from modcal_core.errors import BadRecording
from modcal_core.robots import Chain, Inertias, random_postures

PASSED = 0.05  # share of images, corners or points left out that a verdict passes over (verdict.md)
_UNSTEADY = 2e-3  # rad (or m) a joint, or m, that an image differs from the fit: ten times what gears and springs do
_UNMEASURED = {
    "sheet": "measured: measure its rulers (modcal target --measured)",
    "body": "stated: measure across it with a calliper and state size_tolerance",
}
_UNSAID = "measure both rulers, and state how well (--measured-to-mm)"


def problems(fit: CameraFit, nominal: CameraFit, wrong: Sequence[str]) -> tuple[str, ...]:
    """What contradicts the fit, in sentences. wrong: moves among the images, and statements that these contradict."""
    out = [] if fit.converged and nominal.converged else ["The fit did not reach its minimum."]
    out += wrong
    if max(fit.sizes.joint, fit.sizes.shift) > _UNSTEADY:
        out.append(
            f"Images are {1e3 * fit.sizes.joint:.1f} mrad a joint and {1e3 * fit.sizes.shift:.1f} mm off any arm of "
            "this form, each by itself: check that the arm stood still, that joints and images are of the same moment, "
            "that autofocus and digital zoom are off, and that nothing is loose."
        )
    # of a body points are misread, and the places of its markers say what is wrong of its size
    if not fit.table.places and fit.table.left_out > PASSED:
        out.append(f"{100.0 * fit.table.left_out:.0f} % of all corners fit no flat target of the stated form.")
    return tuple(out)


def metric_of(target: CalibrationTarget, arm_m: float | None, beside: ReadingsBeside | None) -> tuple[str, ...]:
    """What has a length that somebody measured or states."""
    known = "the sheet's rulers were measured" if isinstance(target, PrintedTarget) else "the body's size is stated"
    out = [known] if target.scale.measured else []
    if beside is not None and beside.metric:
        out.append(f"readings of {beside.label}")
    return (*out, "the arm's accuracy is stated") if arm_m is not None else tuple(out)


def size_open(
    target: CalibrationTarget,
    doubted: Sequence[DoubtedStatement],
    error: ToolError,
    shared: dict[str, tuple[float, float]],
    arm_m: float | None,
) -> str:
    """What to do about the sheet's size where it is what keeps the arm from being clearly better, else nothing."""
    what, scale = "sheet" if isinstance(target, PrintedTarget) else "body", target.scale
    if not scale.measured:
        whole, known = shared.get("print scale", (0.0, 0.0))
        rest = f"; with it, {1e3 * known**0.5:.2f} mm are left."
        said = f"Most of that is the {what}'s size, which nobody has {_UNMEASURED[what]}{rest}"
        return said if known < MOSTLY * whole else ""
    if max(doubted, key=lambda d: d.chance).what != SIZE:
        return ""
    if decide(error.as_stated, arm_m).word != APPLY:
        return ""
    again = _UNSAID if scale.unsaid else f"measure the {what} again"
    return (
        f"If the {what} has the size that is stated, it is clearly better; these images leave that open: "
        f"{again}, or add a length of another kind, such as a few tracker points."
    )


_TOO_MANY = 0.2  # share beyond which what is left is no majority to rely on
_SIGHTINGS = 8  # points of a marker, for most of them to say something of it
_NAMED = 3  # markers in a sentence


def left_out_points(
    cameras: Sequence[tuple[str, CornerTable]], target: MarkerBundle
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(what speaks against the fit, what a verdict may not pass over though the fit stands) of points of a body that
    were left out, misread or of markers that are not where the file has them.

    cameras: (what a sentence calls it, corners, weight 0 where they are left out), of each that sees this body.
    """
    against, open_ = list[str](), list[str]()
    for name, table in cameras:
        seen, kept = (np.bincount(table.marker, part, table.markers) for part in (None, table.weight))
        strange = np.flatnonzero((kept < MOSTLY * seen) & (seen >= _SIGHTINGS))
        named = ", ".join(target.markers[k].label for k in strange[:_NAMED])
        said = f"{100.0 * table.left_out:.0f} % of the points{name} fit no body of the stated form, and are left out"
        if len(strange):
            said += (
                f", most of those of {named}{' and others' * (len(strange) > _NAMED)}: check number, place and "
                "corner_order in the target file, and whether it came loose"
            )
        if len(strange) or table.left_out > PASSED:
            (against if table.left_out > _TOO_MANY else open_).append(f"{said}.")
    return tuple(against), tuple(open_)


_JOINT, _SLIDE = np.radians(20.0), 0.05  # range of a joint that shows what its axis does, rad and m


def weak_directions(fit: CameraFit, mounting: Mounting) -> tuple[str, ...]:
    """What these images leave open, each with what to do, in sentences."""
    table, centre = fit.table, fit.table.points.mean(axis=0)
    out = ViewSpread.of(table, fit.state.lens.size, fit.poses.seen(fit.tool), centre).sentences(table.places > 0)
    if mounting.one_axis:
        turns = np.degrees(mounting.turns)
        out.append(
            f"The arm turned its tip about one axis only (RMS {turns[0]:.0f}°, across it {turns[1]:.1f}°): where "
            "camera and target are along this axis is open. Turn the wrist about a second axis."
        )
    chain = fit.poses.model.serial
    for name, span, turning in zip(chain.names, np.ptp(fit.poses.q, axis=0), chain.revolute, strict=True):
        if span < (_JOINT if turning else _SLIDE):
            moved = f"{np.degrees(span):.0f}°" if turning else f"{1e3 * span:.0f} mm"
            out.append(f"Joint {name} moved by {moved} only: its axis is known from the drawing.")
    return tuple(out)


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


@dataclass(frozen=True)
class CameraEvidence:
    """moved: what was moved between images, the camera's focal length included. findings: what target and camera are
    not as stated. causes: effects beyond geometry. left: what is significant and could not be turned into one. weak:
    what the images leave open, in sentences. open_points: what a verdict may not pass over, though the fit stands.
    """

    moved: Moved | None
    findings: tuple[CameraFinding, ...]
    causes: tuple[CameraCause, ...]
    left: EffectChoice | None
    weak: tuple[str, ...]
    open_points: tuple[str, ...]


@dataclass(frozen=True)
class CameraClaim:
    """in_view, anywhere: error at the tool over the joint ranges of the images where the target is in view, and over
    all joint limits. alone: as in_view, the frame put where it suits best. decision: of the one that counts. shares: of
    in_view, by what is not known exactly. rests_on: what the sheet's stated size is worth, where images do not show it.
    metric: what has a length. held_out_px: (nominal, calibrated) RMS on images that neither fit has seen [px].
    """

    in_view: ToolError
    anywhere: ToolError
    alone: ToolError
    decision: Decision
    shares: dict[str, tuple[float, float]]
    rests_on: RestsOn | None
    metric: tuple[str, ...]
    held_out_px: tuple[float, ...]


@dataclass(frozen=True)
class CameraSolution:
    """fit: of everything. geometric: the same without effects. nominal: of the first camera and the nominal arm. notes:
    what was done to the images, in sentences.
    """

    fit: CameraFit
    geometric: CameraFit
    nominal: CameraFit
    evidence: CameraEvidence
    claim: CameraClaim
    notes: tuple[str, ...] = ()

    @property
    def camera(self) -> Camera:
        """The first camera."""
        return self.fit.cameras.first

    @property
    def judged(self) -> ToolError:
        """The error that counts: in view; with a body the arm's by itself, wherever the fixed cameras stand."""
        return self.claim.alone if self.fit.table.places else self.claim.in_view

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
    progress("lens and mounting")
    geometric, by_itself = _fitted(problem, progress)
    first = geometric.cameras.first
    still = nominal(first)
    fit, causes, left = geometric, tuple[CameraCause, ...](), None
    if problem.look_for_effects:
        progress("effects")
        fit, causes, left = find_causes(geometric, progress)

    progress("verdict")
    near, doubted, target = postures_in_view(fit, rng), doubts(fit), first.given.target
    change, wrong = find_change(fit), list[str]()
    for k, camera in enumerate(fit.cameras.every):
        whose = f" of {camera.given.name}" if k else ""
        found = find_change(by_itself[k]) if k else change
        if found is not None:
            wrong.append(found.before(camera.table.names[int(found.since)], whose))
        out, count = len(camera.left_out), len(camera.given.views)
        if out > PASSED * count:  # more than a verdict passes over
            wrong.append(f"{out} of {count} images{whose} were left out.")
    against, open_points = problems(fit, still, (*wrong, *contradictions(fit, doubted))), tuple[str, ...]()
    body = isinstance(target, MarkerBundle)
    if isinstance(target, MarkerBundle):
        same = [one for one in fit.cameras.every if one.table.target == target]
        names = [" of the first camera" if len(same) > 1 else "", *(f" of {one.given.name}" for one in same[1:])]
        misread, open_points = left_out_points(list(zip(names, (one.table for one in same), strict=True)), target)
        against += misread
    metric = metric_of(target, problem.arm_m, problem.beside)
    defaults, weak = findings(fit, len(metric) > target.scale.measured, near), weak_directions(fit, first.mounting)
    draws, anywhere = arm_draws(fit, rng, doubted), random_postures(problem.chain, POSTURES, rng)
    in_view, alone = (tool_error(fit, still, near, draws, arm_alone) for arm_alone in (False, True))
    judged = alone if body else in_view  # fixed cameras and a body are there for the arm, wherever they stand
    doubtful, known, rests = in_doubt(doubted), shares(fit, near), rests_on(fit, doubted, near, in_view)
    if metric or against:
        said = () if rests is None else (rests.sentence(in_view.nominal_interval[0], body),)
        size = size_open(target, doubted, judged, known, problem.arm_m)
        decision = decide(judged, problem.arm_m, against, (*doubtful, *said), size, body)
    else:
        decision = no_length(judged, body)
    at = in_view, tool_error(fit, still, anywhere, draws), alone
    return CameraSolution(
        fit,
        geometric,
        still,
        CameraEvidence(change, defaults, causes, left, weak, open_points),
        CameraClaim(*at, replace(decision, doubtful=doubtful), known, rests, metric, held_out(still, fit)),
    )


def _fitted(problem: CameraProblem, progress: Callable[[str], None]) -> tuple[CameraFit, list[CameraFit]]:
    """(the fit of all, that of each camera by itself, without strange images, from which it begins)."""
    names = [one.name for one in problem.cameras]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise BadRecording(twice[0], "is given twice", "give each camera once")
    alone: list[CameraFit] = []
    for images in together(problem.cameras):
        camera = prepare_images(problem.chain, images, problem.fixed, problem.inertias, problem.arm_m)
        progress("fit")
        alone.append(first_fit(camera))
    if len(alone) == 1 and problem.beside is None:
        return alone[0], alone
    every = tuple(replace(fit.cameras.first, begin=fit.state) for fit in alone)
    return _without_far(fit_cameras(Cameras(every, problem.beside))), alone


def _nearest(fit: CameraFit) -> Model:
    """The model of a fit, with the least change to the drawing that gives its kinematics."""
    return least_change(fit.poses.model_at(fit.state.values), fit.poses.model.chain)


def _without_far(fit: CameraFit) -> CameraFit:
    """The fit without readings of other instruments that are nowhere near the arm."""
    for _ in range(_CLEANED):
        beside, rows = fit.cameras.beside, fit.equations.beside
        if beside is None or rows is None:
            break
        far = beside.far(rows, fit.sizes.other)
        if not far.any() or (~far).sum() < MIN:
            break
        beside = replace(beside, samples=beside.samples.select(~far))
        fit = fit_cameras(replace(fit.cameras, beside=beside), sizes=fit.sizes)
    return fit
