"""What a sentinel says of later recordings: data, what a terminal shows, and a page with trends."""

from __future__ import annotations

from typing import Any

import numpy as np

from modcal_core.files import to_json
from modcal_core.moves import series_of
from modcal_core.report.as_json import picked
from modcal_core.report.blocks import Block, Figures, Listing, Section, Summary, SummaryLine, TableBlock, VerbResult
from modcal_core.report.charts import AFTER, BAD, BEFORE, SOFT, Axis, Chart, Panel
from modcal_core.report.page import Page, files_section
from modcal_core.report.tables import csv_text
from modcal_core.sentinel import ArmVerdict

_HEADINGS = {"unchanged": ("No change is seen", "good"), "changed": ("The arm has changed", "bad")}
_LINKS = "This is no measurement: measure the ten stations of stations.csv, and let modcal check say what to repair."
_DAY = 86400.0  # s


def sentinel_report(found: ArmVerdict, robot: str) -> VerbResult:
    """A verdict as a verb leaves it. robot: its name."""
    data = _data(found, robot)
    files = {"sentinel.json": to_json(data)}
    if found.changes:
        files["stations.csv"] = csv_text(found.joints, found.stations, ".6f")
    heading, tone = _HEADINGS.get(found.status, ("Cannot tell", "warn"))
    lines = [
        f"Evidence: {found.log_e:.1f} nats of {found.asked:.1f} that a change needs (one false alarm in a hundred "
        f"hours), the recordings counting by the power {found.weight:.2g}.",
        f"These signals do not show: {', '.join(found.unseen) or 'nothing of what was asked'}.",
        *(
            [f"Not judged, outside the reference period or no torques: {', '.join(found.untold)}."]
            if found.untold
            else []
        ),
        *([_LINKS] if found.changes else []),
    ]
    blocks: list[Block] = [
        Listing(lines),
        Section("trends", "Every recording by itself", [Figures(_trends(found))], "Trends"),
    ]
    blocks += [Section("noticed", "What would have been noticed", [_noticed(found)], "Noticed")]
    page = Page(f"{robot}: has it changed?", found.sentence, [*blocks, files_section(files)], heading, tone).html()
    return VerbResult(data, _summary(found), {**files, "sentinel.html": page}, "Sentinel", "sentinel.html")


def _data(found: ArmVerdict, robot: str) -> dict[str, Any]:
    return {
        "modcal_sentinel": 1,
        "robot": robot,
        **picked(found, "status", "asked", "weight", "hours", "unseen", verdict="sentence", outside="untold"),
        "log_e": found.log_e if np.isfinite(found.log_e) else None,
        "changes": [
            {**picked(c, "kind", "place", "label", "sentence", "since", "probability", "same_as"),
             "sizes": [{**picked(s, "name", "value", "unit"), "ci95": [s.low, s.high]} for s in c.sizes]}
            for c in found.changes
        ],
        "would_have_been_noticed": {label: {"size": s, "unit": unit} for label, (s, unit) in found.noticed.items()},
        "bags": [
            {**picked(b, "name", "began", "reference", "share"),
             "values": {label: {"unit": u, "value": v, "std": s} for label, (u, v, s) in b.values.items()}}
            for b in found.bags
        ],
    }  # fmt: skip


def _summary(found: ArmVerdict) -> tuple[Summary, ...]:
    out: list[Summary] = []
    rows = tuple((c.label, s.name, f"{s.value:+.4g}", f"{s.low:.4g} … {s.high:.4g}", s.unit, c.since)
                 for c in found.changes for s in c.sizes)  # fmt: skip
    if rows:
        head = ("change", "size", "value", "95 % interval", "unit", "since")
        out.append(TableBlock("", head, rows, 2))
    if found.unseen:
        out.append(SummaryLine(f"These signals do not show: {', '.join(found.unseen)}.", "doubt"))
    if found.untold:
        out.append(SummaryLine(_not_judged(found), "doubt"))
    tone = {"unchanged": "good", "changed": "bad"}.get(found.status, "warn")
    out.append(SummaryLine(found.sentence, tone))  # type: ignore[arg-type]
    if found.changes:
        out.append(SummaryLine(_LINKS, "legend"))
    return tuple(out)


def _not_judged(found: ArmVerdict) -> str:
    return f"Not judged, for outside the reference period, or no torques: {', '.join(found.untold)}."


def _noticed(found: ArmVerdict) -> TableBlock:
    rows = tuple((label, f"{size:.3g}", unit) for label, (size, unit) in found.noticed.items())
    below = "In 95 of 100 cases, by the last recording alone, if nothing else changed."
    return TableBlock("", ("change", "size", "unit"), rows, below=below)


def _trends(found: ArmVerdict) -> list[Chart]:
    """A chart of each change that is named or whose values grow; of all where there is none."""
    series = series_of([(b.name, b.began, {label: (u, v, s, False) for label, (u, v, s) in b.values.items()})
                        for b in found.bags])  # fmt: skip
    named = {c.label for c in found.changes} | {label for c in found.changes for label in c.same_as}
    shown = [s for s in series if s.name in named or s.trend is not None] or list(series)
    reference, first = {b.name for b in found.bags if b.reference}, min(b.began for b in found.bags)
    out = []
    for k, one in enumerate(shown):
        t = np.array([(p.time - first) / _DAY for p in one.points])
        x, std = np.array([p.value for p in one.points]), np.array([p.std for p in one.points])
        panel = Panel(
            Axis.around("days", t), Axis.around(f"{one.name}, {one.unit}", np.r_[x - 2.0 * std, x + 2.0 * std])
        )
        for at, value, s in zip(t, x, std, strict=True):
            panel.line(np.array([at, at]), np.array([value - 2.0 * s, value + 2.0 * s]), SOFT, 0.8)
        old = np.array([p.entry in reference for p in one.points])
        panel.marks(t[old], x[old], BEFORE, "circle")
        panel.marks(t[~old], x[~old], BAD if one.name in named else AFTER, "square")
        alt = f"{one.name}: {x[-1]:+.3g} {one.unit} in the last recording"
        out.append(panel.chart(f"trend{k}", alt, "circles: reference; squares: later; lines: 95 %"))
    return out
