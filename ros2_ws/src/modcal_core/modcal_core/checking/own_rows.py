"""Readings of a check that are no arm's with one base and one tool: rows mixed up, a move in between, joints elsewhere.

No change since the calibration explains those, and what comes nearest would be named instead.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import Model
from modcal_core.errors import BadRecording
from modcal_core.hypotheses import HandEye, explain
from modcal_core.moves import BASE, FRAME, GEAR, LINK, LOAD, PLAY, STEP, TOOL, ZERO, FoundChanges

_MIN = 8  # stations, of which most must agree before others are said to be wrong
_CHANGES = (BASE, FRAME, TOOL, ZERO, GEAR, LOAD, LINK, PLAY)  # no other metre, links or scatter
_MOVED = {BASE: "the base (or the tracker)", TOOL: "the tool (or the target on it)"}


def require_accounted(found: FoundChanges, doubt: BadRecording | None, model: Model) -> None:
    """Raises BadRecording unless what was found explains the readings, as an arm's with one base and one tool.

    A curve that may take any course has a number for every station, so that only one of them counts. Where nothing
    else is wrong with the recording it is the doubt. model: frozen.
    """
    curves = sum(c.hypothesis.free for c in found.changes)
    explained = not found.more and curves < 2 and all(c.hypothesis.kind in _CHANGES for c in found.changes)
    step = next((c.hypothesis.effect for c in found.changes if c.hypothesis.kind == STEP), None)
    if step is not None and not found.more:
        samples = found.samples.select(np.argsort(found.samples.stamps, kind="stable"))
        k = int(np.searchsorted(samples.stamps, step.shape.settings["at"]))
        between = f"stations {samples.station[k - 1] + 1} and {samples.station[k] + 1} of this recording"
        raise BadRecording(
            f"{_MOVED[step.place]} moved between {between}",
            "the stations before and those after agree in themselves, and no change before all of them explains both",
            "fix it, and check again with stations that were all taken afterwards",
        )
    if not explained or (doubt is not None and not found.changes):
        _require_own_rows(found, doubt, model)


def _require_own_rows(found: FoundChanges, doubt: BadRecording | None, model: Model) -> None:
    """Raises BadRecording where readings agree with the arm once some mistake is undone, else the doubt."""
    case = HandEye.of(found.samples, model.with_effects(()).chain)
    if case is not None and len(case) >= _MIN and np.ptp(case.q, axis=0).all():  # of joints that stand it is said
        answer = explain(replace(case, station=case.station + 1))  # as people count them
        if answer.said and (doubt is not None or all(h.touches == "rows" for h in answer.said)):
            seen = "" if doubt is None else f"{doubt.limit}; "
            why = f"{answer.stations} of {len(case)} stations are concerned, and agree with the arm once that is undone"
            raise BadRecording(answer.what, seen + why, f"{answer.remedy}, and check again")
    if doubt is not None:
        raise doubt
