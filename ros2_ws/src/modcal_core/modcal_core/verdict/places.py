"""What the rest of an open verdict depends on, as sentences that say where to look."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from modcal_core.calibration import Errors
from modcal_core.diagnosis import WORTH_NAMING, asked_of, dependence
from modcal_core.hypotheses import disagreement, limits
from modcal_core.robots import Mechanism, is_serial_arm
from modcal_core.verdict.case import Case, derivatives, weights
from modcal_core.verdict.rejected import too_many
from modcal_core.verdict.rejected_alike import rejected_alike
from modcal_core.verdict.status import MAX_PREDICTABLE
from modcal_core.verdict.verdict import Verdict

_MOSTLY = 0.6  # of what is predictable at all; who predicts as much of it is named, however little it is
_MIN_NAMED = 0.05  # share of the squares; what is predictable by less does not make a verdict open
_SURELY = 0.5  # of the floor; what is less beyond it is not told from it
_MIN_LEVER = 0.1  # of the reach; what turns the tool from farther away moves it by its angle times this, at least


def sentences(
    judged: Verdict, case: Case, outside: Sequence[str] = (), described: Mechanism | None = None
) -> list[str]:
    """The sentences, those on what lies outside what a frozen calibration has seen first, where they are not said.

    described: the arm before it was fitted; None for that of the case.
    """
    rows = np.flatnonzero(~case.wrong) if case.fitted else case.held_out
    samples = case.samples.select(rows)
    asked = samples.select(asked_of(samples))
    fitted = None
    if case.fitted:
        fitted = derivatives(case.model, case.known.parameters, asked)[1]
    elif case.refitted:
        fitted = derivatives(case.model, case.refitted, asked)[1][: len(case.refitted)]
    both = judged.predictable_both
    share = both.share if both is not None and both.lower99 > MAX_PREDICTABLE else 1.0
    least = float(np.clip(_MOSTLY * share, _MIN_NAMED, WORTH_NAMING))
    found = dependence(case.model, samples, weights(case.noise, samples), fitted, least, constant=not case.fitted)
    named = " ".join(judged.open_because)
    said = [*(sentence for sentence in outside if sentence not in named), *_apart(case, described or case.model.chain)]
    if found is not None:
        said.append(f"The residual {found.sentence}.")
    said += _only_one_kind(judged, case)
    return said


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
    far = many or _far(case.errors["final"], chain)
    if far or _far(case.errors["nominal"], chain):  # a fit can come to terms with wrong joints without a rejection
        found = disagreement(case.samples, chain, joints_only=not far)
        if found is not None:
            what = found.what[0].upper() + found.what[1:]
            yield f"{what} ({found.stations} of {found.of} stations that were looked at): {found.remedy}."
    if not many:
        return
    yield from rejected_alike(case)
    if case.fitted:
        samples = case.samples.select(np.flatnonzero(case.wrong))
        along = dependence(case.model, samples, weights(case.noise, samples))
        if along is not None:
            yield f"The residual of the rejected stations {along.sentence}."


def _far(left: Errors, chain: Mechanism) -> bool:
    """Whether errors of a model are larger than those of a nominal arm."""
    missed = left.position_norm
    return len(missed) > 0 and is_serial_arm(chain) and float(np.median(missed)) > limits(chain)[1]
