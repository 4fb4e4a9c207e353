"""Where to look: an open verdict says what the rest depends on, and what lies outside what a calibration has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from modcal_core.robots import Mechanism
from modcal_core.verdict.case import Case
from modcal_core.verdict.verdict import Reason, Verdict


def with_places(
    judged: Verdict, case: Case, outside: Sequence[str] = (), described: Mechanism | None = None
) -> Verdict:
    """An open verdict with sentences that say where; any other as it is.

    outside: sentences on what lies outside what a frozen calibration has seen. described: the arm before it was fitted;
    None for that of the case. The sentences explain the reasons that
    are there and are none of their own: they have the kind "predictable", which stands in the way of no tolerance.
    """
    if judged.status != "open":
        return judged
    from modcal_core.verdict.places import sentences  # two dozen files, which other verdicts do not need

    said = sentences(judged, case, outside, described)
    return replace(judged, reasons=(*judged.reasons, *(Reason("predictable", sentence) for sentence in said)))
