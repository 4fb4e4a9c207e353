"""The bars of the README, from the table in docs/results.md: ``python scripts/bars.py`` writes docs/real_arms.svg.

The table stays the only place of the figures: a test compares the two.
"""

from __future__ import annotations

import html
import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE, PICTURE = ROOT / "docs" / "results.md", ROOT / "docs" / "real_arms.svg"
STAGES = ("nominal", "geometry", "with unmodelled effects")
LEFT, RIGHT, BAR, GAP, TOP = 335, 850, 13, 16, 44  # px
COLOURS = {  # on light paper and on dark
    "ink": ("#1c2430", "#e6eaf0"), "soft": ("#566172", "#a9b3c1"), "line": ("#d5dbe4", "#3a4350"),
    "paper": ("#ffffff", "#12161c"), "nominal": ("#b3263c", "#ff8f99"), "geometry": ("#b98a2b", "#e3b560"),
    "final": ("#2c6a38", "#7fcb8d"),
}  # fmt: skip
KEYS = ("nominal", "geometry", "final")


@dataclass(frozen=True)
class Row:
    """A recording: what it is, and its error by stage [mm]."""

    name: str
    about: str
    mm: tuple[float, ...]


def rows(text: str) -> list[Row]:
    """The rows of the first table of the page."""
    lines = re.search(r"^\| arm and instrument.*\n\| ---.*\n((?:\|.*\n)+)", text, re.MULTILINE)
    assert lines
    out = []
    for line in lines[1].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        name, _, about = cells[0].partition(", ")
        out.append(Row(name, about, tuple(float(re.match(r"[\d.]+", cell)[0]) for cell in cells[1:4])))  # type: ignore[index]
    return out


def svg(table: list[Row]) -> str:
    """The bars, one group a recording, on one scale from zero."""
    most = max(max(row.mm) for row in table)
    step = 3 * BAR + GAP
    parts, y = [], TOP
    for row in table:
        about = f'<text x="{LEFT - 12}" y="{y + 33}" class="about">{html.escape(row.about)}</text>'
        parts.append(f'<text x="{LEFT - 12}" y="{y + 15}" class="name">{html.escape(row.name)}</text>{about}')
        for k, (key, mm) in enumerate(zip(KEYS, row.mm, strict=True)):
            wide = max(2.0, (RIGHT - LEFT - 60) * mm / most)
            top = y + k * BAR
            parts.append(f'<rect class="{key}" x="{LEFT}" y="{top}" width="{wide:.1f}" height="{BAR - 2}"/>')
            parts.append(f'<text x="{LEFT + wide + 6:.1f}" y="{top + 10}" class="number">{mm:.2f}</text>')
        y += step
    legend = "".join(
        f'<rect class="{key}" x="{LEFT + 150 * k}" y="16" width="12" height="12"/>'
        f'<text x="{LEFT + 150 * k + 18}" y="27" class="legend">{stage}</text>'
        for k, (key, stage) in enumerate(zip(KEYS, STAGES, strict=True))
    )
    said = "; ".join(f"{r.name}: {', '.join(f'{v:.2f}' for v in r.mm)}" for r in table)
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 860 {y + 6}" width="860" height="{y + 6}" role="img" aria-labelledby="what">
<title id="what">Held-out error on real arms in mm, with the nominal model, with corrected geometry, and with unmodelled effects. {html.escape(said)}.</title>
<style>
svg {{ {_colours(0)} font-family: system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }}
@media (prefers-color-scheme: dark) {{ svg {{ {_colours(1)} }} }}
.card {{ fill: var(--paper); stroke: var(--line); }}
text {{ fill: var(--soft); font-size: 12px; }}
.name {{ fill: var(--ink); font-size: 14px; font-weight: 600; text-anchor: end; }}
.about {{ text-anchor: end; }}
.number {{ fill: var(--ink); font-size: 11px; }}
.nominal {{ fill: var(--nominal); }} .geometry {{ fill: var(--geometry); }} .final {{ fill: var(--final); }}
</style>
<rect class="card" x="0.5" y="0.5" width="859" height="{y + 5}" rx="10"/>
<text x="{LEFT - 12}" y="27" class="about">held-out error, mm RMS</text>{legend}
{"".join(parts)}
</svg>
"""  # noqa: E501


def _colours(scheme: int) -> str:
    return " ".join(f"--{name}: {pair[scheme]};" for name, pair in COLOURS.items())


def main() -> None:
    """Draw."""
    PICTURE.write_text(svg(rows(TABLE.read_text(encoding="utf-8"))), encoding="utf-8")


if __name__ == "__main__":
    main()
