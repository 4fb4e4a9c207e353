"""What is asked of a pull in the small world: its task and limits, and that it is gentle and smooth."""

from __future__ import annotations

import math

import numpy as np
from impedance.toy import PERIOD, T_READY, Pulled, limits

from modcal_core.impedance.task import ImpedanceTask

PEAK, MEAN, ABORT = 40.0, 12.0, 60.0  # N
BACK = T_READY[:3, :3].T @ np.array([-1.0, 0.0, 0.0])  # towards −x of the base, seen from the tool
TASK = ImpedanceTask(
    direction=BACK, goal_rad=math.radians(40.0), goal_m=0.2
)  # by then the model is followed at full speed
LIMITS = limits()


def assert_gentle(done: Pulled, peak: float = PEAK) -> None:
    assert done.forces.max() <= peak
    assert done.forces.mean() <= MEAN


def assert_smooth(done: Pulled) -> None:
    """Steps of what was sent, by differences of joints and poses, within the limits."""
    times = np.array([t for t, _ in done.setpoints])
    gaps = np.diff(times)
    together = gaps < 5.0 * PERIOD
    p = np.array([s.pose[:3, 3] for _, s in done.setpoints])
    q = np.array([s.q for _, s in done.setpoints])
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / gaps
    assert (speed <= LIMITS.speed).all()
    rates = np.diff(q, axis=0) / gaps[:, None]
    assert (np.abs(rates) <= LIMITS.joint_speed).all()
    change = np.abs(np.diff(rates, axis=0)) / gaps[1:, None]
    assert (change[together[1:] & together[:-1]] <= LIMITS.joint_acceleration * 1.001).all()
