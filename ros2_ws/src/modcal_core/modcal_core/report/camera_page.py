"""The page of a calibration by camera: the advice, the error at the tool in millimetres, what was found, the robot.

Its certificate is the usual one, judged by the error at the tool with the target in view: PASS where the upper end of
its 95 % interval is within the tolerance, a length was measured or stated, and nothing contradicts the fit. It always
has reservations: it is the figure of a fit, with no station that the fit has not seen but by its own interval.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from modcal_core.calibration import Model
from modcal_core.camera import CameraFit, CameraSolution, ToolError, view_distances
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.outcome import Trace, counted
from modcal_core.report.blocks import (
    Figures,
    Fold,
    Page,
    Section,
    SummaryLine,
    TableBlock,
    VerbResult,
    parameter_tables,
    quantity_tables,
    size_tables,
    tone_of,
)
from modcal_core.report.certificates import MAX_REASONS, Certificate, Hashes, box_in_words
from modcal_core.report.charts import AFTER, Axis, Chart, Panel
from modcal_core.report.figures import ShownPostures
from modcal_core.report.particulars import Particulars
from modcal_core.robots import chain_forward
from modcal_core.verdict import Asked, Tolerance

_PLACES = {
    "in_view": "where the target is in view",
    "arm_alone": "there, the arm by itself",
    "anywhere": "anywhere within the joint limits",
}


def camera_page(
    data: Mapping[str, Any], model: Model, q: Array, files: Mapping[str, str], charts: Sequence[Chart] = ()
) -> VerbResult:
    """The report. data: of ``report.json``. model: the calibrated one. q: the postures of the images (N, n) [rad, m].

    charts: of :func:`camera_charts`.
    """
    camera, met = data["camera"], data["tolerance"]
    alt = f"The arm in the postures of {counted(len(q), 'image')}."
    blocks = [
        Section("found", "What was found", _tables(data)),
        Section("robot", "Robot", [ShownPostures(model.serial, q, "Image").scene(alt)]) if len(q) else None,
        Section("images", "Images", [Figures(charts)]),
        Fold("Expert: all parameters", _parameters(data), "expert"),
    ]
    said = [SummaryLine(f"{met['result']}: {met['because']}", tone_of(met["result"]))] if met else []
    title, decision = f"{data['trace']['robot'] or 'arm'}: calibration by camera", camera["decision"]
    answer, tone = " ".join(camera["because"]), tone_of(decision)
    lines: list[str | SummaryLine] = [*said, *camera_sentences(data)]
    page = Page(title, answer, blocks, decision, tone, lines=lines, said=f"{decision.upper()}: {answer}")
    return page.result(data, files)


def camera_sentences(data: Mapping[str, Any]) -> list[str]:
    """What was seen, how far the tool is off, and what was found, for the page and a terminal."""
    camera = data["camera"]
    where = "on the tip, the target stands still" if camera["mounting"] == "tip" else "beside the arm, the target moves"
    px = {name: "not known" if x is None else f"{x:.2f} px" for name, x in camera["held_out_px"].items()}
    out = [f"The camera is {where}. {_seen(camera)}, {camera['corners']['used']} corners."]
    out += [f"Also {one['name']}, on the {one['mounting']}: {_seen(one)}." for one in camera.get("further", ())]
    for words, sizes in _tool_errors(data):
        ours, nominal = (
            f"{size['rms']:.2f} mm RMS (95 %: {size['low95']:.2f} to {size['high95']:.2f})"
            for size in (sizes["calibrated"], sizes["nominal"])
        )
        out.append(f"Error at the tool, {words}: {ours}; nominal arm {nominal}.")
    out.append(
        f"Held-out images: {px['nominal']} with the nominal arm, {px['calibrated']} with the calibrated one. "
        "Pixels are no accuracy: an arm can get worse while its pixels get better."
    )
    if moved := camera["moved"]:
        out.append(
            f"The {moved['what']} was moved before {moved['before_image']}, by {moved['shift_mm']:.2f} mm and "
            f"{moved['turn_deg']:.2f}°."
        )
    out += [f"Left out: {name}: {why}." for name, why in camera["images"]["left_out"].items()]
    return [*out, *data["notes"]]


def _seen(camera: Mapping[str, Any]) -> str:
    images = camera["images"]
    used = f"{images['used']} of {counted(images['given'], 'image')}"
    return f"{camera['target']}, {used}, {camera['rms_px']:.2f} px RMS"


def _tool_errors(data: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Where the error at the tool is known, in words, and its sizes [mm] of both arms."""
    sizes = data["camera"]["tool_error_mm"]
    return [(words, sizes[place]) for place, words in _PLACES.items() if sizes.get(place)]


