"""Where to look: an open verdict says what the rest depends on, and what lies outside what a calibration has seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from modcal_core.calibration import Errors
from modcal_core.hypotheses import disagreement, limits
from modcal_core.robots import Mechanism, is_serial_arm
from modcal_core.verdict.case import Case
from modcal_core.verdict.grounds import too_many
from modcal_core.verdict.predictable import MIN_STATIONS, dependence
from modcal_core.verdict.rest import Rest, rows_asked
from modcal_core.verdict.scatter import along
from modcal_core.verdict.verdict import Reason, Verdict

_MAX = 400  # samples, for time; more are thinned evenly
_WORTH_NAMING = 0.2  # share of the squared residual that must be predicted
_MOSTLY = 0.6  # of what is predictable at all; who predicts as much of it is named, however little it is
_HALF = 0.5  # of what lies along one joint's motion, that a driver must predict to be named before that
_SURELY = 0.5  # of the floor; what is less beyond it is not told from it
_MIN_LEVER = 0.1  # of the reach; what turns the tool from farther away moves it by its angle times this, at least
_MIN_NAMED = 0.05  # share of the squares; what is predictable by less does not make a verdict open


def with_places(
    judged: Verdict, case: Case, outside: Sequence[str] = (), described: Mechanism | None = None
) -> Verdict:
    """An open verdict with sentences that say where; any other as it is.

    outside: sentences on what lies outside what a frozen calibration has seen. described: the arm before it was fitted;
    None for that of the case. The sentences explain the reasons that are there and are none of their own: they have the
    kind "predictable", which stands in the way of no tolerance.
    """
    if judged.status != "open":
        return judged
    beside = [sentence for sentence in outside if sentence not in " ".join(judged.open_because)]
    beside += [*_apart(case, described or case.model.chain), *_only_one_kind(judged, case)]
    where, rest = ([Reason("predictable", said) for said in some] for some in (_goes_with(judged, case), beside))
    first, *others = judged.reasons  # a sentence for a person has two
    return replace(judged, reasons=(first, *where, *others, *rest))


def _goes_with(judged: Verdict, case: Case) -> Iterator[str]:
    """The place and driver that predict most of the rest; else the joint along which most of it lies."""
    both = judged.predictable_both
    share = both.share if both is not None and judged.predicted else 1.0
    rows = rows_asked(case, _MAX)
    found = dependence(case, rows, float(np.clip(_MOSTLY * share, _MIN_NAMED, _WORTH_NAMING)))
    many = case.samples.select(rows).stations >= MIN_STATIONS
    moved = along(Rest.of(case, rows)) if many else None
    if moved is not None and (found is None or found.share < _HALF * moved[1]):
        yield f"{moved[1]:.0%} of what is left lies along the motion of {moved[0]}, station by station."
    elif found is not None:
        yield f"The residual {found.sentence}."


def _only_one_kind(judged: Verdict, case: Case) -> Iterator[str]:
    """Where positions exceed their floor by more than orientations allow, or the reverse: what cannot be the cause.

    What turns a joint or the base by θ moves the tool by no more than θ times the reach, and turns it by θ.
    """
    left = case.errors["final"]
    if judged.floor_mm is None or judged.floor_deg is None or not len(left.rotation_norm):
        return
    moved = 1e-3 * _beyond(1e3 * left.position_norm, judged.floor_mm)
    turned = np.radians(_beyond(np.degrees(left.rotation_norm), judged.floor_deg))
    surely_moved, surely_turned = _SURELY * 1e-3 * judged.floor_mm, np.radians(_SURELY * judged.floor_deg)
    reach = case.model.chain.reach()
    if moved > 2.0 * reach * max(turned, surely_turned):
        yield (
            f"Positions miss by {1e3 * moved:.3g} mm beyond their floor and orientations by {np.degrees(turned):.2g}° "
            "only: a joint or a tilt of the base would turn the tool by more. Look at what moves points alone: the "
            "target's seat on the tool, what the tracker reads, lengths."
        )
    elif turned * _MIN_LEVER * reach > max(moved, surely_moved):
        yield (
            f"Orientations miss by {np.degrees(turned):.3g}° beyond their floor and positions by {1e3 * moved:.2g} mm "
            "only: a joint far from the tool would move it by more. Look at what turns the tool alone: its seat, the "
            "target on it, the last joint, how orientations are read."
        )


def _beyond(size: np.ndarray, floor: float) -> float:
    return float(np.sqrt(max(float(np.mean(size**2)) - floor**2, 0.0)))


def _apart(case: Case, chain: Mechanism) -> Iterator[str]:
    """What the input looks like where too many stations were rejected to be single wrong readings, or where the model
    misses by more than a nominal arm does: a fit can come to terms with a wrong column without a rejection.

    chain: the arm before it was fitted, for a fitted one has links that make up for what is wrong.
    """
    many = too_many(case.wrong, case.samples)
    off = many or _far(case.errors["final"], chain)
    if off or _far(case.errors["nominal"], chain):  # a fit can come to terms with wrong joints without a rejection
        found = disagreement(case.samples, chain, joints_only=not off)
        if found is not None:
            what = found.what[0].upper() + found.what[1:]
            yield f"{what} ({found.stations} of {found.of} stations that were looked at): {found.remedy}."
    if many and case.fitted:
        along = dependence(case, np.flatnonzero(case.wrong), _WORTH_NAMING, free=False)
        if along is not None:
            yield f"The residual of the rejected stations {along.sentence}."


def _far(left: Errors, chain: Mechanism) -> bool:
    """Whether errors of a model are larger than those of a nominal arm."""
    off = np.median(left.position_norm) if len(left.position_norm) else 0.0
    return is_serial_arm(chain) and bool(off > limits(chain)[1])
