"""The certificate: one page that says what was measured, on which arm, with which result, and what it may not say.

The result is that of the tolerance, which the claim at the tool decides, never another. A PASS is without reservations
only where the verdict leaves no doubt: at the floor, the instrument's accuracy stated, nothing left out of the score.
That of a calibration by camera is judged by the error at the tool with the target in view, with a body by that of the
arm alone; it always has reservations, for no station is one that the fit has not seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.calibration import Stated
from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.outcome import Outcome, counted
from modcal_core.report.blocks import (
    Block,
    Figures,
    KeyFigures,
    Listing,
    Page,
    Section,
    SummaryLine,
    Tone,
    tone_of,
)
from modcal_core.report.charts import BAD, INK, Axis, Chart, Panel
from modcal_core.report.particulars import Particulars
from modcal_core.report.tables import STATISTICS, error_tables, floor_words, rejected_words
from modcal_core.robots import chain_forward
from modcal_core.verdict import Asked, AtTool, PoseTest, Tolerance, Verdict, assess, pose_test

if TYPE_CHECKING:
    from modcal_core.camera import CameraSolution

MAX_OF_TOLERANCE = 1.0 / 3.0  # that the instrument may be off by; ISO 10012 and ISO 14253-2 ask for 1/3 to 1/10
MAX_REASONS = 3  # that the page has room for; report.json has all of them
_STAGES = {"nominal": "before: nominal model", "final": "after: calibrated model"}


@dataclass(frozen=True)
class Hashes:
    """Which files the certificate is about: names and SHA-256 [hexadecimal] of recording, description, calibration."""

    recording: str | None = None
    description: str | None = None
    calibration: str | None = None


@dataclass(frozen=True)
class Certificate:
    """What the page says, in its order.

    met: the tolerance, and the result for it. reservations: what keeps a PASS from being one without, or reasons.
    before: the error of the nominal arm [mm]. facts: names and what is known, None where a line is left to be filled in
    by hand. sections: errors, and results by ISO 9283. silent_on: what the result does not say. said: who signs.
    recorded: what the recording is called.
    """

    title: str
    met: Tolerance
    reservations: tuple[str, ...]
    before: float | None
    facts: tuple[tuple[str, str | None], ...]
    silent_on: tuple[str, ...]
    hashes: Hashes
    said: Particulars
    sections: tuple[Section, ...] = ()
    recorded: str = "recording"

    @property
    def heading(self) -> str:
        """The result as it is shown."""
        return "PASS, with reservations" if self.met.result == "PASS" and self.reservations else self.met.result

    @property
    def tone(self) -> Tone:
        """The colour of the result."""
        return tone_of(self.heading)

    def html(self) -> str:
        """The page as HTML text."""
        of, names = self.hashes, (self.recorded, "robot description", "calibration.yaml")
        known = [pair for pair in zip(names, (of.recording, of.description, of.calibration), strict=True) if pair[1]]
        blocks: list[Block] = [
            Listing(self.reservations, self.tone, "Reservations" if self.met.result == "PASS" else "Reasons"),
            Figures([drawn(self.met, self.before, self.tone)]),
            KeyFigures(self.facts, "facts"),
            *self.sections,
            Section("silent", "What this certificate does not say", [Listing(self.silent_on)]),
            Section("hashes", "SHA-256", [KeyFigures(known, "facts hash")]),
            KeyFigures([("Measured by", self.said.measured_by), ("Approved by", self.said.approved_by)], "signs"),
        ]
        return Page(self.title, self.met.because, blocks, self.heading, self.tone, "certificate").html()


def certificate(
    report: Outcome,
    stated: Stated | None = None,
    particulars: Particulars | None = None,
    hashes: Hashes | None = None,
) -> Certificate:
    """The certificate of a report. Raises BadTable where no tolerance was asked for."""
    met, stated, said = report.tolerance, stated or Stated(), particulars or Particulars()
    hashes = hashes or Hashes()
    if met is None:
        raise BadTable("--certificate", "has no tolerance to judge by", "give --tolerance-mm, e.g. --tolerance-mm 0.2")
    doubts = _reservations(report, stated) if met.result == "PASS" else _reasons(report)
    tests = pose_test(report.scored, {k: report.errors[k] for k in ("nominal", "final")})
    return Certificate(
        title="Accuracy certificate: " + ("frozen calibration" if report.searched is None else "calibration"),
        met=met,
        reservations=doubts,
        before=_before(report, met),
        facts=_facts(report, stated, said),
        sections=(*_errors(report), Section("iso", "ISO 9283", [SummaryLine(said) for said in _iso(tests)])),
        silent_on=_silent_on(report, stated, tests),
        hashes=replace(hashes, recording=hashes.recording or report.trace.bag_sha256),
        said=said,
    )


def _reservations(report: Outcome, stated: Stated) -> tuple[str, ...]:
    """Why a PASS is not one without reservations; empty where it is."""
    out, claim = [], report.claim
    if report.status == "open":
        out.append(f"The verdict is open: {report.open_because[0]}")
    if report.status == "cannot_tell":
        out.append("The floor is not known: neither how well the arm repeats, nor whether the error could be smaller.")
    if claim is not None and claim.is_open:
        out.append(
            f"{claim.unshown_mm:.3f} mm of the upper end are held by what arms are like, not by readings: "
            f"{claim.open.what}. {claim.open.remedy}"
        )
    if claim is not None and not claim.apply:
        out.append("It is not sure that the calibrated arm is better than the nominal one.")
    asked = report.tolerance.asked.mm if report.tolerance else np.inf
    if stated.instrument_mm is None:
        out.append("The instrument's accuracy is not stated: its own error may be part of the result or hidden in it.")
    elif stated.instrument_mm > MAX_OF_TOLERANCE * asked:
        out.append(
            f"The instrument is accurate to {stated.instrument_mm:g} mm, more than a third of the tolerance: "
            "a tolerance this small cannot be verified with it."
        )
    if report.rejected_stations():
        out.append(rejected_words(report))
    if report.grounds.convention:
        out.append(f"The readings are in another convention than usual ({report.grounds.convention}): it was undone.")
    return tuple(out)


def _reasons(report: Outcome) -> tuple[str, ...]:
    """What stands behind another result than PASS: the reasons of an open verdict, and what was left out."""
    judged, met, out = report.judged or Verdict("cannot_tell"), report.tolerance, []
    if judged.floor_mm is not None and met is not None and judged.floor_mm > met.asked.mm:
        out.append(
            f"Arm and instrument alone scatter by {judged.floor_mm:.3g} mm RMS, more than the tolerance: no "
            "calibration meets it."
        )
    shown = MAX_REASONS - len(out)
    out += report.open_because[:shown]
    if (more := len(report.open_because) - shown) > 0:
        out.append(f"And {counted(more, 'more reason')}, in report.json.")
    if judged.status == "cannot_tell" and judged.remedy:
        out.append(f"{'' if judged.floor_known else 'The floor is not known. '}{judged.remedy}")
    if report.rejected_stations() and not any(reason.kind == "rejected" for reason in judged.reasons):
        out.append(rejected_words(report))
    return tuple(out)


def _before(report: Outcome, met: Tolerance) -> float | None:
    """The nominal arm's error [mm], of what is judged."""
    if report.claim is not None and met.asked.statistic == "p95":
        return report.claim.nominal_p95
    before = report.size_mm("nominal")
    return None if before is None else float(getattr(before, met.asked.statistic))