_PIXELS = ("fx", "fy", "cx", "cy")
_OF_LENS = {"In px": "Lens, px", "Numbers without a unit": "Distortion of the lens"}


def _tables(data: Mapping[str, Any]) -> list[TableBlock]:
    """The error at the tool first, then effects, the lens, and the sheet; a table has one unit."""
    camera = data["camera"]
    rows = [
        (f"{arm} arm, {words}", f"{(e := sizes[arm])['rms']:.2f}", f"{e['low95']:.2f} … {e['high95']:.2f}")
        for words, sizes in _tool_errors(data)
        for arm in ("nominal", "calibrated")
    ]
    found = tuple(
        (
            *(f"{e['family'].replace('_', ' ')} at {e['place']}, {e['direction']}", e["driver"].replace(":", " of ")),
            *(f"{e['rms_mm_at_tool']:.3f}", f"{e['p_value']:.1g}"),
        )
        for e in data["effects"]
    )
    worth = tuple((one["what"], f"{one['value']:.3f}") for one in camera["account_mm2"])
    body = camera["body"] or {"markers": ()}
    markers = tuple(
        (f"{m['id']}", f"{np.linalg.norm(m['offset_mm']):.2f}", f"{m['std_mm']:.2f}") for m in body["markers"]
    )
    chance = "p is the chance that noise would look as good."
    falls = "By how much the mean square error at the tool would fall, were this known exactly."
    off = ("marker", "from its place on the drawing, mm", "± one standard deviation, mm")
    lens = [(k, v["value"], v["std"], "px" if k in _PIXELS else "1") for k, v in camera["lens"].items()]
    tables = [
        TableBlock("Error at the tool, mm", ("arm", "RMS, mm", "95 % interval, mm"), tuple(rows)),
        TableBlock("Unmodelled effects", ("effect", "driver", "moves the tool by, mm", "p"), found, 2, chance),
        *size_tables(data["effects"]),
        TableBlock("What knowing more would be worth, mm²", ("known", "mm²"), worth, below=falls),
        TableBlock("Markers on the body, mm", off, markers),
        *(replace(t, title=_OF_LENS.get(t.title, t.title)) for t in quantity_tables(lens, "constant")),
    ]
    return [replace(table, heading=True) for table in tables]


def _parameters(data: Mapping[str, Any]) -> list[Fold]:
    """All of the arm, the tool and the target, a table for each unit."""
    out = parameter_tables((p["name"], p["value"], p["std"], p["unit"]) for p in data["parameters"])
    if sheet := data["camera"]["sheet"]:
        rows = [(name, s["value"], s["std"], "1") for name, s in sheet.items()]
        out.append(Fold("The sheet, in SI units", quantity_tables(rows, "constant")))
    return out


_DRAWN = 4000  # corners in a picture; more only make the page heavy


def camera_charts(fit: CameraFit) -> list[Chart]:
    """Coverage of the image by corners, and the distance of each image's target from where the arm has it."""
    used = np.flatnonzero(fit.table.weight > 0.0)
    rows = used[spread_rows(len(used), _DRAWN)]
    w, h = fit.state.lens.size
    covered = Panel(Axis("u, px", 0.0, float(w)), Axis("−v, px", -float(h), 0.0))
    covered.marks(fit.table.pixels[rows, 0], -fit.table.pixels[rows, 1], AFTER)
    off = np.sqrt(view_distances(fit)[0] / 6.0)
    apart = Panel(Axis("image", 0.0, len(off) + 1.0), Axis("distance, σ", 0.0, 1.1 * max(float(off.max()), 2.0)))
    apart.marks(np.arange(1.0, len(off) + 1.0), off, AFTER)
    corners = "where corners were in the images: the lens is known where they are"
    far = "how far each image's target is from where the arm has it; one is usual"
    return [
        covered.chart("covered", "Where corners were in the images.", corners),
        apart.chart("apart", "How far each image is from where the arm has its target.", far),
    ]


