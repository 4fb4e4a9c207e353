"""Where to look: an open verdict says what the rest depends on, and what lies outside what a calibration has seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from modcal_core.calibration.agreeing import disagreement
from modcal_core.calibration.channels import disagreeing_channel
from modcal_core.diagnosis.dependence import dependence
from modcal_core.verdict.case import Case, derivatives, weights
from modcal_core.verdict.status import MOST_REJECTED
from modcal_core.verdict.verdict import Reason, Verdict


def with_places(judged: Verdict, case: Case, outside: Sequence[str] = ()) -> Verdict:
    """An open verdict with sentences that say where; any other as it is.

    outside: sentences on what lies outside what a frozen calibration has seen. The sentences explain the reasons that
    are there and are none of their own: they have the kind "predictable", which stands in the way of no tolerance.
    """
    if judged.status != "open":
        return judged
    rows = np.flatnonzero(~case.wrong) if case.fitted else case.held_out
    samples = case.samples.select(rows)
    fitted = derivatives(case.model, case.known.parameters, samples)[1] if case.fitted else None
    found = dependence(case.model, samples, weights(case.spread, samples), fitted)
    named = " ".join(judged.open_because)
    said = [*(sentence for sentence in outside if sentence not in named), *_apart(case)]
    if found is not None:
        said.append(f"What is left {found.sentence}.")
    return replace(judged, reasons=(*judged.reasons, *(Reason("predictable", sentence) for sentence in said)))


def _apart(case: Case) -> Iterator[str]:
    """What the rejected stations look like, where they are too many to be single wrong readings."""
    if case.wrong.mean() <= MOST_REJECTED:
        return
    other = None
    if case.wrong.mean() > 0.5:  # most of them: something is wrong throughout
        other = disagreeing_channel(case.samples, case.model.chain)
    other = other or disagreement(case.samples, case.model.chain)
    if other is not None:
        what = other.what[0].upper() + other.what[1:]
        yield f"{what} ({other.stations} of {other.of} stations that were looked at): {other.remedy}."
    if case.fitted:
        samples = case.samples.select(np.flatnonzero(case.wrong))
        found = dependence(case.model, samples, weights(case.spread, samples))
        if found is not None:
            yield f"What the rejected stations miss by {found.sentence}."
