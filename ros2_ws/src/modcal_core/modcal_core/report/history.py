"""A robot's history for programs and for people: entries, series, and what grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from modcal_core.checking import Series
from modcal_core.report.terminal import SummaryLine, SummaryTable

FORMAT = 1  # of history.json


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
        "modcal_history": FORMAT,
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
    if s.trend is not None:
        t = s.trend
        trend = {"change": t.change, "ci95": [t.low, t.high], "share": t.share, "days": t.days, "sentence": s.sentence}
    points = [{"entry": p.entry, "value": p.value, "std": p.std} for p in s.points]
    return {"name": s.name, "unit": s.unit, "points": points, "trend": trend}


def history_summary(found: Sequence[History]) -> tuple[SummaryTable | SummaryLine, ...]:
    """What a terminal shows."""
    out: list[SummaryTable | SummaryLine] = []
    for h in found:
        rows = tuple((e.name, e.what, (e.date or "")[:10], _short(e.said)) for e in h.entries)
        out.append(SummaryTable((f"robot {h.robot}", "what", "date", "verdict"), rows, words=4))
        if growing := [s for s in h.series if s.trend is not None]:
            out.append(SummaryTable(("grows or falls", "first", "last", "95 % of the change", "unit"), _rows(growing)))
        out += [SummaryLine(note, "doubt") for note in h.notes]
        out.append(SummaryLine(h.sentence, "undecided" if h.trends else "good"))
    return tuple(out)


def _short(said: str) -> str:
    first = said.partition(". ")[0].rstrip(".")
    return first if len(first) <= 90 else first[:89] + "…"


def _rows(series: Sequence[Series]) -> tuple[tuple[str, ...], ...]:
    out = []
    for s in series:
        span = "" if s.trend is None else f"{s.trend.low:+.3g} … {s.trend.high:+.3g}"
        out.append((s.name, f"{s.points[0].value:.4g}", f"{s.points[-1].value:.4g}", span, s.unit))
    return tuple(out)
