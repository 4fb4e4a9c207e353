"""What a report says on one screen: tables, the account of the squared error among them, and sentences."""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.outcome import Outcome
from modcal_core.report.blocks import Summary, SummaryLine, legend, tone_of
from modcal_core.report.tables import account_tables, distances_table, effects_table, error_tables
from modcal_core.report.words import MAX_REASONS, sentence

# What stands in the tables, below them
_STAGES = {
    "nominal": "the robot description, base and tool fitted",
    "geometric": "lengths, angles and joint zeros corrected",
    "final": "the effects below as well",
}


def summary(report: Outcome) -> tuple[Summary, ...]:
    """Before and after, what the data could not tell, the effects, the account, and the verdict."""
    return tuple(_blocks(report))


def _blocks(report: Outcome) -> Iterator[Summary]:
    yield from error_tables(report)
    yield legend({stage: said for stage, said in _STAGES.items() if report.size_mm(stage) is not None})
    seen = report.identifiability
    if seen is not None:
        said = f"{seen.parameters} parameters, rank {seen.rank} (directions that the stations determine), "
        yield SummaryLine(said + f"condition {seen.condition:.0f} (largest over smallest singular value)")
        for name in seen.unobservable:
            yield SummaryLine(f"not determined by these stations: {name}", "doubt")
    if report.effects:
        effects = effects_table(report)
        yield effects
        yield SummaryLine(f"  {effects.below}", "legend")
        yield from map(SummaryLine, report.story)
    for note in report.notes:
        yield SummaryLine(note, "doubt")
    yield from distances_table(report.by_distances)
    yield from account_tables(report.judged, fold=True)
    yield SummaryLine(sentence(report), tone_of(report.status))
    for reason in report.open_because[MAX_REASONS:]:
        yield SummaryLine(f"Open: {reason}", "reason")
    if report.claim is not None:
        yield SummaryLine(report.claim.sentence, "plain" if report.claim.apply else "doubt")
    if report.tolerance is not None:
        met = report.tolerance
        yield SummaryLine(f"{met.result}: {met.because}", tone_of(met.result))