_SILENT_ON = (
    "Postures at which the camera does not see the target: report.json has the error anywhere within the joint limits.",
    "Other loads and temperatures than those at the images, paths between postures, and single postures: the RMS is "
    "judged, and one of them may be off by more.",
    "What lasts: modcal evaluate judges a later recording of another instrument. calibrated.urdf and kinematics.yaml "
    "hold the geometry alone.",
    "Results of a test by ISO 9283.",
)


def camera_tolerance(solution: CameraSolution, tolerance_mm: float) -> Tolerance:
    """Whether the calibrated arm stays within a tolerance, RMS at the tool where the target is in view, with a body the
    arm by itself.
    """
    middle, low, high = (1e3 * end for end in solution.judged.interval)
    claim, limit = solution.claim, f"{tolerance_mm:g} mm"
    no_length = [] if claim.metric else ["Nothing in these images has a length that somebody measured."]
    against = [*claim.decision.problems, *no_length, *claim.decision.doubtful]
    result: Literal["PASS", "FAIL", "CANNOT TELL"] = "CANNOT TELL"
    if low > tolerance_mm:
        result = "FAIL"
        said = f"The RMS is {middle:.3f} mm, and at least {low:.3f} mm with 95 % confidence: more than {limit}."
    elif against:
        said = against[0]
    elif high > tolerance_mm:
        said = f"The RMS is {middle:.3f} mm, but may be up to {high:.3f} mm: more and better images would tell."
    else:
        result = "PASS"
        said = f"The RMS is {middle:.3f} mm, and at most {high:.3f} mm with 95 % confidence: within {limit}."
    return Tolerance(Asked(tolerance_mm, "rms"), middle, (low, high), result, said)


def camera_certificate(
    solution: CameraSolution, robot: str, met: Tolerance, said: Particulars, hashes: Hashes, images: int
) -> Certificate:
    """The certificate. met: of :func:`camera_tolerance`. images: how many there were."""
    fit, claim = solution.fit, solution.claim
    if met.result != "PASS":
        doubts = [said for said in claim.decision.because if said != met.because]
    else:
        doubts = [
            "The figure is that of a fit to these images, with the interval that they leave: the floor of arm and "
            "camera is not known.",
            *claim.decision.because[1:],
            *([f"{images - fit.table.views} of {images} images were left out."] if images > fit.table.views else []),
        ]
    flange = chain_forward(fit.poses.model_at(fit.state.values).serial, fit.poses.q)
    where = "by itself" if solution.judged is claim.alone else "in view"
    facts = (
        ("Robot", said.robot or robot or None),
        ("Serial number", said.serial or None),
        ("Date of the recording", None),
        ("Images", f"{fit.table.views} of {images}, {int(fit.table.weight.sum())} corners, {fit.rms_px[0]:.2f} px RMS"),
        ("Instrument", said.instrument or f"camera of {fit.state.lens.size[0]} × {fit.state.lens.size[1]} pixels"),
        ("Target", f"{solution.camera.given.target.label}; {solution.camera.mounting.label}"),
        ("Its lengths by", "; ".join(claim.metric) or "nothing"),
        (f"Nominal arm, {where}", _size(solution.judged, calibrated=False)),
        (f"Calibrated arm, {where}", _size(solution.judged)),
        ("Anywhere", _size(claim.anywhere)),
        ("Advice", claim.decision.word),
        ("Volume", box_in_words(flange[:, :3, 3])),
        ("Conditions", said.conditions or None),
        ("Program", f"modcal {Trace().version}"),
    )
    return Certificate(
        title="Accuracy certificate: calibration by camera",
        met=met,
        reservations=tuple(doubts[:MAX_REASONS]),
        before=1e3 * solution.judged.nominal_interval[0],
        facts=facts,
        silent_on=_SILENT_ON,
        hashes=hashes,
        said=said,
        recorded="images and joints",
    )


def _size(error: ToolError, calibrated: bool = True) -> str:
    middle, low, high = error.interval if calibrated else error.nominal_interval
    return f"{1e3 * middle:.2f} mm RMS (95 %: {1e3 * low:.2f} … {1e3 * high:.2f})"
