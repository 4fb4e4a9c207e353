"""Stations that miss by far more than the others. They are left out before the scan; no effect stands for them."""

from __future__ import annotations

from modcal_core.effects.family import Family, ReportEntry, no_candidates

NAME = "outliers"


def sentence(entry: ReportEntry) -> str:
    """How many stations."""
    count = round(entry.sizes["stations"][0])
    stations = "1 station misses" if count == 1 else f"{count} stations miss"
    return f"{stations} by far more than the others and {'was' if count == 1 else 'were'} left out of the fit"


FAMILY = Family(NAME, no_candidates, sentence=sentence)
