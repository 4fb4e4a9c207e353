"""The verdict in words, and tables: what was scored, how large the error is, and what may be said of the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, replace
from math import sqrt
from typing import TYPE_CHECKING, Any

from modcal_core.geometry import Array
from modcal_core.measurements import unexpected
from modcal_core.outcome import Outcome, counted
from modcal_core.report.blocks import Summary, SummaryLine, TableBlock, legend, tone_of
from modcal_core.robots import PARAMETERS
from modcal_core.verdict import Row, Status, Tolerance, Verdict

if TYPE_CHECKING:
    from modcal_core.calibration import ByDistances


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
    parts = [_counts(report), _error(report), rejected_words(report), short_status(report.judged)]
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
    """How many stations there are, and what never became one."""
    said = counted(report.samples.stations, "station")
    said += "" if report.rejected_stations() else ", none rejected"
    if again := report.readmitted.stations:
        said += f", {again} taken in again after they had been rejected"
    if lost := unexpected(report.dropped):
        said += f"; {counted(lost, 'reading')} could not be used"
    return said + "."


def _error(report: Outcome) -> str:
    """The error of the scored stations, and before."""
    where = f"On the {report.set_sizes()['held_out']} held out from fitting"
    if not len(report.sets.train):
        where = "With the calibration frozen"
    size, angle = report.size_mm("final"), report.size_deg("final")
    sizes = [f"{size.rms:.3f} mm RMS"] if size is not None else []
    sizes += [f"{angle.rms:.3g}°"] if angle is not None else []
    named = report.searched is None or any(finding.effects for finding in report.effects)
    stages = [("nominal", "nominal model"), *([("geometric", "geometry alone")] if named else [])]
    before = [said for stage, name in stages if (said := _stage(report, stage, name))]
    compared = f" ({', '.join(before)})" if before else ""
    return f"{where} the error is {' and '.join(sizes)}{compared}."


def rejected_words(report: Outcome) -> str:
    """How many stations were rejected, if any, whether they count in the figures, and these with and without them."""
    count, out = report.rejected_stations(), report.rejection
    if not count:
        return ""
    sizes = ""
    if out is not None and out.with_mm is not None and out.without_mm is not None:
        sizes = f": {out.with_mm:.3f} mm RMS with them, {out.without_mm:.3f} mm without"
    counts = "are" if report.counts_rejected else "are not"
    return f"{count} of {report.samples.stations} stations were rejected and {counts} in the figures{sizes}."


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


def floor_words(verdict: Verdict | None) -> str:
    """What the floor is, and how it is known; nothing where it is not."""
    verdict, sizes = verdict or Verdict("cannot_tell"), []
    if verdict.floor_mm is not None:
        sizes.append((f"{verdict.floor_mm:.3f} mm", SOURCES[verdict.repeatability_mm.source]))
    if verdict.floor_deg is not None:
        sizes.append((f"{verdict.floor_deg:.3g}°", SOURCES[verdict.repeatability_deg.source]))
    if len(sizes) == 2 and sizes[0][1] == sizes[1][1]:
        sizes = [(f"{sizes[0][0]} and {sizes[1][0]}", sizes[0][1])]
    return " and ".join(size + source for size, source in sizes)


def _floor(verdict: Verdict) -> str:
    words = floor_words(verdict)
    allowed = f"the residual is as small as this arm and this instrument allow{f' ({words})' if words else ''}"
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


SOURCES = {"revisits": ", from postures visited again", "stated": ", as stated", None: ""}


_OF_EFFECTS = {
    "place": "where the error arises",
    "direction": "the way it moves the arm there",
    "driver": "what its size depends on",
    "error": "RMS over what was held out, without the effect and with it",
    "p": "probability of as much by chance, after everything that was tried",
}


def effects_table(effects: Sequence[Mapping[str, Any]], meanings: Mapping[str, str] | None = None) -> TableBlock:
    """What was added to the geometry, as ``report.json`` has it. meanings: of headings, where they are others."""
    header = "effect | place | direction | driver | moves the tool by, mm | error without it, mm | with it, mm | p"
    cells = "{family:words} | {place} | {direction} | {driver:driver} | {tool_rms_mm:.3f} | {rms_mm_before:.3f}"
    cells += " | {rms_mm_after:.3f} | {p_value:.1g}"
    return TableBlock.of("Effects", header, cells, effects, words=4, below=legend(meanings or _OF_EFFECTS))


def tolerance_lines(met: Tolerance | None, of: str = "") -> list[SummaryLine]:
    """The result for a tolerance, where one was asked for. of: what is judged, before the reason."""
    return [] if met is None else [SummaryLine(f"{of}{met.because}", tone_of(met.result), f"{met.result}:")]


_WORDS = {
    "shared": "shared among effects",
    "predictable": "predictable, not modelled",
    "estimation": "uncertainty of the parameters",
    "repeatability": "repeatability of the arm",
    "unaccounted": "unaccounted for",
}
_OF_FLOOR = ("repeatability", "instrument")
_EFFECT = "effect:"
_ROUNDING = 1e-9  # of the whole; the rows sum to it within as much
_SMALL, _MANY = 0.01, 3  # effects with less than this share stand in one row where there are so many; all are in files


_STAGES = {
    "nominal": "the robot description, base and tool fitted",
    "geometric": "lengths, angles and joint zeros corrected",
    "final": "the effects below as well",
}


def error_tables(report: Outcome, names: Mapping[str, str] | None = None) -> list[TableBlock]:
    """Sizes of held-out position and orientation errors. names: of the stages to show, where they say what they are."""
    position, orientation = [], []
    stages = [stage for stage in names or _STAGES if report.size_mm(stage) or report.size_deg(stage)]
    below = "" if names else legend({stage: _STAGES[stage] for stage in stages})
    for stage in stages:
        name = names[stage] if names else stage
        if (size := report.size_mm(stage)) is not None:
            ends = span(report.interval_mm(stage), 3)
            position.append((name, *(f"{x:.3f}" for x in astuple(size)), ends))
        if (angle := report.size_deg(stage)) is not None:
            orientation.append((name, *(f"{x:.4f}" for x in astuple(angle))))
    header = ("position error, mm", *STATISTICS.values(), "95 % interval of the RMS")
    turned = ("orientation error, °", *STATISTICS.values())
    out = [
        TableBlock("Position errors before and after", header, tuple(position), strong=2),
        TableBlock("Orientation errors before and after", turned, tuple(orientation), strong=2),
    ]
    return [replace(table, below=below) for table in out if table.rows]


def account_tables(verdict: Verdict | None, fold: bool = False) -> list[TableBlock]:
    """Where the nominal model's squared error went, where that is known. fold: small rows of effects as one row."""
    if verdict is None:
        return []
    both = (("mm", verdict.account_mm2, verdict.floor_mm), ("deg", verdict.account_deg2, verdict.floor_deg))
    return [_account(unit, rows, floor is not None, fold) for unit, rows, floor in both if rows]


