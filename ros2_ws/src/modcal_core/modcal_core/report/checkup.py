"""A check, and the history of an arm, for programs and for people: data, what a terminal shows, and a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.checking import Series
from modcal_core.checkup import Checked
from modcal_core.moves import NamedChange, SizeFound
from modcal_core.report.as_json import claim_data, finite, tolerance_data
from modcal_core.report.blocks import Figures, Listing, PageTable, Section, Summary, SummaryLine, SummaryTable, Tone
from modcal_core.report.charts import AFTER, BEFORE, Axis, Panel
from modcal_core.report.page import Page, files_section

_HEADINGS = {
    "unchanged": ("Nothing has changed", "good"),
    "changed": ("Something has changed", "warn"),
    "ambiguous": ("Something has changed; these stations cannot tell which", "warn"),
    "unexplained": ("Something has changed that is not explained", "bad"),
}
_TONES: dict[str, Tone] = {"unchanged": "good", "changed": "undecided", "ambiguous": "undecided", "unexplained": "bad"}
_SIZES = ("change", "size", "value", "95 % interval", "unit")


def checkup_data(found: Checked, calibration: str = "") -> dict[str, Any]:
    """The data of check.json. calibration: the name of what was checked."""
    return {
        "modcal_check": 1,
        "calibration": calibration,
        "robot": found.report.trace.robot,
        "date": found.report.trace.date,
        "status": found.status,
        "verdict": found.sentence,
        "stations": found.stations,
        "set_aside": list(found.aside),
        "chance_of_false_alarm_below": found.chance,
        "changes": [_change(c) for c in found.changes],
        "error_mm": {"frozen": found.before[0], "expected": found.expected[0], "with_changes": found.after[0]},
        "error_deg": {"frozen": found.before[1], "expected": found.expected[1], "with_changes": found.after[1]},
        "would_have_been_noticed_mm": {n.label: finite(n.mm) for n in found.noticed},
        "not_noticed": [label for n in found.noticed for label in n.unseen],
        "action": found.advice.action,
        "advice": found.advice.sentence,
        "stations_to_add": [
            {name: float(x) for name, x in zip(found.joints, q, strict=True)} for q in found.advice.stations
        ],
        "repaired": found.repaired is not None,
        **claim_data(found.report.claim),
        "convention": found.convention,
        "tolerance": tolerance_data(found.report.tolerance),
        "notes": list(found.notes),
    }


def _change(c: NamedChange) -> dict[str, Any]:
    return {
        "kind": c.kind,
        "place": c.place,
        "label": c.label,
        "sentence": c.sentence,
        "sizes": [{"name": s.name, "value": s.value, "ci95": [s.low, s.high], "unit": s.unit} for s in c.sizes],
        "moved_mm": {"rms": c.moved_mm[0], "ci95": [c.moved_mm[1], c.moved_mm[2]]},
        "turned_deg": c.turned_deg,
        "probability": c.probability,
        "same_as": list(c.same_as),
        "same_at_every_posture": bool(c.alike),
        "same_orientation": c.alike == "poses",
        "repairable": c.repairable,
    }


def checkup_summary(found: Checked) -> tuple[Summary, ...]:
    """What a terminal shows: errors, changes, what would have been noticed, the answer, and what to do."""
    out: list[Summary] = []
    out += [table.summary for table in _seen(found)]
    if found.noticed:
        said = ", ".join(f"{n.label} {n.mm:.3f} mm" for n in found.noticed if np.isfinite(n.mm)) or "nothing"
        out.append(SummaryLine(f"Noticed in 95 of 100 cases, RMS at the tool: {said}.{_not_shown(found)}", "legend"))
    out += [SummaryLine(note, "doubt") for note in found.notes]
    out.append(SummaryLine(found.sentence, _TONES[found.status]))
    out.append(SummaryLine(found.advice.sentence))
    if found.report.claim is not None:
        out.append(SummaryLine(f"{_judged(found)} {found.report.claim.sentence}", "legend"))
    met = found.report.tolerance
    if met is not None:
        tones: dict[str, Tone] = {"PASS": "good", "FAIL": "bad"}
        out.append(SummaryLine(f"{met.result}: {_judged(found)} {met.because}", tones.get(met.result, "undecided")))
    return tuple(out)


def _errors(found: Checked) -> tuple[tuple[str, ...], ...]:
    """The error by the frozen model, what is expected, and with what changed."""
    stages = {"frozen model": found.before, "expected while nothing has changed": found.expected}
    if found.changes:
        stages["with what changed"] = found.after
    return tuple(
        (what, *("" if x is None else f"{x:.{digits}f}" for x, digits in zip(pair, (3, 4), strict=True)))
        for what, pair in stages.items()
    )


def _not_shown(found: Checked) -> str:
    unseen = ", ".join(label for n in found.noticed for label in n.unseen)
    return f" These stations do not show: {unseen}." if unseen else ""


def _judged(found: Checked) -> str:
    return "Repaired model:" if found.repaired is not None else "Frozen model:"


def _row(change: NamedChange, s: SizeFound) -> tuple[str, ...]:
    span = "" if s.low == s.high else f"{s.low:.4g} … {s.high:.4g}"
    return change.label, s.name, f"{s.value:+.4g}", span, s.unit


def checkup_html(found: Checked, title: str, files: Sequence[str]) -> str:
    """The page. files: names of those beside it."""
    heading, tone = _HEADINGS[found.status]
    if found.status == "unchanged" and found.alike:
        heading, tone = "No change is seen", "warn"
    lines = [
        f"What to do: {found.advice.sentence}",
        *([f"{_judged(found)} {found.report.claim.sentence}"] if found.report.claim is not None else []),
        (
            f"While nothing has changed, as much is named by chance in fewer than {_rarely(found.chance)} checks."
            if found.changes
            else "A change is named when stations show as much by chance in fewer than one of a hundred checks."
        ),
        *([f"Readings were undone to be used: {found.convention}."] if found.convention else []),
        *found.notes,
    ]
    met = found.report.tolerance
    if met is not None:
        lines.insert(1, f"{met.result}. {_judged(found)} {met.because}")
    seen = Section("seen", "What was seen", [*_tables(found), *_station_errors(found)])
    return Page(title, found.sentence, [Listing(lines), seen, files_section(files)], heading, tone).html()


def _rarely(chance: float) -> str:
    return f"one in {1.0 / max(chance, 1e-12):,.0f}".replace(",", " ") if chance > 1e-12 else "one in 10¹²"


def _seen(found: Checked) -> list[PageTable]:
    """The errors, and what changed."""
    title = f"Error at {found.stations} stations"
    out = [PageTable(title, ("model", "RMS mm", "RMS deg"), _errors(found), heading=True)]
    if rows := tuple(_row(c, s) for c in found.changes for s in c.sizes):
        below = "Of a base: in the frame of the first joint. Of a tool: in its own."
        out.append(PageTable("What changed", _SIZES, rows, 2, below, heading=True))
    return out


def _tables(found: Checked) -> tuple[PageTable, ...]:
    out = _seen(found)
    if found.changes:
        rivals = tuple(
            (c.label, ", ".join(c.same_as) or "none", c.alike, f"{100.0 * c.probability:.1f} %") for c in found.changes
        )
        columns = ("named", "explains these stations as well", "the same at every posture", "probability")
        out.append(PageTable("What it may as well be", columns, rivals, 3, heading=True))
    if len(found.advice.stations):
        numbered = tuple((str(i), *(f"{x:.4f}" for x in q)) for i, q in enumerate(found.advice.stations, 1))
        out.append(PageTable("Stations to add, rad or m", ("station", *found.joints), numbered, heading=True))
    noticed = tuple((n.label, f"{n.mm:.3f}") for n in found.noticed if np.isfinite(n.mm))
    if noticed:
        below = f"RMS at the tool over these stations, of the direction that shows least.{_not_shown(found)}"
        out.append(
            PageTable("Noticed in 95 of 100 such checks", ("change", "RMS, mm"), noticed, below=below, heading=True)
        )
    return tuple(out)


def _station_errors(found: Checked) -> list[Figures]:
    """The error of each station before and after."""
    if found.station_errors is None:
        return []
    before, after = (1e3 * e for e in found.station_errors)
    x = np.arange(1.0, len(before) + 1.0)
    top = 1.1 * max(float(before.max()), float(after.max()), 1e-6)
    panel = Panel(Axis("station", 0.4, len(before) + 0.6), Axis("error, mm", 0.0, top))
    panel.marks(x, before, BEFORE, "circle")
    panel.marks(x, after, AFTER, "square")
    alt = f"Error at every station: up to {before.max():.3f} mm by the frozen model"
    alt += f", up to {after.max():.3f} mm with what changed." if found.changes else "."
    caption = "circles: the model as calibrated; squares: with what changed put in"
    return [Figures([panel.chart("stations", alt, caption)])]


@dataclass(frozen=True)
class HistoryEntry:
    """One calibration or check. time: [s]; None where its recording has no clock. said: its verdict."""

    name: str
    what: str
    date: str | None
    time: float | None
    said: str


@dataclass(frozen=True)
class History:
    """Of one robot: its name, entries in order of time, series of what may grow."""

    robot: str
    entries: tuple[HistoryEntry, ...]
    series: tuple[Series, ...]
    notes: tuple[str, ...] = ()

    @property
    def trends(self) -> tuple[str, ...]:
        """A sentence for each trend."""
        return tuple(s.sentence for s in self.series if s.trend is not None)

    @property
    def sentence(self) -> str:
        """The answer, as text."""
        seen = f"{len(self.entries)} calibrations and checks"
        return " ".join(self.trends) if self.trends else f"Nothing grows or falls beyond chance over {seen}."


def history_data(found: Sequence[History]) -> dict[str, Any]:
    """The data of history.json."""
    return {
        "modcal_history": 1,
        "robots": [
            {
                "robot": h.robot,
                "verdict": h.sentence,
                "entries": [{"name": e.name, "what": e.what, "date": e.date, "verdict": e.said} for e in h.entries],
                "series": [_series(s) for s in h.series],
                "notes": list(h.notes),
            }
            for h in found
        ],
    }


def _series(s: Series) -> dict[str, Any]:
    trend = None
    if (t := s.trend) is not None:
        trend = {"change": t.change, "ci95": [t.low, t.high], "share": t.share, "days": t.days, "sentence": s.sentence}
    points = [{"entry": p.entry, "value": p.value, "std": p.std} for p in s.points]
    return {"name": s.name, "unit": s.unit, "points": points, "trend": trend}


def history_summary(found: Sequence[History]) -> tuple[Summary, ...]:
    """What a terminal shows."""
    out: list[Summary] = []
    for h in found:
        rows = tuple((e.name, e.what, (e.date or "")[:10], _short(e.said)) for e in h.entries)
        out.append(SummaryTable((f"robot {h.robot}", "what", "date", "verdict"), rows, words=4))
        growing = tuple(
            (s.name, f"{s.points[0].value:.4g}", f"{s.points[-1].value:.4g}", f"{t.low:+.3g} … {t.high:+.3g}", s.unit)
            for s in h.series
            if (t := s.trend) is not None
        )
        if growing:
            out.append(SummaryTable(("grows or falls", "first", "last", "95 % of the change", "unit"), growing))
        out += [SummaryLine(note, "doubt") for note in h.notes]
        out.append(SummaryLine(h.sentence, "undecided" if h.trends else "good"))
    return tuple(out)


def _short(said: str) -> str:
    first = said.partition(". ")[0].rstrip(".")
    return first if len(first) <= 90 else first[:89] + "…"
