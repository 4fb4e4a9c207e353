"""A check, and what a sentinel says, for programs and for people: data, what a terminal shows, and a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from modcal_core.checkup import Checked
from modcal_core.files import to_json
from modcal_core.moves import NamedChange, SizeFound, series_of
from modcal_core.report.blocks import (
    Figures,
    Page,
    Section,
    SummaryLine,
    TableBlock,
    Tone,
    VerbResult,
    tone_of,
)
from modcal_core.report.charts import AFTER, BAD, BEFORE, SOFT, Axis, Chart, Panel
from modcal_core.report.report import claim_data, finite, picked, tolerance_data
from modcal_core.report.tables import csv_text, percent, stations_table, tolerance_lines
from modcal_core.sentinel import ArmVerdict

_OF_STATUS: dict[str, tuple[str, Tone]] = {
    "unchanged": ("No change is seen", "good"),
    "changed": ("The arm has changed", "bad"),
}
_LINKS = "This is no measurement: measure the ten stations of stations.csv, and let modcal check say what to repair."
_NOTICED = "By the last recording alone, if nothing else changed, 95 times in 100."
_DAY = 86400.0  # s


def sentinel_report(found: ArmVerdict, robot: str) -> VerbResult:
    """A verdict as a verb leaves it. robot: its name."""
    data = _data(found, robot)
    files = {"sentinel.json": to_json(data)}
    if found.changes:
        files["stations.csv"] = csv_text(found.joints, found.stations, ".6f")
    heading, tone = _OF_STATUS.get(found.status, ("Cannot tell", "warn"))
    lines: list[str | SummaryLine] = [
        f"Evidence: {found.log_e:.1f} nats of {found.asked:.1f} that a change needs (one false alarm in a hundred "
        f"hours), by {found.references} reference recordings; with more a change needs less.",
        SummaryLine(f"These signals do not show: {', '.join(found.unseen) or 'nothing of what was asked'}.", "doubt"),
    ]
    if found.untold:
        said = f"Not judged (missing, outside the reference, or no torques): {', '.join(found.untold)}."
        lines.append(SummaryLine(said, "doubt"))
    lines += [_LINKS] if found.changes else []
    tables = [_changes(data["changes"])]
    sizes = tuple((label, f"{size:.3g}", unit) for label, (size, unit) in found.noticed.items())
    noticed = TableBlock("", ("change", "size", "unit"), sizes, below=_NOTICED)
    blocks = [
        Section("changes", "What changed", tables, "Changes"),
        Section("trends", "Every recording by itself", [Figures(_trends(found))], "Trends"),
        Section("noticed", "What would have been noticed", [noticed], "Noticed"),
    ]
    page = Page(f"{robot}: has it changed?", found.sentence, blocks, heading, tone, lines=lines)
    return page.result(data, files, tables, "Sentinel", "sentinel.html")


def _data(found: ArmVerdict, robot: str) -> dict[str, Any]:
    return {
        "modcal_sentinel": 1,
        "robot": robot,
        **picked(found, "status", "asked", "references", "hours", "unseen", verdict="sentence", outside="untold"),
        "log_e": found.log_e if np.isfinite(found.log_e) else None,
        "changes": [
            {**picked(c, "kind", "place", "label", "sentence", "since", "probability", "same_as"), **_sized(c.sizes)}
            for c in found.changes
        ],
        "would_have_been_noticed": {label: {"size": s, "unit": unit} for label, (s, unit) in found.noticed.items()},
        "bags": [
            {**picked(b, "name", "began", "reference", "share"),
             "values": {label: {"unit": u, "value": v, "std": s} for label, (u, v, s) in b.values.items()}}
            for b in found.bags
        ],
    }  # fmt: skip


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
        ends = np.stack([x - 2.0 * std, x + 2.0 * std], axis=1)
        panel = Panel(Axis.around("days", t), Axis.around(f"{one.name}, {one.unit}", ends))
        for at, two in zip(t, ends, strict=True):
            panel.line(np.array([at, at]), two, SOFT, 0.8)
        old = np.array([p.entry in reference for p in one.points])
        panel.marks(t[old], x[old], BEFORE, "circle")
        panel.marks(t[~old], x[~old], BAD if one.name in named else AFTER, "square")
        alt = f"{one.name}: {x[-1]:+.3g} {one.unit} in the last recording"
        out.append(panel.chart(f"trend{k}", alt, "circles: reference; squares: later; lines: 95 %"))
    return out


_HEADINGS = {
    "unchanged": "Nothing has changed",
    "changed": "Something has changed",
    "ambiguous": "Something has changed; these stations cannot tell which",
    "unexplained": "Something has changed that is not explained",
}


def _sized(sizes: Sequence[SizeFound]) -> dict[str, Any]:
    """Sizes of a change for JSON."""
    return {"sizes": [{**picked(s, "name", "value", "unit"), "ci95": [s.low, s.high]} for s in sizes]}


def _changes(changes: Sequence[Mapping[str, Any]]) -> TableBlock:
    """The sizes of changes, as JSON has them, and where it says so since when."""
    rows = [
        {**c, **size, "interval": size["ci95"] if len(set(size["ci95"])) > 1 else ()}
        for c in changes
        for size in c["sizes"]
    ]
    header = "change | size | value | 95 % interval | unit"
    cells = "{label} | {name} | {value:+.4g} | {interval:.3g} | {unit}"
    if any("since" in c for c in changes):
        header, cells = f"{header} | since", f"{cells} | {{since}}"
    below = "Of a base: in the frame of the first joint. Of a tool: in its own."
    return TableBlock.of("What changed", header, cells, rows, words=2, below=below, heading=True)


def checkup_data(found: Checked, calibration: str = "") -> dict[str, Any]:
    """The data of check.json. calibration: the name of what was checked."""
    return {
        "modcal_check": 1,
        "calibration": calibration,
        **picked(found.report.trace, "robot", "date"),
        **picked(found, "status", "stations", "convention", "notes", verdict="sentence", set_aside="aside"),
        "chance_of_false_alarm_below": found.chance,
        "changes": [_change(c) for c in found.changes],
        "error_mm": {"frozen": found.before[0], "expected": found.expected[0], "with_changes": found.after[0]},
        "error_deg": {"frozen": found.before[1], "expected": found.expected[1], "with_changes": found.after[1]},
        "would_have_been_noticed_mm": {n.label: finite(n.mm) for n in found.noticed},
        "not_noticed": [label for n in found.noticed for label in n.unseen],
        **picked(found.advice, "action", advice="sentence"),
        "stations_to_add": [
            {name: float(x) for name, x in zip(found.joints, q, strict=True)} for q in found.advice.stations
        ],
        "repaired": found.repaired is not None,
        **claim_data(found.report.claim),
        "tolerance": tolerance_data(found.report.tolerance),
    }


def _change(c: NamedChange) -> dict[str, Any]:
    return {
        **picked(c, "kind", "place", "label", "sentence", "turned_deg", "probability", "same_as", "repairable"),
        **_sized(c.sizes),
        "moved_mm": {"rms": c.moved_mm[0], "ci95": [c.moved_mm[1], c.moved_mm[2]]},
        "same_at_every_posture": bool(c.alike),
        "same_orientation": c.alike == "poses",
    }


def checkup_report(found: Checked, calibration: str, recording: str, others: Mapping[str, str]) -> VerbResult:
    """The check as a verb leaves it. calibration, recording: their names. others: files beside those of the check."""
    data = checkup_data(found, calibration)
    files = {"check.json": to_json(data)}
    if len(found.advice.stations):
        files["stations.csv"] = csv_text(found.joints, found.advice.stations, ".6f")
    heading, tone = _HEADINGS[found.status], tone_of(found.status)
    if found.status == "unchanged" and found.alike:
        heading, tone = "No change is seen", "warn"
    judged, met = "Repaired model:" if found.repaired is not None else "Frozen model:", found.report.tolerance
    lines: list[str | SummaryLine] = [f"What to do: {found.advice.sentence}"]
    lines += tolerance_lines(met, f"{judged} ")
    if found.report.claim is not None:
        lines.append(f"{judged} {found.report.claim.sentence}")
    lines.append(
        f"While nothing has changed, as much is named by chance in fewer than {_rarely(found.chance)} checks."
        if found.changes
        else "A change is named when stations show as much by chance in fewer than one of a hundred checks."
    )
    if found.convention:
        lines.append(f"Readings were undone to be used: {found.convention}.")
    lines += [SummaryLine(note, "doubt") for note in found.notes]
    seen = _seen(data)
    blocks = [Section("seen", "What was seen", [*seen, *_beside(found), *_station_errors(found)])]
    page = Page(f"{calibration}, checked by {recording}", found.sentence, blocks, heading, tone, lines=lines)
    return page.result(data, {**files, **others}, seen, "Check", "check.html")


def _rarely(chance: float) -> str:
    return f"one in {1.0 / max(chance, 1e-12):,.0f}".replace(",", " ") if chance > 1e-12 else "one in 10¹²"


_ERRORS = ("error_mm", "error_deg")


def _seen(data: Mapping[str, Any]) -> list[TableBlock]:
    """The errors, what changed, and what would have been noticed, from the data of check.json."""
    stages = {"frozen": "frozen model", "expected": "expected while nothing has changed"}
    stages |= {"with_changes": "with what changed"} if data["changes"] else {}
    rows = [{"model": words, **{of: data[of][stage] for of in _ERRORS}} for stage, words in stages.items()]
    noticed = tuple((n, f"{mm:.3f}") for n, mm in data["would_have_been_noticed_mm"].items() if mm is not None)
    below = "RMS at the tool over these stations, of the direction that shows least."
    if unseen := ", ".join(data["not_noticed"]):
        below += f" These stations do not show: {unseen}."
    title, by_model = f"Error at {data['stations']} stations", "{model} | {error_mm:.3f} | {error_deg:.4f}"
    found = TableBlock("Noticed in 95 of 100 such checks", ("change", "RMS, mm"), noticed, below=below, heading=True)
    errors = TableBlock.of(title, "model | RMS mm | RMS deg", by_model, rows, heading=True)
    return [errors, _changes(data["changes"]), found]


def _beside(found: Checked) -> list[TableBlock]:
    """What explains the stations as well, and stations to add."""
    changes = found.changes
    rivals = tuple((c.label, ", ".join(c.same_as) or "none", c.alike, percent(c.probability, 1)) for c in changes)
    columns = ("named", "explains these stations as well", "the same at every posture", "probability")
    return [
        TableBlock("What it may as well be", columns, rivals, 3, heading=True),
        stations_table("Stations to add", found.joints, np.asarray(found.advice.stations)),
    ]


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