def _account(unit: str, rows: Sequence[Row], floor_known: bool, fold: bool) -> TableBlock:
    total = sum(row.value for row in rows)
    small = [row for row in rows if row.what.startswith(_EFFECT) and abs(row.value) < _SMALL * total]
    small = small if fold and len(small) >= _MANY else []
    # parts that overlap by more than the whole, or that leave more of it than there was, are no shares of it
    divided = all(abs(row.value) <= (1.0 + _ROUNDING) * total for row in rows)
    cells = []
    for row in rows:
        known = floor_known or row.what not in _OF_FLOOR
        if row not in small:
            sizes = (*_sizes(row.value, total, divided), span(row.ci95)) if known else ("not known", "", "", "")
            cells.append((_words(row.what), *sizes))
        elif row is small[-1]:
            words = f"{len(small)} effects of less than {_SMALL:.0%} each, in report.json"
            cells.append((words, *_sizes(sum(one.value for one in small), total, divided), ""))
    cells.append(("nominal model", *_sizes(total, total), ""))
    header = ("account of the squared error", f"{unit}²", "of the nominal", f"root, {unit}", f"95 % interval, {unit}²")
    return TableBlock(f"Account in {unit}²", header, tuple(cells))


def distances_table(found: ByDistances | None) -> list[Summary]:
    """A Delta from distances alone, method by method, and what distances cannot tell; nothing where not asked for."""
    if found is None:
        return []
    rows = tuple((m.name, f"{1e3 * m.f:.4f}", f"{1e3 * m.held_out:.4f}", f"{m.evaluations}") for m in found.methods)
    header = ("by distances alone", "RMS of fitted distances, mm", "held-out RMS, mm", "evaluations")
    said = f"Of the Delta's {PARAMETERS} parameters distances of {found.points} points show {found.seen.rank}; not "
    lines = [f"{said}shown, and left nominal: {'; '.join(found.seen.unseen) or 'none'}."]
    lines += [f"Ended at a bound of what is allowed: {', '.join(found.at_bound)}."] * bool(found.at_bound)
    return [TableBlock("By distances alone", header, rows), *map(SummaryLine, lines)]


def _sizes(value: float, total: float, divided: bool = True) -> tuple[str, str, str]:
    """A part of the squared error: itself, as a share where the whole can be divided, and its root with its sign."""
    value = 0.0 if abs(value) < _ROUNDING * total else value
    root = abs(value) ** 0.5 * (-1.0 if value < 0.0 else 1.0)
    share = f"{round(100.0 * value / max(total, 1e-300), 2) + 0.0:.2f} %" if divided else "cannot be divided"
    return f"{value:.4g}", share, f"{root:.4f}"


def _words(what: str) -> str:
    effect = what.removeprefix(_EFFECT)
    return effect.replace(":", " of ") if effect != what else _WORDS.get(what, what.replace("_", " "))


def span(ends: Sequence[float] | Array | None, digits: int | None = None) -> str:
    """Both ends of an interval, with three significant digits or so many behind the point; nothing for None."""
    form = ".3g" if digits is None else f".{digits}f"
    return "" if ends is None else " … ".join(f"{end:{form}}" for end in ends)


def csv_text(names: Sequence[str], rows: Array, digits: str = ".9f") -> str:
    """Numbers (N, n) as CSV under their names."""
    return ",".join(names) + "\n" + "".join(",".join(f"{x:{digits}}" for x in row) + "\n" for row in rows)


def stations_table(title: str, joints: Sequence[str], q: Array) -> TableBlock:
    """Postures (N, n) in their order."""
    rows = tuple((str(i), *(f"{x:.4f}" for x in row)) for i, row in enumerate(q, 1))
    return TableBlock(f"{title}, rad or m", ("station", *joints), rows, heading=True)
