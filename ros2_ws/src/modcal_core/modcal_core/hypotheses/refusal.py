"""When even the fitted model misses by far, the input is wrong: it is refused, with what explains it.

Statements are asked first (places and distances, sockets that stood); the search over hypotheses then names what was
written down wrongly, or plain facts (joints that stand, links beside the chain) say where to look.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from modcal_core.calibration import AnyDistance, Cell, Fit, fit_cell, usual_miss
from modcal_core.errors import BadRecording
from modcal_core.hypotheses import conventions
from modcal_core.hypotheses.hand_eye import HandEye, placed
from modcal_core.hypotheses.hypothesis import RARE, ROWS_REMEDY, Disagreement, family
from modcal_core.hypotheses.rows import scattered, unrelated
from modcal_core.hypotheses.search import explain
from modcal_core.hypotheses.socket_places import misread_joints, require_one_place
from modcal_core.hypotheses.stated_distances import wrong_distances
from modcal_core.measurements import Samples, moving_beside
from modcal_core.robots import Mechanism

LIMIT_OF_REACH = 0.01  # a fitted arm that misses by more than this share of its reach is not an arm with small errors
EVERYTHING = "joint states and readings"  # the offender of a refusal that can name none
_DRIFT = 0.1  # of what is missed, that readings move by within a station; noise of an instrument does not miss by far

_OF_A_FRAME = 10  # stations; twelve unknown numbers at most, of thirty or sixty


def require_plausible(
    nominal: Fit,
    fitted: Fit,
    samples: Samples,
    whole: Samples | None = None,
    distances: Sequence[AnyDistance] = (),
    placed: bool = False,
) -> None:
    """Raises BadRecording, naming the likely mistake, when the fitted model misses by more than an arm's errors can.

    samples: that were fitted. whole: of the recording, in which rows stand beside their neighbours; None for these.
    distances: that were stated and fitted beside the readings. placed: whether places of frames were stated as well.
    """
    whole = samples if whole is None else whole
    chain = nominal.model.chain
    require_one_place(whole, chain)
    limit = LIMIT_OF_REACH * chain.reach()
    missed = usual_miss(fitted.model, samples)
    if missed <= limit:
        return
    said = f"the model misses by {1e3 * missed:.0f} mm, {1e3 * limit:.0f} mm is the limit"
    if distances or placed:
        _require_statements(chain, samples, distances, placed, said, limit)
    if (found := disagreement(whole, chain)) is not None:
        concerned = f"; {found.stations} of {found.of} stations are concerned" if found.stations < found.of else ""
        left = "" if found.missed is None else f"; with that corrected, it misses by {1e3 * found.missed:.1f} mm"
        raise BadRecording(found.what, f"{said}{concerned}{left}", found.remedy)
    for what, why, remedy in _facts(samples, whole, missed, chain):
        raise BadRecording(what, f"{why}; {said}" if why else said, remedy)
    raise BadRecording(
        EVERYTHING,
        said,
        "check that the URDF, --base and --tip are those of this robot, and that joint and tracker clocks agree",
    )


def disagreement(samples: Samples, chain: Mechanism, joints_only: bool = False) -> Disagreement | None:
    """What looks wrong with readings that do not agree with the arm, None if nothing is sure.

    joints_only: ask only what a fit can come to terms with: joints under other names, signs or together with others.
    """
    case = HandEye.of(samples, chain)
    if case is None:
        return misread_joints(samples, chain)
    joints = [*conventions.joints(case.names), *conventions.several_joints(case.names)]
    answer = explain(case, family(RARE, joints), depth=1) if joints_only else explain(case)
    if not answer.said:
        return None
    return Disagreement(answer.what, answer.remedy, answer.stations, len(case), answer.after.usual[1])


def _require_statements(
    chain: Mechanism, samples: Samples, distances: Sequence[AnyDistance], placed: bool, said: str, limit: float
) -> None:
    """Raises BadRecording where readings alone agree with the arm, so that what was stated beside them does not."""
    alone = fit_cell(chain, samples, Cell())
    if usual_miss(alone.model, samples) >= limit:
        return
    if distances and (told := wrong_distances(alone, distances)) is not None:
        raise BadRecording(told.what, f"{said}, and it does not without them", told.remedy)
    if placed:
        raise BadRecording(
            "known: the places of frames that are stated in the cell file",
            f"{said}, and it does not without them",
            "correct position_m [m], quaternion (x y z w), or the frame that they are stated in; or leave them out",
        )


def _facts(samples: Samples, whole: Samples, missed: float, chain: Mechanism) -> Iterator[tuple[str, str, str]]:
    """What is plain without a fit of the arm: offender, what is seen of it, and the remedy."""
    cases = [HandEye.of(whole.select(whole.frame == f), chain) for f in range(len(whole.frames))]
    if len(cases) > 1 and all(case and len(case) >= _OF_A_FRAME and placed(case).explains for case in cases):
        yield (
            f"frames {', '.join(whole.frames)}",
            "agree with the arm one by one, not together: each shows a target of its own on the tool",
            "give each target a recording of its own (--also), or a table's mapping the column that tells it (target)",
        )
    flat = [axis for axis, extent in zip("xyz", np.ptp(samples.reading, axis=0), strict=True) if extent == 0.0]
    if flat and len(samples.frames) == 1:
        yield (
            f"coordinate {' and '.join(flat)} of the readings",
            f"is the same at all {len(samples)} stations, so the readings lie in a plane or on a line",
            "record an instrument that measures all three coordinates",
        )
    if (drift := _drift(samples)) > _DRIFT * missed:
        yield (
            "readings",
            f"go on moving while the joints stand still, by {1e3 * drift:.3g} mm at the usual station",
            "see whether the tracker filters, averages or repeats its last readings, or is late, and wait until it has "
            "settled; see whether both clocks agree",
        )
    if beside := moving_beside(samples):
        yield (
            EVERYTHING,
            f"{' and '.join(beside)} moved as well and {'is' if len(beside) == 1 else 'are'} not between base and tip",
            "give --tip (or --base) as the link that carries the target (or the arm)",
        )
    if all(case is not None and unrelated(case) for case in cases):
        yield (
            EVERYTHING,
            "do not seem to belong together: joints of other rows tell as much of the readings as those of their own",
            f"{ROWS_REMEDY}, and see whether both are of this robot and of the same time",
        )
    if all(case is not None and scattered(placed(case)) for case in cases):
        yield (
            "readings",
            "follow the arm and scatter about it: by how much depends on no joint",
            "see how well the instrument sees its target (reflections, distance, others), and whether clocks agree",
        )
    if fact := standing(samples):
        yield fact


def standing(samples: Samples) -> tuple[str, str, str] | None:
    """Joints that are at the same position at every station: offender, what is seen, remedy; None where all move."""
    spans = np.ptp(samples.q, axis=0)
    stand = [name for name, extent in zip(samples.names, spans, strict=True) if extent == 0.0]
    if not stand:
        return None
    return (
        f"joint {' and '.join(stand)}",
        f"{'stands' if len(stand) == 1 else 'stand'} at the same position at all {len(samples)} stations",
        "see whether it truly did; else its position is not recorded: check how it gets into joint_states",
    )


def _drift(samples: Samples) -> float:
    """How far readings move within a station [m], the median; correlated ones, which no mean over a station removes."""
    sigma = samples.sigma_position[(samples.is_pose | (samples.kind == "point")) & ~samples.moving]
    known = np.isfinite(sigma)
    return float(np.median(sigma[known])) if len(sigma) and known.mean() > 0.5 else 0.0