def _facts(report: Outcome, stated: Stated, said: Particulars) -> tuple[tuple[str, str | None], ...]:
    trace = report.trace
    sizes, counts = report.set_sizes(), report.samples.stations
    held = f"{sizes['held_out']} of them scored{'' if report.searched is None else ' that no fit has seen'}"
    date = trace.date if report.samples.clock else None
    return (
        ("Robot", said.robot or trace.robot),
        ("Serial number", said.serial),
        ("Date of the recording", None if date is None else f"{date[:10]} {date[11:16]} UTC"),
        ("Stations", f"{counts} ({report.measurement.replace('_', ' ')}), {held}"),
        ("Instrument", said.instrument or trace.instrument),
        ("Its accuracy", _accuracy(stated)),
        ("Volume", _volume(report)),
        ("Conditions", "; ".join(filter(None, (said.conditions, _temperatures(report))))),
        ("Program", f"modcal {trace.version}"),
    )


def _accuracy(stated: Stated) -> str | None:
    parts = [] if stated.instrument_mm is None else [f"{stated.instrument_mm:g} mm RMS in space"]
    parts += [] if stated.instrument_deg is None else [f"{stated.instrument_deg:g}° RMS"]
    return f"{', '.join(parts)}, as stated" if parts else "not stated"


def _volume(report: Outcome) -> str | None:
    """The box that the tool was in, in the arm's base [m]."""
    if report.model is None or not len(report.scored):
        return None
    T = report.model.T_frame_base[report.scored.frame]
    p = report.model.predict_samples(report.scored)[:, :3, 3] - T[:, :3, 3]
    inside = np.einsum("nji,nj->ni", T[:, :3, :3], p)
    return box_in_words(inside)


