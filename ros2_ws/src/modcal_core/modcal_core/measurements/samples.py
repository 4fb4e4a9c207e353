"""Samples: what a fit sees. One row is one reading of one instrument at one posture of the arm."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POSE


@dataclass(frozen=True)
class Samples:
    """N readings with the postures they belong to, all arrays with N rows.

    q: joint positions [rad, m], (N, n), columns in the order of ``names``.
    stamps: [s], (N,). station: number of the dwell or moment; readings of one station share it, and splits keep them
    together. frame: index into ``frames``. kind: "pose" or "point".
    position: reading in its frame [m], (N, 3). R: orientation reading, (N, 3, 3), identity for points.
    sigma_position [m], sigma_rotation [rad]: standard deviation of the reading per axis, (N,), NaN where unknown.
    velocity: of the joints [rad/s, m/s], (N, n), zero in a dwell, NaN where unknown. moving: taken in motion.
    """

    names: tuple[str, ...]
    frames: tuple[str, ...]
    q: Array
    stamps: Array
    station: np.ndarray
    frame: np.ndarray
    kind: np.ndarray
    position: Array
    R: Array
    sigma_position: Array
    sigma_rotation: Array
    velocity: Array
    moving: np.ndarray

    def __len__(self) -> int:
        return len(self.q)

    @property
    def is_pose(self) -> np.ndarray:
        """True where the reading has an orientation, (N,)."""
        return self.kind == POSE

    @property
    def stations(self) -> int:
        """Number of distinct stations."""
        return len(np.unique(self.station))

    def select(self, rows: np.ndarray) -> Samples:
        """The samples at the given rows (mask or indices), in that order."""
        arrays = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name not in ("names", "frames")}
        return replace(self, **arrays)

    def is_same_point(self, frame: int) -> bool:
        """Whether every reading in this frame is one and the same point, as of a ball held in a socket."""
        rows = self.frame == frame
        if self.is_pose[rows].any() or rows.sum() < 2:
            return False
        return bool(np.ptp(self.position[rows], axis=0).max() == 0.0)
