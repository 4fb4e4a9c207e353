"""What the terminal shows of a report: its summary, in colours."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from modcal_core.outcome import Outcome
from modcal_core.report import SummaryLine, SummaryTable, Tone, summary

STYLES: dict[Tone, str] = {
    "plain": "",
    "legend": "dim",
    "doubt": "yellow",
    "good": "bold green",
    "bad": "bold red",
    "undecided": "bold yellow",
    "reason": "red",
}


def show_report(report: Outcome, console: Console) -> None:
    """Print before and after, what the data could not tell, and the verdict."""
    show_blocks(summary(report), console)


def show_blocks(blocks: Sequence[SummaryTable | SummaryLine], console: Console) -> None:
    """Print tables and sentences, each in the colour of its meaning."""
    for block in blocks:
        if isinstance(block, SummaryLine):
            console.print(block.text, style=STYLES[block.tone], highlight=False, markup=False)
        else:
            console.print(_table(block))


def _table(grid: SummaryTable) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for i, name in enumerate(grid.header):
        words = i < grid.words
        table.add_column(name, justify="left" if words else "right", overflow="fold" if words else "ellipsis")
    for row in grid.rows:
        table.add_row(*row)
    return table
