"""The history of an arm over its calibrations and checks, for programs and for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from modcal_core.files import to_json
from modcal_core.moves import Series
from modcal_core.report.as_json import picked
from modcal_core.report.blocks import Summary, SummaryLine, TableBlock, VerbResult

_MAX_SAID = 90  # characters of a verdict in a table


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
    def sentence(self) -> str:
        """The answer, as text."""
        trends = [s.sentence for s in self.series if s.trend is not None]
        seen = f"{len(self.entries)} calibrations and checks"
        return " ".join(trends) or f"Nothing grows or falls beyond chance over {seen}."


def history_report(found: Sequence[History]) -> VerbResult:
    """The history of some robots as a verb leaves it."""
    data = {
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
    said = [block for h in found for block in _shown(h)]
    return VerbResult(data, said, {"history.json": to_json(data)}, "History", "history.json")


def _series(s: Series) -> dict[str, Any]:
    trend = None
    if (t := s.trend) is not None:
        trend = {**picked(t, "change", "share", "days"), "ci95": [t.low, t.high], "sentence": s.sentence}
    return {
        **picked(s, "name", "unit"),
        "points": [picked(p, "entry", "value", "std") for p in s.points],
        "trend": trend,
    }


def _shown(h: History) -> list[Summary]:
    """What a terminal shows of a robot."""
    rows = tuple((e.name, e.what, (e.date or "")[:10], _short(e.said)) for e in h.entries)
    out: list[Summary] = [TableBlock("", (f"robot {h.robot}", "what", "date", "verdict"), rows, words=4)]
    growing = tuple(
        (s.name, f"{s.points[0].value:.4g}", f"{s.points[-1].value:.4g}", f"{t.low:+.3g} … {t.high:+.3g}", s.unit)
        for s in h.series
        if (t := s.trend) is not None
    )
    if growing:
        out.append(TableBlock("", ("grows or falls", "first", "last", "95 % of the change", "unit"), growing))
    out += [SummaryLine(note, "doubt") for note in h.notes]
    return [*out, SummaryLine(h.sentence, "warn" if growing else "good")]


def _short(said: str) -> str:
    first = said.partition(". ")[0].rstrip(".")
    return first if len(first) <= _MAX_SAID else first[: _MAX_SAID - 1] + "…"
