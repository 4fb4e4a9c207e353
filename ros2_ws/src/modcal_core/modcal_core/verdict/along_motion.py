"""Readings in motion that err along the way they go: stamps that come too late by another time each.

A constant delay is fitted. What a busy computer or an irregular trigger adds to it from reading to reading moves each
one along the velocity of the target, and no reading across it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import RowView
from modcal_core.effects import place_index
from modcal_core.measurements import spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import is_serial_arm
from modcal_core.verdict.case import Case

_MIN, _MAX = 60, 3000  # readings in motion
_SLOW = 0.02  # m/s; slower ones have no direction to speak of
_TIMES = 4.0  # mean square along the way, in that of a direction across it
_MOSTLY = 0.6  # of all squares
_MIN_TIME = 2e-4  # s; less is what clocks of computers are apart by
_FARTHEST = 5.0  # times the median size; no reading may rule alone


@dataclass(frozen=True)
class AlongMotion:
    """seconds: RMS time that readings are off by. share: of the squares along the way. times: those across it, RMS."""

    seconds: float
    share: float
    times: float

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        return (
            f"Most of what is left while the arm moves ({self.share:.0%} of the squared position error) lies along the "
            f"direction of motion, {self.times:.2g} times what lies across it: as if the stamps of readings were off "
            f"by {1e3 * self.seconds:.2g} ms RMS, each by another time. Look at how readings and joint states are "
            "stamped (a busy computer, buffers, the time of arrival), or record at rest."
        )


def along_motion(case: Case) -> AlongMotion | None:
    """Errors along the velocity of the target, where they are most of what a case leaves in motion; None otherwise."""
    rows = np.flatnonzero(~case.wrong) if case.fitted else case.held_out
    rows = rows[case.samples.moving[rows] & np.isfinite(case.samples.velocity[rows]).all(axis=1)]
    chain = case.model.chain
    if len(rows) < _MIN or not is_serial_arm(chain) or not is_direct(case.samples.kinds):
        return None
    rows = rows[spread_rows(len(rows), _MAX)]
    samples = case.samples.select(rows)
    view = RowView.of(case.model, samples, case.model.drivers(samples))
    velocity = np.zeros((3, len(samples)))
    for j, (name, turns) in enumerate(zip(chain.names, chain.revolute, strict=True)):
        column = view.unit_column(place_index(name, chain), 5 if turns else 2).reshape(-1)[: 3 * len(samples)]
        velocity += column.reshape(3, -1) * samples.velocity[:, j]
    speed = np.linalg.norm(velocity, axis=0)
    fast = speed > _SLOW
    if fast.sum() < _MIN:
        return None
    way, gap, speed = velocity[:, fast] / speed[fast], view.position[:, fast], speed[fast]
    size = np.linalg.norm(gap, axis=0)
    gap = gap * np.minimum(1.0, _FARTHEST * float(np.median(size)) / np.maximum(size, 1e-300))
    along = np.sum(gap * way, axis=0)
    whole = float(np.mean(np.sum(gap**2, axis=0)))
    square = float(np.mean(along**2))
    across = 0.5 * (whole - square)
    seconds = float(np.sqrt(np.median((along / speed) ** 2))) / 0.6745  # of a normal deviate
    if square < _TIMES * across or square < _MOSTLY * whole or seconds < _MIN_TIME:
        return None
    return AlongMotion(seconds, square / whole, float(np.sqrt(square / max(across, 1e-300))))
