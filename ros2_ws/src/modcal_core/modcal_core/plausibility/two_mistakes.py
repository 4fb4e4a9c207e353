"""Two mistakes at once, of which one hides the other: it is undone, and what is then told is said of both.

Readings that no arm could give in metres are in another unit, whatever else is wrong (of arrays: topics are asked as
they are read). Positions may be mirrored, and orientations agree with no posture, beside a wrong joint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from modcal_core.calibration import Cell, fit_cell, usual_miss
from modcal_core.errors import BadRecording
from modcal_core.measurements import Samples
from modcal_core.plausibility.listed import NO_HELP, explaining, missed_angle
from modcal_core.plausibility.mistakes import left_handed
from modcal_core.robots import Mechanism, forward

EVERYTHING = "joint states and readings"  # the offender of a refusal that can name none
_FAR = 10.0  # times as far apart as any two flange positions can be, from which readings are not in metres
_LIKE = 3.0  # times, by which the extent in the right unit may be another than that of the flange
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}  # m

# refuses (samples that were fitted, all of the recording, by what the arm misses them [m]); raises BadRecording
Refuse = Callable[[Samples, Samples, float], None]


def another_unit(few: Samples, whole: Samples, chain: Mechanism, limit: float, refuse: Refuse) -> BadRecording | None:
    """The unit of positions that lie farther apart than any arm reaches, and what else is wrong; None for others.

    few: samples that were fitted. limit: what an arm's errors may come to [m].
    """
    far = _extent(few.reading)
    if not bool(np.all(few.is_pose | (few.kind == "point"))) or far < _FAR * 2.0 * chain.reach():
        return None
    moved = _extent(forward(chain, few.q)[:, :3, 3])
    ratio = {name: scale * far / max(moved, 1e-9) for name, scale in _UNITS.items()}
    like = [name for name, r in ratio.items() if 1.0 / _LIKE < r < _LIKE]
    said = f"lie {far:.0f} m apart, and this arm reaches {chain.reach():.1f} m"
    offender, remedy = f"positions look like {' or '.join(like)}" if like else "positions", "record metres"
    if len(like) == 1:
        undone, everything = (replace(s, reading=_UNITS[like[0]] * s.reading) for s in (few, whole))
        other = _told(undone, everything, chain, limit, refuse)
        if other is not None:
            said = f"{said}; in metres, {other.offender}: {other.limit}"
            remedy = f"{remedy}; then {other.remedy}"
    return BadRecording(offender, said, remedy)


def hidden_by_readings(few: Samples, chain: Mechanism, limit: float, refuse: Refuse) -> BadRecording | None:
    """What mirrored positions, or orientations of another convention, hide; None where there is nothing of the kind.

    A joint beside mirrored positions has to make up for all that an arm misses by; orientations are left out only where
    they agree with no posture.
    """
    if not bool(np.all(few.is_pose | (few.kind == "point"))):
        return None
    if few.is_pose.any() and missed_angle(fit_cell(chain, few, Cell()).model, few) >= NO_HELP:
        points = _points(few)  # what the order of all rows shows has been asked
        found = _told(points, points, chain, limit, refuse)
        if found is None:
            return None
        said = f"by positions alone, since orientations agree with no posture: {found.limit}"
        return BadRecording(found.offender, said, f"{found.remedy}; then check the convention of the orientations")
    mirror = left_handed()
    mirrored = mirror.undone(_points(few))
    left, offender, remedy = explaining(fit_cell(chain, mirrored, Cell()).model, mirrored)
    if not offender or left > limit:
        return None
    said = f"and {offender}: with both corrected, the arm misses by {1e3 * left:.1f} mm"
    return BadRecording(mirror.offender, said, f"{mirror.remedy}; {remedy}")


def _told(few: Samples, whole: Samples, chain: Mechanism, limit: float, refuse: Refuse) -> BadRecording | None:
    """What these samples are refused for by name."""
    missed = usual_miss(fit_cell(chain, few, Cell()).model, few)
    if missed < limit:
        return None
    try:
        refuse(few, whole, missed)
    except BadRecording as found:
        return None if found.offender == EVERYTHING else found
    return None


def _points(samples: Samples) -> Samples:
    """The same without orientations."""
    return replace(samples, kind=np.full(len(samples), "point", dtype=samples.kind.dtype))


def _extent(positions: np.ndarray) -> float:
    """Spread of positions (N, 3) without the outermost tenth [m]."""
    return 2.0 * float(np.quantile(np.linalg.norm(positions - np.median(positions, axis=0), axis=1), 0.9))
