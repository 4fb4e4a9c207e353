"""Single readings that are plainly wrong. They are found before the scan and left out; no effect stands for them."""

from __future__ import annotations

from modcal_core.effects.family import Family, ReportEntry, no_candidates

NAME = "outliers"


def sentence(entry: ReportEntry) -> str:
    """How many stations."""
    count = round(entry.sizes["stations"][0])
    stations = "1 station is a gross outlier and was" if count == 1 else f"{count} stations are gross outliers and were"
    return f"{stations} left out"


FAMILY = Family(NAME, no_candidates, sentence=sentence)