def box_in_words(p: Array) -> str:
    """The box of points (N, 3) [m] in the arm's base."""
    ends = zip("xyz", p.min(axis=0), p.max(axis=0), strict=True)
    box = "; ".join(f"{axis} {low:.2f} … {high:.2f} m" for axis, low, high in ends)
    return f"{box.replace('-', '−')} from the base"


def _temperatures(report: Outcome) -> str:
    """The recorded temperatures, all together."""
    kept = [np.ravel(s.values) for s in report.samples.signals if s.name.startswith("temperature:")]
    values = np.concatenate([np.empty(0), *kept])
    values = values[np.isfinite(values)]
    return f"{values.min():.1f} … {values.max():.1f} °C recorded" if len(values) else ""


def _errors(report: Outcome) -> tuple[Section, ...]:
    """The errors before and after, where anything was scored."""
    tables = error_tables(report, _STAGES)
    floor = SummaryLine(f"Floor of arm and instrument: {floor_words(report.judged) or 'not known'}.")
    return (Section("errors", "Error on scored stations", [*tables, floor]),) if tables else ()


def _iso(tests: PoseTest) -> tuple[str, ...]:
    """A sentence for the position, one for the orientation; or what is missing."""
    before, after = tests.worst_mm("nominal"), tests.worst_mm("final")
    if tests.missing or before is None or after is None:
        return (f"AP and RP are not given. {tests.missing}",)
    fewest = min(p.visits for p in tests.poses)
    out = [
        f"{len(tests.poses)} poses, at least {fewest} visits each from one side. Largest AP {before[0]:.3f} mm before, "
        f"{after[0]:.3f} mm after; largest RP {after[1]:.3f} mm. Commanded is what the model computes from the "
        "joint positions; load and speed are those under conditions."
    ]
    turned = [(p.ap_deg["final"], p.rp_deg) for p in tests.poses if p.ap_deg is not None and p.rp_deg is not None]
    if len(turned) == len(tests.poses):
        three = (np.abs([ap for ap, _ in turned]).max(axis=0), np.max([rp for _, rp in turned], axis=0))
        a, r = (" / ".join(f"{value:.4f}" for value in values) for values in three)
        out.append(f"About x / y / z of the instrument's frame: AP {a}°, RP ±{r}°.")
    return tuple(out)


def _silent_on(report: Outcome, stated: Stated, tests: PoseTest) -> tuple[str, ...]:
    met = report.tolerance
    assert met is not None
    standing = "in motion" if report.samples.moving.all() else "at rest" if not report.samples.moving.any() else "these"
    of = f"{STATISTICS[met.asked.statistic]} error"
    constant = "Errors that are constant in the instrument, such as its scale"
    constant += "." if stated.instrument_mm is not None else "; it is not traced to a standard."
    out = [
        f"Other postures, loads, temperatures and tools than those recorded ({standing}), and paths between them.",
        f"Single postures: the {of} is judged, and one of them may be off by more.",
        constant,
    ]
    if report.claim is not None and report.claim.deg is None:
        out.append("Orientation: the readings show the point of the target alone.")
    if report.searched is not None:
        out.append(
            "What lasts: stations of the same session were scored. modcal evaluate judges a later recording. "
            "calibrated.urdf and kinematics.yaml hold the geometry alone."
        )
    if tests.missing:
        out.append("Results of a test by ISO 9283.")
    return tuple(out)


_CAMERA_IS_SILENT_ON = (
    "Postures at which the camera does not see the target: report.json has the error anywhere within the joint limits.",
    "Other loads and temperatures than those at the images, paths between postures, and single postures: the RMS is "
    "judged, and one of them may be off by more.",
    "What lasts: modcal evaluate judges a later recording of another instrument. calibrated.urdf and kinematics.yaml "
    "hold the geometry alone.",
    "Results of a test by ISO 9283.",
)


