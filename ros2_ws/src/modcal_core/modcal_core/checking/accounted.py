"""Whether changes of a joint or two account for readings that the calibrated arm misses by far.

A gear that slipped, or one whose axis passes near the target, moves readings by as much as another robot would. What
tells them apart is what such changes leave: of the calibrated arm its noise, of another one nearly all.
"""

from __future__ import annotations

import numpy as np

from modcal_core.checking.hypotheses import BASE, FRAME, GEAR, LOAD, TOOL, ZERO
from modcal_core.checking.outcome import OF_A_GEAR
from modcal_core.checking.searching import FoundChanges
from modcal_core.errors import BadRecording

_CHANGES = (BASE, FRAME, TOOL, ZERO, GEAR, LOAD)  # not a metre or links of another length, nor readings that scatter


def require_accounted(found: FoundChanges, doubt: BadRecording) -> None:
    """Raises the doubt unless what was found explains the readings down to their noise, in few enough numbers: a curve
    that may take any course has one for every station, so that only one of them counts. Raises BadRecording with the
    joint where its curve is no gear's.
    """
    curves = [c for c in found.changes if c.hypothesis.curve >= 0]
    explained = not found.more and all(c.hypothesis.kind in _CHANGES for c in found.changes)
    if not found.changes or not explained or len(curves) > 1:
        raise doubt
    for curve in curves:
        rms = float(np.sqrt(np.mean(curve.sizes**2)))
        if rms > OF_A_GEAR:
            raise BadRecording(
                f"angles of {curve.hypothesis.place}",
                f"differ from those of the calibrated arm by {np.degrees(rms):.3g}° RMS, another at every station",
                "check its encoder and its place in joint_states; calibrate again once it is right",
            )
