"""A camera fit in sentences: what contradicts it, what is in doubt, and what the images leave open."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from modcal_core.camera.bundle import CalibrationTarget, MarkerBundle, PrintedTarget
from modcal_core.camera.claim import APPLY, DecisionGrounds, ToolError, decide
from modcal_core.camera.corners import CornerTable
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.mounting import Mounting
from modcal_core.camera.other_readings import ReadingsBeside
from modcal_core.camera.prepared import MOSTLY
from modcal_core.camera.statements import SIZE, DoubtedStatement
from modcal_core.camera.views import ViewSpread

_MANY_OUT = 0.05  # share of images left out beyond which a verdict is open (verdict.md)
_CORNERS_OUT = 0.05  # share of corners left out beyond which the target is another
_UNSTEADY = 2e-3  # rad (or m) a joint, or m, that an image differs from the fit: ten times what gears and springs do
_MOSTLY = 0.5  # of the mean square error at the tool
_UNMEASURED = {
    "sheet": "measured: measure its rulers (modcal target --measured)",
    "body": "stated: measure across it with a calliper and state size_tolerance",
}
_UNSAID = "read both rulers again, and state how well (--measured-to-mm)"
_NOMINAL = (
    "both rulers are stated at their nominal lengths, as by somebody who has not measured them: measure them, and "
    "state how well (--measured-to-mm)"
)


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
    if not fit.table.places and fit.table.left_out > _CORNERS_OUT:
        out.append(f"{100.0 * fit.table.left_out:.0f} % of all corners fit no flat target of the stated form.")
    return tuple(out)


def left_out_images(left_out: Collection[str], count: int, whose: str = "") -> tuple[str, ...]:
    """Sentence that more images than a verdict passes over were left out of so many; nothing where that is not so."""
    said = f"{len(left_out)} of {count} images{whose} were left out."
    return (said,) if len(left_out) > _MANY_OUT * count else ()


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
        return said if known < _MOSTLY * whole else ""
    if max(doubted, key=lambda d: d.counted).what != SIZE:
        return ""
    if decide(error.as_stated, DecisionGrounds(stated_m=arm_m)).word != APPLY:
        return ""
    again = _NOMINAL if scale.nominal else _UNSAID if scale.unsaid else f"measure the {what} again"
    return (
        f"If the {what} has the size that is stated, it is clearly better; these images leave that open: "
        f"{again}, or add a length of another kind, such as a few tracker points."
    )


_SIGHTINGS = 8  # images of a marker, for most of them to say something of the marker
_PASSED = 0.05  # share of points left out that a verdict passes over (verdict.md)
# Share beyond which what is left is no majority to rely on: where a fifth of markers is misread, every second image
# that shows three has a misread one among them.
_TOO_MANY = 0.2
_NAMED = 3  # markers in a sentence


def left_out_points(
    cameras: Sequence[tuple[str, CornerTable]], target: MarkerBundle
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(what speaks against the fit, what a verdict may not pass over though the fit stands) of points of a body that
    were left out. A marker most of whose points are out speaks against it only where that is more than others outvote.

    cameras: (what a sentence calls it, corners, weight 0 where they are left out), of each that sees this body.
    """
    against, open_ = [], []
    for name, table in cameras:
        out = table.weight == 0.0
        every = [table.marker == k for k in range(table.markers)]
        seen = [k for k, own in enumerate(every) if len(np.unique(table.view[own])) >= _SIGHTINGS]
        strange = [k for k in seen if float(out[every[k]].mean()) > MOSTLY]  # in images enough to say so
        if strange:
            named = ", ".join(target.markers[k].label for k in strange[:_NAMED])
            more = f" and {len(strange) - _NAMED} more" if len(strange) > _NAMED else ""
            open_.append(
                f"Most points of {named}{more}{name} are nowhere near their place, and are left out: check number, "
                "place and corner_order in the target file, and whether it came loose."
            )
        rest = ~np.isin(table.marker, strange)
        share = float(out[rest].mean()) if rest.any() else 0.0
        if max(share, len(strange) / max(table.markers, 1)) > _TOO_MANY:
            against.append(f"{100.0 * float(out.mean()):.0f} % of all points{name} fit no body of the stated form.")
        elif share > _PASSED:
            open_.append(
                f"{100.0 * share:.0f} % of the points{name} are misread, spread over markers and images, and left out."
            )
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
