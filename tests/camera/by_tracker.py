"""How far an arm is off by a tracker: its frame, and the reflector's place on the tool, refitted as with readings."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array


def missed_by_tracker(T: Array, true: Array, point: Array) -> float:
    """RMS distance [m] of a reflector at ``point`` of the tool, by poses T (N, 4, 4) of an arm, from where it is by the
    true ones (N, 4, 4).
    """
    seen, place = se3.apply(true, point), np.asarray(point)
    for _ in range(20):
        at = se3.apply(T, place)
        U, _, Vt = np.linalg.svd((seen - seen.mean(0)).T @ (at - at.mean(0)))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        gap = (seen - seen.mean(0)) @ R - (at - at.mean(0))
        rows = T[:, :3, :3] - T[:, :3, :3].mean(axis=0)
        place = place + np.linalg.lstsq(rows.reshape(-1, 3), gap.reshape(-1), rcond=None)[0]
    return float(np.sqrt((gap**2).sum(1).mean()))
