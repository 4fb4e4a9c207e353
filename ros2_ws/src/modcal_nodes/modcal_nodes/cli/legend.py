"""What the columns of a table mean, said below it."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

Columns = Mapping[str, str]  # heading: its meaning; empty where the heading says it all


def table(columns: Columns, words: int = 1) -> Table:
    """An empty table with these headings. words: how many columns, from the left, hold words; the others numbers."""
    made = Table(box=None, header_style="bold", pad_edge=False)
    for i, heading in enumerate(columns):
        # a name stays whole, and no digit is left out, however narrow the terminal
        made.add_column(heading, justify="left" if i < words else "right", overflow="fold", no_wrap=i == 0)
    return made


def explain(columns: Columns, console: Console) -> None:
    """Print what each heading means, a line each."""
    for heading, meaning in columns.items():
        if meaning:
            console.print(f"  {heading}: {meaning}", style="dim", highlight=False)