def camera_tolerance(solution: CameraSolution, tolerance_mm: float) -> Tolerance:
    """Whether the calibrated arm stays within a tolerance, RMS. What contradicts the fit bars a PASS, and so does a
    doubtful statement, or that nothing has a length that was measured or stated.
    """
    middle, low, high = (1e3 * end for end in solution.judged.interval)
    claim, over = solution.claim, "postures of the images"
    no_length = [] if claim.metric else ["Nothing in these images has a length that somebody measured."]
    against = (*claim.decision.problems, *no_length, *claim.decision.doubtful, "")
    over += ", the arm by itself" if solution.judged is claim.alone else ""
    at_tool = AtTool(middle, (low, high), over, 0.0, "More and better images would tell.")
    return assess(at_tool, Asked(tolerance_mm, "rms"), Verdict("cannot_tell", unproven=against[0]))


def camera_certificate(
    solution: CameraSolution, data: Mapping[str, Any], met: Tolerance, said: Particulars, hashes: Hashes
) -> Certificate:
    """The certificate of a calibration by camera. data: of ``report.json``. met: of :func:`camera_tolerance`."""
    fit, camera, seen = solution.fit, data["camera"], data["camera"]["images"]
    doubts, out = camera["because"], seen["given"] - seen["used"]
    if met.result == "PASS":
        fitted = "The figure is that of a fit to these images, with the interval that they leave: the floor of arm and "
        left_out = [f"{out} of {seen['given']} images were left out."] * (out > 0)
        doubts = [f"{fitted}camera is not known.", *doubts[1:], *left_out]
    where, judged = ("by itself", "arm_alone") if fit.table.places else ("in view", "in_view")
    size = {
        (place, arm): "{rms:.2f} mm RMS (95 %: {low95:.2f} … {high95:.2f})".format(
            **camera["tool_error_mm"][place][arm]
        )
        for place in (judged, "anywhere")
        for arm in ("nominal", "calibrated")
    }
    flange = chain_forward(fit.poses.model_at(fit.state.values).serial, fit.poses.q)
    used = f"{seen['used']} of {seen['given']}, {camera['corners']['used']} corners, {camera['rms_px']:.2f} px RMS"
    facts = (
        ("Robot", said.robot or data["trace"]["robot"]),
        ("Serial number", said.serial),
        ("Date of the recording", None),
        ("Images", used),
        ("Instrument", said.instrument or f"camera of {fit.state.lens.size[0]} × {fit.state.lens.size[1]} pixels"),
        ("Target", f"{camera['target']}; {solution.camera.mounting.label}"),
        ("Its lengths by", "; ".join(camera["metric"]) or "nothing"),
        (f"Nominal arm, {where}", size[judged, "nominal"]),
        (f"Calibrated arm, {where}", size[judged, "calibrated"]),
        ("Anywhere", size["anywhere", "calibrated"]),
        ("Advice", camera["decision"]),
        ("Volume", box_in_words(flange[:, :3, 3])),
        ("Conditions", said.conditions),
        ("Program", f"modcal {data['trace']['version']}"),
    )
    return Certificate(
        title="Accuracy certificate: calibration by camera",
        met=met,
        reservations=tuple(doubts[:MAX_REASONS]),
        before=camera["tool_error_mm"][judged]["nominal"]["rms"],
        facts=facts,
        silent_on=_CAMERA_IS_SILENT_ON,
        hashes=hashes,
        said=said,
        recorded="images and joints",
    )


def drawn(met: Tolerance, before: float | None, tone: str) -> Chart:
    """The error, its interval and the tolerance on one axis. before: of the nominal arm [mm]."""
    asked, value, (low, high) = met.asked.mm, met.value_mm, met.ci95
    # what is judged stays readable where the nominal model is far worse
    end = 1.25 * max(asked, value or 0.0, high or 0.0)
    panel = Panel(Axis("mm", 0.0, end), Axis.rows([""]), 370.0, 62.0, ((f"tolerance {asked:g}", BAD, "line"),))
    said = f"tolerance {asked:g} mm"
    if value is not None:
        said += f", error {value:.3f} mm"
        ends = [value if one is None else one for one in (low, high)]
        panel.bars((np.array(ends[:1]), np.array(ends[1:])), (np.array([-0.25]), np.array([0.25])), tone)
        panel.line(np.full(2, value), np.array([-0.4, 0.4]), INK, 1.6)
    if low is not None and high is not None:
        said += f" with a 95 % interval of {low:.3f} to {high:.3f} mm"
    panel.line(np.full(2, asked), np.array([-0.5, 0.5]), BAD, 1.4, dashed=True)
    words = "Bar: the tool's error, each end passed with a chance of 5 %; stroke: the likely; dashed: the tolerance."
    if before is not None:
        words += f" Before calibration the error was {before:.3f} mm."
    return panel.chart("scale", f"Scale in millimetres: {said}.", words)
