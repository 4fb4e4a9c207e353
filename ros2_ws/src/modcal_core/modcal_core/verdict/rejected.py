"""What a score leaves out: how many stations, what the error is with and without them, and what they have in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Errors, ErrorSize
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.verdict.case import Case

_SINGLE = 0.03  # chance that a reading is wrong by itself: a reflection, a target that was lost
_SURE = 0.01  # chance of as many single wrong readings, below which they are something else
_MIN = 6  # rejected readings, of which something can be common to
_MOSTLY = 0.8  # of them
_USUAL = 97.5  # %; of the others' errors, up to which an error is usual
_APART = 0.85  # chance that a rejected reading has more of something than another has (area under the curve)
_SURELY = 5.0  # standard deviations of that chance if nothing were in common
_SPEED = 1e-3  # rad/s or m/s; arms that go no faster stand


def too_many(wrong: np.ndarray, samples: Samples) -> bool:
    """Whether more stations hold a rejected sample (True, (N,)) than single wrong readings make up (binomial)."""
    from scipy.special import bdtrc

    count, of = len(np.unique(samples.station[wrong])), samples.stations
    return count > 0 and float(bdtrc(count - 1, of, _SINGLE)) < _SURE


@dataclass(frozen=True)
class Rejected:
    """RMS position error on held-out with the rejected readings and without them [mm]; None where there is nothing to
    tell it from. stations: with a rejected reading, of so many, in the whole recording (held-out where frozen).
    """

    with_mm: float | None
    without_mm: float | None
    stations: int
    of: int

    @property
    def share(self) -> float:
        """Share of the stations that were rejected."""
        return self.stations / max(self.of, 1)


def rejection(
    residuals: Errors, wrong: np.ndarray, samples: Samples, held_out: np.ndarray, frozen: bool = False
) -> Rejected:
    """What is rejected of these samples.

    residuals: errors of the samples held out. wrong: True for rejected samples, (N,). held_out: rows of those held out.
    frozen: whether only those were judged.
    """
    kept = ~wrong[held_out]
    return Rejected(
        _rms_mm(residuals.position_norm),
        _rms_mm(residuals.position_norm[kept]),
        len(np.unique(samples.station[wrong])),
        len(np.unique(samples.station[held_out])) if frozen else samples.stations,
    )


def _rms_mm(norms: np.ndarray) -> float | None:
    size = ErrorSize.of(1e3 * norms)
    return None if size is None else size.rms


def alike(case: Case) -> Iterator[str]:
    """Sentences on what the rejected readings of a case have in common: topic, part, posture, speed, time."""
    samples, wrong = case.samples, case.wrong
    if min(wrong.sum(), (~wrong).sum()) < _MIN:
        return
    count = np.bincount(samples.frame[wrong], minlength=len(samples.frames))
    f = int(np.argmax(count))
    if count[f] > _MOSTLY * wrong.sum() and (samples.frame == f).mean() < 0.75 * count[f] / wrong.sum():
        yield (
            f"{count[f]} of the {int(wrong.sum())} rejected readings are of '{samples.frames[f]}': look at that "
            "instrument, how it is mounted and how its readings are made."
        )
    yield from _one_half(case)
    spread = np.sqrt((len(wrong) + 1) / (12.0 * wrong.sum() * (~wrong).sum()))
    found: list[tuple[float, str]] = []
    for more, less, value in _quantities(case):
        apart = _chance(value[wrong], value[~wrong]) - 0.5
        if abs(apart) > max(_APART - 0.5, _SURELY * spread):
            found.append((abs(apart), f"{more if apart > 0.0 else less} (median {np.median(value[wrong]):.3g})"))
    if found:
        yield f"Most of the rejected readings are {max(found)[1]}, unlike the others."


def _one_half(case: Case) -> Iterator[str]:
    """Rejected poses of which only the orientation is wrong, or only the position."""
    pose = np.flatnonzero(case.samples.is_pose)
    wrong = case.wrong[pose]
    if min(wrong.sum(), (~wrong).sum()) < _MIN:
        return
    gap, turn = case.residuals.position_norm[pose], case.residuals.rotation_norm
    usual_gap, usual_turn = (x <= np.percentile(x[~wrong], _USUAL) for x in (gap, turn))
    orientations = "how orientations are made (quaternions of either sign that were averaged or interpolated, angles "
    orientations += "that fold, a target that looks alike from several sides)"
    positions = "the instrument's distances and at what moves the target without turning it"
    wrong_turn, wrong_gap = f"{np.degrees(np.median(turn[wrong])):.3g}°", f"{1e3 * np.median(gap[wrong]):.3g} mm"
    for alone, which, size, other, look in (
        (usual_gap & ~usual_turn, "orientation", wrong_turn, "position", orientations),
        (usual_turn & ~usual_gap, "position", wrong_gap, "orientation", positions),
    ):
        share = float(alone[wrong].mean())
        if share > _MOSTLY:
            yield (
                f"Of {share:.0%} of the rejected poses the {which} alone is wrong (by {size}, median), and the {other} "
                f"agrees with the others: look at {look}."
            )


def _quantities(case: Case) -> Iterator[tuple[str, str, Array]]:
    """What readings may have much of, or little, as text, and how much, (N,)."""
    samples = case.samples
    names = samples.names or tuple(f"joint {j + 1}" for j in range(samples.q.shape[1]))
    yield "late in the recording", "early in the recording", samples.stamps
    for j, name in enumerate(names):
        q, where = samples.q[:, j], f"where {name} is"
        yield f"{where} large", f"{where} small", q
        yield f"{where} far from its usual position", f"{where} near its usual position", abs(q - np.median(q))
        if samples.approach[:, j].any():
            yield f"where {name} came from below", f"where {name} came from above", samples.approach[:, j]
    speed = np.abs(np.nan_to_num(samples.velocity)).max(axis=1)
    if float(np.median(speed)) > _SPEED:
        yield "where the arm moves fast", "where the arm moves slowly", speed
    if len(samples.frames) == 1 and not samples.sockets:
        away = np.linalg.norm(case.model.predict_samples(samples)[:, :3, 3], axis=1)
        yield "far from the tracker", "near the tracker", away


def _chance(a: Array, b: Array) -> float:
    """Chance that a value of a is larger than one of b, ties counted half."""
    below = np.searchsorted(np.sort(b), a, side="left") + np.searchsorted(np.sort(b), a, side="right")
    return float(np.mean(below)) / (2.0 * len(b))
