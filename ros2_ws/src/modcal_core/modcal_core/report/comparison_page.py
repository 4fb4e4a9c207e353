"""The comparison of two calibrations or reports for people: as text for a terminal, and as a page."""

from __future__ import annotations

from typing import Any

import numpy as np

from modcal_core.report.comparison import Comparison, ParameterDifference, to_json_data
from modcal_core.report.effect_tables import size_tables
from modcal_core.report.page import Chart, render
from modcal_core.report.palette import AFTER
from modcal_core.report.panel import Panel
from modcal_core.report.summary import SummaryLine, SummaryTable, Tone, legend

TONES: dict[str, str] = {"same": "good", "within tolerance": "good", "beyond tolerance": "bad"}
_HEADINGS = {
    "same": "no difference shown",
    "differs": "they differ",
    "within tolerance": "they differ, within the tolerance",
    "beyond tolerance": "they differ, beyond the tolerance",
    "cannot tell": "cannot tell",
}
_LARGEST = 12  # parameters on a terminal
_LEGEND = {
    "±": "one standard deviation",
    "difference": "the second minus the first",
    "shown": "whether it is more than the uncertainty of both explains, at 95 % for all parameters together",
    "of base or tool": "base and tool take it up",
}
_KINDS = (("m", "mm", 1e3, "Lengths"), ("rad", "mrad", 1e3, "Angles"))


def to_html(found: Comparison) -> str:
    """The page."""
    first, second = (side.name for side in found.sides)
    data = to_json_data(found)
    return render(
        "comparison.html.j2",
        title=f"Comparison: {first} and {second}",
        heading=_HEADINGS[found.result],
        tone=TONES.get(found.result, "warn"),
        verdict=found.sentence,
        data=data,
        groups=_groups(found),
        effects=found.effects,
        sizes=size_tables(
            [((e["effect"],), [e["first"], e["second"]]) for e in data["effects"]], ("effect", first, second)
        ),
        charts=_charts(found),
    )


def summary(found: Comparison) -> tuple[SummaryTable | SummaryLine, ...]:
    """What a terminal shows: errors, tool, the parameters that differ most for their uncertainty, effects, result."""
    names = tuple(side.name for side in found.sides)
    out: list[SummaryTable | SummaryLine] = []
    data = to_json_data(found)
    rows = []
    for side in data["sides"]:
        e = side["error_mm"] or {}
        numbers = [f"{e[k]:.3f}" if k in e else "" for k in ("mean", "rms", "p95", "max")]
        rows.append((side["name"], *numbers, side["status"] or "", side["tolerance"] or ""))
    header = ("error on scored stations", "mean mm", "RMS mm", "95 % mm", "max mm", "status", "tolerance")
    out.append(SummaryTable(header, tuple(rows)))
    for title, unit, factor, part in _parts(found):
        ranked = sorted(part, key=_by_weight)[:_LARGEST]
        lines = tuple(_cells(p, factor) for p in ranked)
        if lines:
            head = (f"{title.lower()}, {unit}", *names, "difference", "95 % interval", "shown")
            out.append(SummaryTable(head, lines))
        if len(part) > len(ranked):
            out.append(SummaryLine(f"{len(part) - len(ranked)} more are in comparison.json and on the page."))
    if any(part for *_, part in _parts(found)):
        out.append(legend(_LEGEND))
    if found.effects:
        rows = [(e.name, *("yes" if s is not None else "no" for s in (e.first, e.second))) for e in found.effects]
        out.append(SummaryTable(("effect", *names), tuple(rows)))
    out += [SummaryLine(note, "doubt") for note in found.notes]
    tones: dict[str, Tone] = {"good": "good", "bad": "bad"}
    out.append(SummaryLine(found.sentence, tones.get(TONES.get(found.result, ""), "undecided")))
    return tuple(out)


def _by_weight(p: ParameterDifference) -> tuple[bool, float]:
    """What is shown first, the largest for its uncertainty before the others."""
    return p.shown is None, -abs(p.difference or 0.0) / (p.std or np.inf)


def _parts(found: Comparison) -> list[tuple[str, str, float, list[ParameterDifference]]]:
    """Parameters by unit, those of the arm: a table never mixes two units."""
    arm = [p for p in found.parameters if not p.name.startswith(("frame ", "tool/", "instrument "))]
    parts = [(title, unit, factor, [p for p in arm if p.unit == si]) for si, unit, factor, title in _KINDS]
    others = sorted({p.unit for p in arm} - {"m", "rad"})
    parts += [(f"Others in {unit}", unit, 1.0, [p for p in arm if p.unit == unit]) for unit in others]
    return [part for part in parts if part[3]]


def _cells(p: ParameterDifference, factor: float) -> tuple[str, ...]:
    def said(pair: tuple[float, float] | None) -> str:
        return "not fitted" if pair is None else f"{factor * pair[0]:.4f} ± {factor * pair[1]:.4f}"

    difference = "" if p.difference is None else f"{factor * p.difference:+.4f}"
    span = ""
    if p.difference is not None and p.std is not None:
        low, high = (factor * (p.difference + k * 1.96 * p.std) for k in (-1.0, 1.0))
        span = f"{low:.4f} … {high:.4f}"
    return (
        p.name,
        said(p.first),
        said(p.second),
        difference,
        span,
        {True: "yes", False: "no", None: "" if p.difference is None else "of base or tool"}[p.shown],
    )


def _groups(found: Comparison) -> list[dict[str, Any]]:
    """Tables of parameters, angles before lengths."""
    out = []
    for title, unit, factor, part in _parts(found):
        out.append({"title": title, "unit": unit, "rows": [(_cells(p, factor), p.shown) for p in part]})
    return sorted(out, key=lambda g: g["unit"] != "mrad")


def _charts(found: Comparison) -> list[Chart]:
    """Table of the difference over the workspace."""
    tool = found.tool
    if tool is None:
        return []
    size = 1e3 * np.linalg.norm(tool.apart, axis=1)
    over = (
        ("distance of the tool from the base axis, m", np.hypot(*tool.points[:, :2].T)),
        ("height of the tool, m", tool.points[:, 2]),
    )
    out = []
    for k, (words, x) in enumerate(over):
        low, high = float(x.min()), float(x.max())
        margin = 0.04 * max(high - low, 1e-6)
        panel = Panel((low - margin, high + margin), (0.0, 1.1 * max(float(size.max()), 1e-6)))
        panel.hollow(x, size, AFTER, "circle")
        alt = f"Difference at the tool against the {words}: {tool.size_mm.rms:.3f} mm RMS."
        out.append(panel.chart(f"apart{k}", words, "difference, mm", alt, f"against the {words.partition(',')[0]}"))
    return out
