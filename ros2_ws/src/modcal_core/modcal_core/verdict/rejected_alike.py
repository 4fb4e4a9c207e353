"""What rejected readings have in common: their topic, what of them is wrong, a posture, a speed, a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.geometry import Array
from modcal_core.verdict.case import Case

_MIN = 6  # rejected readings
_MOSTLY = 0.8  # of them
_USUAL = 97.5  # %; of the others' errors, up to which an error is usual
_APART = 0.85  # chance that a rejected reading has more of something than another has (area under the curve)
_SURELY = 5.0  # standard deviations of that chance if nothing were in common
_SPEED = 1e-3  # rad/s or m/s


def rejected_alike(case: Case) -> tuple[str, ...]:
    """Sentences on what the rejected readings of a case have in common; none where that is nothing."""
    wrong = case.wrong
    if wrong.sum() < _MIN or (~wrong).sum() < _MIN:
        return ()
    return (*_one_topic(case), *_one_half(case), *_apart(case))


def _one_topic(case: Case) -> Iterator[str]:
    frame, wrong = case.samples.frame, case.wrong
    count = np.bincount(frame[wrong], minlength=len(case.samples.frames))
    f = int(np.argmax(count))
    if len(count) > 1 and count[f] > _MOSTLY * wrong.sum() and (frame == f).mean() < 0.75 * count[f] / wrong.sum():
        yield (
            f"{count[f]} of the {int(wrong.sum())} rejected readings are of '{case.samples.frames[f]}': look at that "
            "instrument, how it is mounted and how its readings are made."
        )


def _one_half(case: Case) -> Iterator[str]:
    """Rejected poses of which only the orientation is wrong, or only the position."""
    pose = np.flatnonzero(case.samples.is_pose)
    wrong = case.wrong[pose]
    if wrong.sum() < _MIN or (~wrong).sum() < _MIN:
        return
    gap, turn = case.residuals.position_norm[pose], case.residuals.rotation_norm
    usual_gap, usual_turn = (x <= np.percentile(x[~wrong], _USUAL) for x in (gap, turn))
    share = float((usual_gap & ~usual_turn)[wrong].mean())
    if share > _MOSTLY:
        yield (
            f"Of {share:.0%} of the rejected poses the orientation alone is wrong (by {_degrees(turn[wrong])}, "
            "median), and the position agrees with the others: look at how orientations are made (quaternions of "
            "either sign that were averaged or interpolated, angles that fold, a target that looks alike from "
            "several sides)."
        )
    share = float((usual_turn & ~usual_gap)[wrong].mean())
    if share > _MOSTLY:
        yield (
            f"Of {share:.0%} of the rejected poses the position alone is wrong (by "
            f"{1e3 * float(np.median(gap[wrong])):.3g} mm, median), and the orientation agrees with the others: look "
            "at the instrument's distances and at what moves the target without turning it."
        )


def _degrees(turn: Array) -> str:
    return f"{np.degrees(float(np.median(turn))):.3g}°"


def _apart(case: Case) -> Iterator[str]:
    """Quantity that best separates rejected readings from the others."""
    samples, wrong = case.samples, case.wrong
    names = samples.names or tuple(f"joint {j + 1}" for j in range(samples.q.shape[1]))
    found: list[tuple[float, str]] = []
    of: list[tuple[str, str, Array]] = [("late in the recording", "early in the recording", samples.stamps)]
    for j, name in enumerate(names):
        q = samples.q[:, j]
        where = f"where {name} is"
        of.append((f"{where} large", f"{where} small", q))
        of.append((f"{where} far from its usual position", f"{where} near its usual position", abs(q - np.median(q))))
        if len(samples.approach) and np.abs(samples.approach[:, j]).any():
            of.append((f"where {name} came from below", f"where {name} came from above", samples.approach[:, j]))
    speed = np.abs(np.nan_to_num(samples.velocity)).max(axis=1)
    if float(np.median(speed)) > _SPEED:
        of.append(("where the arm moves fast", "where the arm moves slowly", speed))
    if len(samples.frames) == 1 and not samples.sockets:
        of.append(
            (
                "far from the tracker",
                "near the tracker",
                np.linalg.norm(case.model.predict_samples(samples)[:, :3, 3], axis=1),
            )
        )
    a, b = int(wrong.sum()), int((~wrong).sum())
    spread = np.sqrt((a + b + 1) / (12.0 * a * b))
    for more, less, value in of:
        chance = _chance(value[wrong], value[~wrong])
        if abs(chance - 0.5) > max(_APART - 0.5, _SURELY * spread):
            limit = np.median(value[wrong])
            found.append((abs(chance - 0.5), f"{more if chance > 0.5 else less} (median {limit:.3g})"))
    if found:
        yield f"Most of the rejected readings are {max(found)[1]}, unlike the others."


def _chance(a: Array, b: Array) -> float:
    """Chance that a value of a is larger than one of b, ties counted half."""
    below = np.searchsorted(np.sort(b), a, side="left") + np.searchsorted(np.sort(b), a, side="right")
    return float(np.mean(below)) / (2.0 * len(b))
