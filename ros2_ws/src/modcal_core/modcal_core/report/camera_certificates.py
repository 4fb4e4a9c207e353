"""The certificate of a calibration by camera: the same page, judged by the error at the tool with the target in view.

PASS where the upper end of its 95 % interval is within the tolerance, a length was measured or stated, and nothing
contradicts the fit. It always has reservations: it is the figure of a fit, with no station that the fit has not seen
but by its own interval.
"""

from __future__ import annotations

from modcal_core.camera import CameraSolution, ToolError
from modcal_core.errors import BadTable
from modcal_core.report.certificates import (
    MAX_REASONS,
    Certificate,
    Hashes,
    Particulars,
    Scale,
    Tone,
    box_in_words,
    listed,
)
from modcal_core.report.contents import Trace
from modcal_core.robots import chain_forward
from modcal_core.verdict import Asked, Tolerance

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
    asked = Asked(tolerance_mm, "rms")
    limit = f"{tolerance_mm:g} mm"
    if low > tolerance_mm:
        said = f"The RMS is {middle:.3f} mm, and at least {low:.3f} mm with 95 % confidence: more than {limit}."
        return Tolerance(asked, middle, (low, high), "FAIL", said)
    against = ""
    if solution.decision.problems:
        against = solution.decision.problems[0]
    elif not solution.metric:
        against = "Nothing in these images has a length that somebody measured."
    elif high > tolerance_mm:
        against = f"The RMS is {middle:.3f} mm, but may be up to {high:.3f} mm: more and better images would tell."
    if against:
        return Tolerance(asked, middle, (low, high), "CANNOT TELL", against)
    said = f"The RMS is {middle:.3f} mm, and at most {high:.3f} mm with 95 % confidence: within {limit}."
    return Tolerance(asked, middle, (low, high), "PASS", said)


def camera_certificate(
    solution: CameraSolution, robot: str, met: Tolerance | None, said: Particulars, hashes: Hashes, images: int
) -> Certificate:
    """The certificate. met: of :func:`camera_tolerance`. images: how many there were. Raises BadTable without met."""
    if met is None:
        raise BadTable("--certificate", "has no tolerance to judge by", "give --tolerance-mm, e.g. --tolerance-mm 2")
    doubts = tuple(said for said in solution.decision.because if said != met.because)[:MAX_REASONS]
    if met.result == "PASS":
        doubts = _reservations(solution, images)
    tones: dict[str, Tone] = {"PASS": "warn", "FAIL": "bad"}
    fit = solution.fit
    low, high = met.ci95
    before = 1e3 * solution.judged.nominal_interval[0]
    where = "by itself" if solution.judged is solution.alone else "in view"
    facts = (
        ("Robot", said.robot or robot or None),
        ("Serial number", said.serial or None),
        ("Date of the recording", None),
        ("Images", f"{fit.table.views} of {images}, {int(fit.table.weight.sum())} corners, {fit.rms_px:.2f} px RMS"),
        ("Instrument", said.instrument or f"camera of {fit.state.lens.size[0]} × {fit.state.lens.size[1]} pixels"),
        ("Target", f"{solution.target.label}; {solution.mounting.label}"),
        ("Its lengths by", "; ".join(solution.metric) or "nothing"),
        (f"Nominal arm, {where}", _size(solution.judged, calibrated=False)),
        (f"Calibrated arm, {where}", _size(solution.judged)),
        ("Anywhere", _size(solution.anywhere)),
        ("Advice", solution.decision.word),
        ("Volume", _volume(solution)),
        ("Conditions", said.conditions or None),
        ("Program", f"modcal {Trace().version}"),
    )
    return Certificate(
        title="Accuracy certificate: calibration by camera",
        result=met.result,
        heading="PASS, with reservations" if met.result == "PASS" else met.result,
        tone=tones.get(met.result, "warn"),
        because=met.because,
        reservations=doubts,
        scale=Scale(met.asked.mm, before, met.value_mm, low, high, 1.25 * max(met.asked.mm, high or 0.0)),
        facts=facts,
        errors=(),
        floor="not known",
        iso=(),
        silent_on=_SILENT_ON,
        hashes=listed(hashes, "images and joints"),
        signatures=(("Measured by", said.measured_by), ("Approved by", said.approved_by)),
    )


def _reservations(solution: CameraSolution, images: int) -> tuple[str, ...]:
    """Why a PASS is not one without reservations, as many as the page has room for."""
    out = [
        "The figure is that of a fit to these images, with the interval that they leave: the floor of arm and camera "
        "is not known.",
        *solution.decision.because[1:],
    ]
    if left := images - solution.fit.table.views:
        out.append(f"{left} of {images} images were left out.")
    return tuple(out[:MAX_REASONS])


def _size(error: ToolError, calibrated: bool = True) -> str:
    middle, low, high = error.interval if calibrated else error.nominal_interval
    return f"{1e3 * middle:.2f} mm RMS (95 %: {1e3 * low:.2f} … {1e3 * high:.2f})"


def _volume(solution: CameraSolution) -> str:
    """The box that the flange was in, in the arm's base [m]."""
    fit = solution.fit
    return box_in_words(chain_forward(fit.poses.model_at(fit.state.values).serial, fit.poses.q)[:, :3, 3])
