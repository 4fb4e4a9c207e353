"""A robot's history for programs and for people: entries one below the other, series as charts, and what grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.checking.history import Series, line
from modcal_core.report.page import Chart, PageTable, plain_page
from modcal_core.report.palette import AFTER
from modcal_core.report.panel import Panel
from modcal_core.report.summary import SummaryLine, SummaryTable

FORMAT = 1  # of history.json
_DAY = 86400.0
_CHARTS = 24  # most on a page; the table has all


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


def to_json_data(found: Sequence[History]) -> dict[str, Any]:
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


def summary(found: Sequence[History]) -> tuple[SummaryTable | SummaryLine, ...]:
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


def to_html(found: Sequence[History], title: str) -> str:
    """The page of all robots."""
    lines: list[str] = []
    tables: list[PageTable] = []
    charts: list[Chart] = []
    for k, h in enumerate(found):
        lines += [*(f"{h.robot}: {said}" for said in (h.trends or (h.sentence,))), *h.notes]
        rows = tuple((e.name, e.what, (e.date or "no date")[:16], e.said) for e in h.entries)
        tables.append(PageTable(f"Robot {h.robot}", ("name", "what", "date", "verdict"), rows, 4))
        head = ("quantity", "first", "last", "95 % of the change", "unit")
        tables.append(PageTable("Over time", head, _rows(h.series), 1, "A change is given where it is beyond chance."))
        several = [s for s in h.series if len(s.points) > 1]
        several.sort(key=lambda s: s.trend is None)
        charts += [_chart(s, f"r{k}s{i}") for i, s in enumerate(several[:_CHARTS])]
    grows = any(h.trends for h in found)
    return plain_page(
        title,
        " ".join(h.sentence for h in found),
        lines,
        charts,
        [("history.json", "all numbers, for programs")],
        tables,
        heading="Something grows" if grows else "Nothing grows",
        tone="warn" if grows else "good",
    )


def _chart(s: Series, name: str) -> Chart:
    t, y = line(s)
    days = (t - t[0]) / _DAY
    std = np.array([p.std for p in s.points])
    low, high = float((y - 2.0 * std).min()), float((y + 2.0 * std).max())
    room = 0.08 * max(high - low, 1e-9)
    margin = 0.04 * max(float(days[-1]), 1e-9)
    panel = Panel((-margin, float(days[-1]) + margin), (low - room, high + room))
    for day, value, spread in zip(days, y, std, strict=True):
        panel.line(np.array([day, day]), np.array([value - 1.96 * spread, value + 1.96 * spread]), AFTER, 0.8)
    panel.hollow(days, y, AFTER, "circle")
    if s.trend is not None:
        middle = float(np.average(y, weights=1.0 / np.maximum(std, 1e-12) ** 2))
        centre = float(np.average(days, weights=1.0 / np.maximum(std, 1e-12) ** 2))
        ends = np.array([0.0, float(days[-1])])
        panel.line(ends, middle + s.trend.change * (ends - centre) / max(float(days[-1]), 1e-9), AFTER, 1.2)
    alt = f"The {s.name} over {len(y)} entries: {y[0]:.3g} to {y[-1]:.3g} {s.unit}. {s.sentence}"
    return panel.chart(name, "days since the first", f"{s.unit}", alt, s.name)
