"""Recordings of an arm that never stops: joint states at some rate, and poses fifty times a second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from workcell import BEGIN, Works  # which puts bench/undeclared on the path

from scenarios import Stations  # isort: skip

from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording

Array = np.ndarray


def course(works: Works, rng: np.random.Generator) -> Callable[[Array], Array]:
    """A smooth course of all joints (m, n) at times (m,)."""
    middle, half = works.arm.range.mean(axis=0), 0.4 * np.ptp(works.arm.range, axis=0)
    speed, phase = rng.uniform(0.25, 0.5, (2, works.arm.n)), rng.uniform(0.0, 2.0 * np.pi, (2, works.arm.n))
    return lambda t: middle + 0.5 * half * np.sin(t[:, None, None] * speed + phase).sum(axis=1)


def moving(
    works: Works,
    rng: np.random.Generator,
    rate: float,
    late: Array | float = 0.0,
    clock: float = 0.0,
    ahead: float | None = None,
) -> Recording:
    """An arm that never stops. rate: of joint states [Hz]. late: by which each joint's log lags (n,) [s]. clock: by
    which the tracker's stamps are late [s]. ahead: by which commands precede the joints [s]; None: none are recorded.
    """
    goes = course(works, rng)
    t = np.arange(0.0, 90.0, 1.0 / rate)
    t = t + rng.uniform(-0.1, 0.1, len(t)) / rate
    at = np.arange(1.0, 89.0, 0.02)
    exact = works.cell.poses(Stations(goes(at), at, np.ones((len(at), works.arm.n))), ())
    p = exact.p + rng.normal(0, 2e-5, exact.p.shape)
    R = exact.R * Rotation.from_rotvec(rng.normal(0, 2e-5, p.shape))
    lag = np.broadcast_to(np.asarray(late, dtype=float), (works.arm.n,))
    q = np.stack([goes(t - lag[j])[:, j] for j in range(works.arm.n)], axis=1)
    unknown = np.full_like(q, np.nan)
    joints = JointTrack(works.names, BEGIN + t, q, unknown, unknown, BEGIN + t)
    told = () if ahead is None else (replace(joints, position=goes(t + ahead), topic="/joint_commands"),)
    read = BEGIN + at + clock
    reading = ReadingTrack("pose", "tracker", read, np.concatenate([p, R.as_quat()], axis=1), read)
    return Recording((joints,), (reading,), (), works.arm.urdf, commands=told)
