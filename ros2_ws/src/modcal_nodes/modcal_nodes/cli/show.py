"""What the terminal shows: tables and a sentence."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from modcal_core.report.account import Account, accounts
from modcal_core.report.report import STAGES, Report
from modcal_core.report.sentence import MAX_REASONS
from modcal_core.verdict.verdict import Status

STYLES: dict[Status, str] = {"at_floor": "bold green", "open": "bold red", "cannot_tell": "bold yellow"}


def show_report(report: Report, console: Console) -> None:
    """Print before and after, what the data could not tell, and the verdict."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column(f"held-out error ({report.sets.unit}s)")
    for name in ("mean mm", "RMS mm", "95 % mm", "max mm", "RMS deg"):
        table.add_column(name, justify="right")
    for stage in STAGES:
        size, angle = report.size_mm(stage), report.size_deg(stage)
        if size is not None:
            numbers = [f"{x:.3f}" for x in (size.mean, size.rms, size.p95, size.max)]
            table.add_row(stage, *numbers, "" if angle is None else f"{angle.rms:.4f}")
    console.print(table)
    seen = report.identifiability
    if seen is not None:
        console.print(f"{seen.parameters} parameters, rank {seen.rank}, condition {seen.condition:.0f}")
        for name in seen.unobservable:
            console.print(f"not shown by these stations: {name}", style="yellow", highlight=False)
    if report.effects:
        console.print(_effects(report))
        for sentence in report.story:
            console.print(sentence, highlight=False)
    for note in report.notes:
        console.print(note, style="yellow", highlight=False)
    for one in accounts(report.judged):
        console.print(_account(one))
    console.print(report.verdict, style=STYLES[report.status], highlight=False, markup=False)
    for reason in report.judged.open_because[MAX_REASONS:] if report.judged is not None else ():
        console.print(f"Open: {reason}", style="red", highlight=False, markup=False)
    if report.tolerance is not None:
        style = {"PASS": "bold green", "FAIL": "bold red"}.get(report.tolerance.result, "bold yellow")
        console.print(f"{report.tolerance.result}: {report.tolerance.because}", style=style, highlight=False)


def _account(one: Account) -> Table:
    """Where the squared error of the nominal model went."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("account of the squared error", overflow="fold")
    for name in (f"{one.unit}²", "95 % interval", "share"):
        table.add_column(name, justify="right")
    for line in one.lines:
        ends = "" if line.ci95 is None else f"{line.ci95[0]:.3g} … {line.ci95[1]:.3g}"
        numbers = (f"{line.value:.4g}", ends, f"{100.0 * line.share:.2f} %") if line.known else ("not known", "", "")
        table.add_row(line.words, *numbers)
    table.add_row("nominal model", f"{one.total:.4g}", "", "")
    return table


def _effects(report: Report) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("effect", "place", "direction", "driver"):
        table.add_column(name, overflow="fold")
    for name in ("p", "RMS mm before", "after"):
        table.add_column(name, justify="right")
    for f in report.effects:
        numbers = (f"{f.p_value:.1g}", f"{1e3 * f.before:.3f}", f"{1e3 * f.after:.3f}")
        table.add_row(f.family, f.place, f.direction, f.driver, *numbers)
    return table
