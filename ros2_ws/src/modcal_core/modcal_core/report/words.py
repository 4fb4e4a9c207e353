"""The verdict in words: what was scored and what was not, how large the error is, and what may be said of the rest."""

from __future__ import annotations

from math import sqrt

from modcal_core.measurements import unexpected
from modcal_core.outcome import Outcome, counted
from modcal_core.verdict import Status, Verdict


def percent(share: float, digits: int = 0) -> str:
    """A share in per cent, as the pages write it: with a space that does not break."""
    return f"{round(100.0 * share, digits) + 0.0:.{digits}f}\u00a0%"


STATISTICS = {"mean": "mean", "rms": "RMS", "p95": "95th percentile", "max": "largest"}
REMEDY = (
    "Return to six postures, each left in between and approached from another side, or state --repeatability-mm and "
    "--instrument-mm."
)
NOT_SOUGHT = (
    "Only geometry was fitted: gear errors, compliance, backlash, coupling, temperature, drift and steps "
    "were not looked for."
)
STATUS_WORDS: dict[Status, str] = {"at_floor": "at the floor", "open": "open", "cannot_tell": "cannot tell"}
_SEEN = 0.44  # of the floor's square, which is a fifth more in RMS: as much as would be called above it
MAX_REASONS = 2  # that the sentence gives; report.json has all of them


def sentence(report: Outcome) -> str:
    """What a person reads first, a few sentences."""
    if report.size_mm("final") is None and report.size_deg("final") is None:
        return _counts(report) + " No station was scored, so the error is unknown."
    parts = [_counts(report), _error(report), short_status(report.judged)]
    if report.searched is False:
        parts.append(NOT_SOUGHT)
    if report.tolerance is not None:
        parts.append(f"Tolerance {report.tolerance.asked.mm:g} mm: {report.tolerance.result}.")
    return " ".join(part for part in parts if part)


def short_status(verdict: Verdict | None) -> str:
    """The verdict in one line: for a status, the terminal's last line, a table."""
    if verdict is None or verdict.status == "cannot_tell":
        remedy = (verdict.remedy if verdict else "") or REMEDY
        unknown = "" if verdict is not None and verdict.floor_known else ": no floor is known"
        return f"Cannot tell whether the rest is the floor{unknown}. {remedy}"
    if verdict.status == "open":
        return "Open: " + _reasons(verdict)
    return "At the floor: " + _floor(verdict)


def _counts(report: Outcome) -> str:
    """How many stations there are and how many of them were rejected, and what never became one."""
    rejected = report.rejected_stations()
    said = f"{counted(report.samples.stations, 'station')}, "
    said += f"{rejected} of them rejected" if rejected else "none rejected"
    if again := report.readmitted.stations:
        said += f", {again} taken in again after that"
    if lost := unexpected(report.dropped):
        said += f"; {counted(lost, 'reading')} could not be used"
    return said + "."


def _error(report: Outcome) -> str:
    """The error of the scored stations, with and without those that were rejected."""
    where = f"On the {report.set_sizes()['held_out']} held out from fitting"
    if not len(report.sets.train):
        where = "With the calibration frozen"
    angle = report.size_deg("final")
    sizes = [_size_mm(report)] if report.size_mm("final") is not None else []
    rejected = report.held_out_rejected() > 0
    if angle is not None:
        sizes.append(f"{'orientation ' if rejected else ''}{angle.rms:.3g}°")
    named = report.searched is None or any(finding.effects for finding in report.effects)
    stages = [("nominal", "nominal model"), *([("geometric", "geometry alone")] if named else [])]
    before = [said for stage, name in stages if (said := _stage(report, stage, name))]
    compared = f" ({', '.join(before)})" if before else ""
    return f"{where} the error is {('; ' if rejected else ' and ').join(sizes)}{compared}."


def _size_mm(report: Outcome) -> str:
    """The RMS of the final model, without and with the rejected stations."""
    after, out, count = report.size_mm("final"), report.rejection, report.held_out_rejected()
    assert after is not None
    if not count or out is None or out.with_mm is None:
        return f"{after.rms:.3f} mm RMS"
    rejected, them = ("rejected one", "it") if count == 1 else (f"{count} rejected", "them")
    if not report.counts_rejected:
        return f"{after.rms:.3f} mm RMS without the {rejected} among these, {out.with_mm:.3f} mm with {them}"
    without = "" if out.without_mm is None else f", {out.without_mm:.3f} mm without"
    return f"{out.with_mm:.3f} mm RMS with the {rejected}, which are too many to leave out{without}"


def _stage(report: Outcome, stage: str, name: str) -> str:
    size, angle = report.size_mm(stage), report.size_deg(stage)
    if size is None:
        return "" if angle is None else f"{name} {angle.rms:.3g}°"
    return f"{name} {size.rms:.3f} mm" + ("" if angle is None else f" and {angle.rms:.3g}°")


def _reasons(verdict: Verdict) -> str:
    first = verdict.open_because[:MAX_REASONS]
    more = len(verdict.open_because) - len(first)
    said = " ".join(sentence if sentence.endswith((".", "!", "?")) else f"{sentence}." for sentence in first)
    return said + (f" And {counted(more, 'more reason')}, in report.json." if more else "")


def _floor(verdict: Verdict) -> str:
    """What the floor is, and how it is known."""
    known = [(f"{verdict.floor_mm:.3f} mm", verdict.repeatability_mm.source)] if verdict.floor_mm is not None else []
    if verdict.floor_deg is not None:
        known.append((f"{verdict.floor_deg:.3g}°", verdict.repeatability_deg.source))
    if len({source for _, source in known}) == 1:
        known = [(" and ".join(size for size, _ in known), known[0][1])]
    sizes = " and ".join(f"{size}{_SOURCES[source]}" for size, source in known)
    allowed = f"the residual is as small as this arm and this instrument allow{f' ({sizes})' if sizes else ''}"
    return f"{allowed}{_unsettled(verdict)}."


def _unsettled(verdict: Verdict) -> str:
    """What more postures would better, where that is a part of what is left which a reader sees."""
    rows = [row.value for row in verdict.account_mm2 or () if row.what == "estimation"]
    if not rows or verdict.floor_mm is None or rows[0] <= _SEEN * verdict.floor_mm**2:
        return ""
    return (
        f" and as these postures tell the parameters, which leaves {sqrt(rows[0]):.3f} mm by itself: more different "
        "postures would make it smaller"
    )


_SOURCES = {"revisits": ", from postures visited again", "stated": ", as stated", None: ""}
