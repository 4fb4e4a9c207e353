"""Readings of a check that are no arm's with one base and one tool: rows mixed up, a move in between, no gear's curve.

No change since the calibration explains those, and what comes nearest would be named instead.
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration import Model
from modcal_core.checking.outcome import OF_A_GEAR
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, so3
from modcal_core.hypotheses import ANGLE, OF_REACH
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import is_direct
from modcal_core.moves import BASE, FRAME, GEAR, LINK, LOAD, PLAY, STEP, TOOL, ZERO, FoundChanges, Setup, SetupReadings
from modcal_core.robots import is_serial_arm

_MIN = 8  # stations
_MIXED = 3  # readings that are another station's; two might be so by chance
_EXPLAINED = 0.8  # share of those that miss by far which must be another's
_CHANGES = (
    BASE,
    FRAME,
    TOOL,
    ZERO,
    GEAR,
    LOAD,
    LINK,
    PLAY,
)  # not a metre or links of another length, nor readings that scatter


def require_own_rows(model: Model, samples: Samples) -> None:
    """Raises BadRecording where most readings that miss by far are those of other stations. model: frozen.

    What one move of base or tool brings to its own station is no other's, however near they stand.
    """
    direct = is_serial_arm(model.chain) and is_direct(samples.kinds)
    if not direct or len(samples) < _MIN or len(samples.frames) > 1 or samples.sockets:
        return
    samples = samples.select(np.argsort(samples.stamps, kind="stable"))
    seen, every, still = SetupReadings.of(model, samples), np.arange(len(samples)), np.eye(4)
    moved = (Setup(still, seen.tool(every, still)), Setup(seen.base(every, seen.setup.X), seen.setup.X))
    near, gap = _near(seen, seen.setup, model.serial.reach())
    own = np.any([np.diag(_near(seen, setup, model.serial.reach())[0]) for setup in (seen.setup, *moved)], axis=0)
    far = np.flatnonzero(~own)
    rows = far[near[far].any(axis=1)]
    if len(rows) < _MIXED or len(rows) < _EXPLAINED * len(far):
        return
    belongs = samples.station[int(np.argmin(np.where(near[rows[0]], gap[rows[0]], np.inf)))] + 1
    raise BadRecording(
        f"readings at {len(rows)} of {len(samples)} stations",
        f"are those of other stations (that at station {samples.station[rows[0]] + 1} is where the arm was at station "
        f"{belongs})",
        "pair each reading with its own posture, and check again",
    )


def _near(seen: SetupReadings, setup: Setup, reach: float) -> tuple[np.ndarray, Array]:
    """Whether each reading is where the arm was at each station, as a nominal arm would be, and how far away [m]."""
    T = setup.D @ seen.A @ setup.X
    gap = np.linalg.norm(seen.B[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    near = gap < OF_REACH * reach
    if seen.poses:
        turned = so3.log(np.swapaxes(T[None, :, :3, :3], -1, -2) @ seen.B[:, None, :3, :3])
        near &= np.linalg.norm(turned, axis=-1) < ANGLE
    return near, gap


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
