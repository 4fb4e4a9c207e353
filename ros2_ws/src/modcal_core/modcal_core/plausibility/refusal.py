"""When even the fitted model misses by far, the input is wrong: find out in which way, and say it.

The nominal arm is fitted again with each of the :mod:`mistakes` undone; the one that brings the error down several
times is named. When none does, one channel of the recording may not follow the rest
(:mod:`channels`), or follow another link (:mod:`links`), or only a part of the stations, or one joint
(:mod:`consistency`), or joints are mixed (:mod:`joint_map`), or a link of the description is another
(:mod:`wrong_links`); else the robot or the pairing as a whole is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

import numpy as np

from modcal_core.calibration import AnyDistance, Cell, Fit, fit_cell, usual_miss
from modcal_core.errors import BadRecording
from modcal_core.measurements import Samples, moving_beside, spread_rows
from modcal_core.plausibility.channels import disagreeing_channel
from modcal_core.plausibility.consistency import disagreement
from modcal_core.plausibility.coordinates import written_otherwise
from modcal_core.plausibility.descriptions import other_order, other_type
from modcal_core.plausibility.filtered import filtered_readings
from modcal_core.plausibility.joint_map import mixed_joints
from modcal_core.plausibility.links import other_link
from modcal_core.plausibility.listed import explaining
from modcal_core.plausibility.of_a_part import part_apart
from modcal_core.plausibility.pairing import mispaired
from modcal_core.plausibility.placements import several_placements
from modcal_core.plausibility.standing import standing
from modcal_core.plausibility.stated_distances import wrong_distances
from modcal_core.plausibility.two_mistakes import EVERYTHING, another_unit, hidden_by_readings
from modcal_core.plausibility.wrong_links import wrong_link

_AN_ARM = 0.05  # of the reach; what misses by more with a mistake undone is not explained by it
_DRIFT = 0.1  # of what is missed, that readings move by within a station; noise of an instrument does not miss by far
_MAX = 300  # samples are enough to tell


def refuse(
    nominal: Fit,
    samples: Samples,
    whole: Samples,
    distances: Sequence[AnyDistance],
    placed: bool,
    missed: float,
    limit: float,
) -> NoReturn:
    """Raises BadRecording with the mistake that is likely.

    samples: that were fitted. whole: of the recording. distances: that were stated and fitted beside the readings.
    placed: whether places of frames were stated as well. missed: what the fitted model misses them by [m]. limit: what
    an arm's errors may come to.
    """
    chain = nominal.model.chain
    rows = spread_rows(len(samples), _MAX)
    few = samples.select(np.unique(rows))
    said = f"the model misses by {1e3 * missed:.0f} mm, {1e3 * limit:.0f} mm is the limit"
    if distances or placed:
        alone = fit_cell(chain, samples, Cell())
        plausible = usual_miss(alone.model, samples) < limit
        told = wrong_distances(alone, distances) if distances and plausible else None
        if told is not None:
            raise BadRecording(told.what, f"{said}, and it does not without them", told.remedy)
        if placed and plausible:
            raise BadRecording(
                "known: the places of frames that are stated in the cell file",
                f"{said}, and it does not without them",
                "correct position_m [m], quaternion (x y z w), or the frame that they are stated in; or leave them out",
            )
    best = explaining(nominal.model, few)
    if not best[1] or best[0] > limit:  # nothing on the lists explains it as an arm's errors do
        apart = (
            filtered_readings(whole, chain)
            or disagreeing_channel(whole, chain)
            or written_otherwise(whole, chain)
            or mispaired(whole, chain)
            or other_order(whole, chain)
            or other_type(whole, chain)
            or other_link(whole, chain)
            or (mixed_joints(whole, chain) if best[1] else None)  # which explains it wholly, where the lists do not
        )
        if apart is not None:
            raise BadRecording(apart.what, said, apart.remedy)
    named = f"{said}; with that corrected, it misses by {1e3 * best[0]:.1f} mm"
    if best[1] and best[0] <= limit:
        raise BadRecording(best[1], named, best[2])
    flat = [axis for axis, extent in zip("xyz", np.ptp(samples.reading, axis=0), strict=True) if extent == 0.0]
    if flat and len(samples.frames) == 1:
        raise BadRecording(
            f"coordinate {' and '.join(flat)} of the readings",
            f"is the same at all {len(samples)} stations, so the readings lie in a plane or on a line; {said}",
            "record an instrument that measures all three coordinates",
        )
    found = disagreement(few, chain) or part_apart(whole, chain) or several_placements(whole, chain)
    if found is not None:
        raise BadRecording(found.what, f"{said}; {found.stations} of {found.of} stations are concerned", found.remedy)

    def again(fitted: Samples, everything: Samples, miss: float) -> NoReturn:
        refuse(fit_cell(chain, fitted, Cell()), fitted, everything, (), False, miss, limit)

    if (unit := another_unit(few, whole, chain, limit, again)) is not None:
        raise unit
    if best[1] and best[0] <= _AN_ARM * chain.reach():  # better than any, though not as a nominal arm
        raise BadRecording(best[1], named, best[2])
    described = mixed_joints(whole, chain) or wrong_link(whole, chain)
    if described is not None:
        raise BadRecording(described.what, said, described.remedy)
    if (drift := _drift(samples)) > _DRIFT * missed:
        raise BadRecording(
            "readings",
            f"go on moving while the joints stand still, by {1e3 * drift:.3g} mm at the usual station; {said}",
            "see whether the tracker filters, averages or repeats its last readings, or is late, and wait until it has "
            "settled; see whether both clocks agree",
        )
    if beside := moving_beside(samples):
        raise BadRecording(
            "joint states and readings",
            f"{said}; {' and '.join(beside)} moved as well and {'is' if len(beside) == 1 else 'are'} not between base "
            "and tip",
            "give --tip (or --base) as the link that carries the target (or the arm)",
        )
    if (still := standing(samples, said)) is not None:
        raise still
    if (hidden := hidden_by_readings(few, chain, limit, again)) is not None:
        raise hidden
    raise BadRecording(
        EVERYTHING,
        said,
        "check that the URDF, --base and --tip are those of this robot, and that joint and tracker clocks agree",
    )


def _drift(samples: Samples) -> float:
    """How far readings move within a station [m], the median; correlated ones, which no mean over a station removes."""
    sigma = samples.sigma_position[(samples.is_pose | (samples.kind == "point")) & ~samples.moving]
    known = np.isfinite(sigma)
    return float(np.median(sigma[known])) if len(sigma) and known.mean() > 0.5 else 0.0
