"""Readings of a check that are no arm's with one base and one tool: rows mixed up, a move in between, no gear's curve.

No change since the calibration explains those, and what comes nearest would be named instead.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import Model
from modcal_core.errors import BadRecording
from modcal_core.hypotheses import Answer, HandEye, explain, placed
from modcal_core.measurements import Samples
from modcal_core.moves import BASE, FRAME, GEAR, LINK, LOAD, OF_A_GEAR, PLAY, STEP, TOOL, ZERO, FoundChanges

_MIN = 8  # stations, of which most must agree before others are said to be wrong
_CHANGES = (BASE, FRAME, TOOL, ZERO, GEAR, LOAD, LINK, PLAY)  # no other metre, links or scatter


def _case(model: Model, samples: Samples) -> HandEye | None:
    """The readings beside the tip poses of the arm as it was calibrated."""
    case = HandEye.of(samples, model.with_effects(()).chain)
    return None if case is None else replace(case, station=case.station + 1)  # as people count them


def _refusal(answer: Answer, of: int, seen: str = "") -> BadRecording:
    why = f"{seen}{answer.stations} of {of} stations are concerned, and agree with the arm once that is undone"
    return BadRecording(answer.what, why, f"{answer.remedy}, and check again")


def require_own_rows(model: Model, samples: Samples) -> None:
    """Raises BadRecording where most stations agree with the arm and the others do once their rows are put right.

    model: frozen. Base and tool may stand anywhere.
    """
    case = _case(model, samples)
    if case is None or len(case) < _MIN or not (fit := placed(case)).explains or fit.agree().all():
        return
    answer = explain(case)
    if answer.said and all(h.touches == "rows" for h in answer.said):
        raise _refusal(answer, len(case))


def require_one_setting(found: FoundChanges) -> None:
    """Raises BadRecording where base or tool moved between two stations of the check."""
    step = next((c.hypothesis.effect for c in found.changes if c.hypothesis.kind == STEP), None)
    if step is None or found.more:
        return
    what = {BASE: "the base (or the tracker)", TOOL: "the tool (or the target on it)"}[step.place]
    samples = found.samples.select(np.argsort(found.samples.stamps, kind="stable"))
    k = int(np.searchsorted(samples.stamps, step.shape.settings["at"]))
    raise BadRecording(
        f"{what} moved between stations {samples.station[k - 1] + 1} and {samples.station[k] + 1} of this recording",
        "the stations before and those after agree in themselves, and no change since the calibration explains both",
        "fix it, and check again with stations that were all taken afterwards",
    )


def require_accounted(found: FoundChanges, doubt: BadRecording, model: Model) -> None:
    """Raises BadRecording unless what was found explains the readings down to their noise, in few enough numbers: a
    curve that may take any course has one for every station, so that only one of them counts.

    It names the joint whose curve is no gear's, or what looks wrong with the recording, as in an evaluation; else it is
    the doubt. model: frozen.
    """
    curves = [c for c in found.changes if c.hypothesis.free]
    explained = not found.more and all(c.hypothesis.kind in _CHANGES for c in found.changes)
    if not found.changes or not explained or len(curves) > 1:
        case = _case(model, found.samples)
        if case is None or not np.ptp(case.q, axis=0).all() or not (answer := explain(case)).said:
            raise doubt  # of joints that stand it is said already
        raise _refusal(answer, len(case), f"{doubt.limit}; ")
    for curve in curves:
        rms = float(np.sqrt(np.mean(curve.sizes**2)))
        if rms > OF_A_GEAR:
            raise BadRecording(
                f"angles of {curve.hypothesis.place}",
                f"differ from those of the calibrated arm by {np.degrees(rms):.3g}° RMS, another at every station",
                "check its encoder and its place in joint_states; calibrate again once it is right",
            )
