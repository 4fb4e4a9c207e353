"""Pose accuracy and repeatability of ISO 9283, where a recording holds the test that the standard describes.

The test: five poses, each attained thirty times, always from the same side (ISO 9283:1998, 7.2). AP is the distance
from the commanded pose to the mean of the attained ones; RP is the mean distance of the attained positions to their
mean plus three standard deviations of that distance. Orientations are compared axis by axis: AP_a, AP_b, AP_c are the
turns of the mean about x, y and z, RP_a, RP_b, RP_c three standard deviations of each. Here the commanded pose is the
one that a model computes from the joint positions, so that AP is that of the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Errors
from modcal_core.geometry import Array, so3
from modcal_core.measurements import LEFT, POINT, POSE, TRAVEL, Samples, posture_numbers

POSES, CYCLES = 5, 30  # that ISO 9283:1998 asks for (7.2, tables 5 and 8)


@dataclass(frozen=True)
class PoseFigures:
    """What one pose of the test shows. visits: how often it was attained. station: of the first visit.

    ap_mm: pose accuracy [mm] by model ("nominal", "final"). rp_mm: repeatability [mm]. ap_deg: (3,) about x, y, z of
    the instrument's frame, by model; rp_deg: (3,), the half width ±3 standard deviations; None without orientations.
    """

    station: int
    visits: int
    ap_mm: Mapping[str, float]
    rp_mm: float
    ap_deg: Mapping[str, Array] | None = None
    rp_deg: Array | None = None


@dataclass(frozen=True)
class PoseTest:
    """The figures of each pose, and what the recording lacks for them. missing: a sentence; empty where they hold."""

    poses: tuple[PoseFigures, ...] = ()
    missing: str = ""

    def worst_mm(self, model: str) -> tuple[float, float] | None:
        """(AP, RP) of the worst poses [mm] by a model; None where there are no figures."""
        if not self.poses:
            return None
        return max(p.ap_mm[model] for p in self.poses), max(p.rp_mm for p in self.poses)


def pose_test(samples: Samples, errors: Mapping[str, Errors]) -> PoseTest:
    """The figures of the samples that were scored.

    samples: those that the errors are of. errors: by model, "nominal" and "final" among them.
    """
    plain = np.isin(samples.kind, (POSE, POINT)) & ~samples.moving
    often = np.bincount(samples.frame[plain], minlength=1)  # of several instruments the one that read most
    rows = np.flatnonzero(plain & (samples.frame == np.argmax(often)))
    if not len(rows):
        return PoseTest(missing=_lacking(0, 0, 0, "no scored reading is a position taken at rest"))
    rows = rows[np.argsort(samples.stamps[rows], kind="stable")]
    groups = [group for group in visits(samples, rows) if len(group) > 1]
    enough = [group for group in groups if len(group) >= CYCLES]
    if len(enough) < POSES:
        most = max(map(len, groups), default=1)
        return PoseTest(missing=_lacking(len(groups), most, len(enough)))
    return PoseTest(tuple(_figures(samples, errors, group) for group in enough))


def visits(samples: Samples, rows: np.ndarray) -> list[np.ndarray]:
    """Rows of the visits to each posture, from the side that most of them came from, in order of the first visit.

    rows: of readings at rest, in order of time. A visit counts where the arm was elsewhere since the one before.
    """
    q, approach = samples.q[rows], samples.approach[rows]
    stood = np.r_[False, np.abs(np.diff(q, axis=0)).max(axis=1) <= LEFT]
    step = np.diff(q, axis=0, prepend=q[:1])
    come = np.where(np.abs(step) > TRAVEL, np.sign(step), 0.0)
    side = np.where((approach != 0.0).any(axis=1)[:, None], approach, come)
    new = np.flatnonzero(~stood)
    number = posture_numbers(q[new])
    members = [new[number == k] for k in np.unique(number)]
    return [rows[_same_side(group, side)] for group in members]


def _same_side(group: np.ndarray, side: Array) -> np.ndarray:
    """Visits from the side that most of them came from; those from an unknown side are included."""
    unknown = ~(side[group] != 0.0).any(axis=1)
    if unknown.all():
        return group
    _, which, count = np.unique(side[group[~unknown]], axis=0, return_inverse=True, return_counts=True)
    same = unknown.copy()
    same[~unknown] = which.ravel() == np.argmax(count)
    return group[same]


def _figures(samples: Samples, errors: Mapping[str, Errors], group: np.ndarray) -> PoseFigures:
    attained = samples.reading[group]
    distance = np.linalg.norm(attained - attained.mean(axis=0), axis=1)
    rp = float(distance.mean() + 3.0 * distance.std(ddof=1))
    ap = {model: 1e3 * float(np.linalg.norm(e.position[group].mean(axis=0))) for model, e in errors.items()}
    station = int(samples.station[group[0]])
    if not samples.is_pose[group].all():
        return PoseFigures(station, len(group), ap, 1e3 * rp)
    of_pose = np.cumsum(samples.is_pose) - 1  # rows of the rotations
    turns = {model: np.degrees(e.rotation[of_pose[group]]) for model, e in errors.items()}
    R = samples.R[group]
    spread = np.degrees(so3.log(R @ so3.mean(R).T).std(axis=0, ddof=1))
    accuracy = {model: turn.mean(axis=0) for model, turn in turns.items()}
    return PoseFigures(station, len(group), ap, 1e3 * rp, accuracy, 3.0 * spread)


def _lacking(poses: int, most: int, enough: int, because: str = "") -> str:
    asked = f"ISO 9283 asks for {CYCLES} visits from one side to each of {POSES} poses"
    if because:
        return f"{asked}; {because}."
    if not poses:
        return f"{asked}; no scored pose was visited twice from one side."
    if enough:
        return f"{asked}; so often {_counted(enough)} visited here."
    return f"{asked}; here {_counted(poses)} visited more than once from one side, at most {most} times."


def _counted(count: int) -> str:
    """``one pose was``, ``2 poses were``."""
    return "one pose was" if count == 1 else f"{count} poses were"
