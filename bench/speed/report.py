"""The table of a run: on the screen, as Markdown, as JSON; and how times grow with N."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from timing import Row

HEADS = ("work", "modcal, ms", "other", "other, ms", "ratio", "remark")


def growth(rows: Sequence[Row]) -> dict[str, float]:
    """Exponent of N between the two largest sizes of the same work; 1 is linear."""
    sized: dict[str, dict[int, float]] = {}
    for row in rows:
        if row.size:
            sized.setdefault(re.sub(r", N = \d+", "", row.work), {})[row.size] = row.ms
    out = {}
    for work, by_size in sized.items():
        if len(by_size) > 1:
            (a, b) = sorted(by_size)[-2:]
            out[work] = float(np.log(by_size[b] / by_size[a]) / np.log(b / a))
    return out


def cells(row: Row) -> tuple[str, ...]:
    """A row in words."""
    digits = 1 if row.ms >= 10.0 else 2 if row.ms >= 1.0 else 3
    other = "" if row.peer_ms is None else f"{row.peer_ms:.{digits}f}"
    ratio = "" if row.ratio is None else f"{row.ratio:.1f} x" if row.ratio < 20.0 else f"{row.ratio:.0f} x"
    return row.work, f"{row.ms:.{digits}f}", row.peer, other, ratio, row.remark


def show(rows: Sequence[Row], scale: float) -> None:
    """Print the table."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for head in HEADS:
        table.add_column(head, justify="right" if "ms" in head or head == "ratio" else "left")
    group = rows[0].group if rows else ""
    for row in rows:
        if row.group != group:
            table.add_section()
            group = row.group
        table.add_row(*cells(row))
    console = Console(width=150)
    console.print(table)
    for work, exponent in growth(rows).items():
        console.print(f"{work}: grows with N to the {exponent:.2f}")
    console.print(f"this machine takes {scale:.2f} times as long as that of the published figures", highlight=False)


def write(rows: Sequence[Row], scale: float, folder: Path) -> None:
    """Write speed.md and speed.json into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    data = {"machine_scale": scale, "growth": growth(rows), "rows": [{**asdict(r), "ratio": r.ratio} for r in rows]}
    (folder / "speed.json").write_text(json.dumps(data, indent=1) + "\n")
    lines = ["| " + " | ".join(HEADS) + " |", "|" + "---|" * len(HEADS)]
    lines += ["| " + " | ".join(cells(row)) + " |" for row in rows]
    lines += ["", f"Machine: {scale:.2f} times the time of the one of the published figures."]
    lines += [f"{work}: N to the {exponent:.2f}." for work, exponent in growth(rows).items()]
    (folder / "speed.md").write_text("\n".join(lines) + "\n")
