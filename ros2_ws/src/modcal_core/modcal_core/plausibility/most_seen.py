"""The readings that are looked at as positions in the order of time: those of the frame that has most of them."""

from __future__ import annotations

import numpy as np

from modcal_core.measurements import Samples
from modcal_core.robots import Mechanism, is_serial_arm


def most_seen(samples: Samples, chain: Mechanism, least: int, most: int) -> Samples | None:
    """Poses and points taken at rest in the frame with most readings, the first ``most`` of them by their stamps.

    None where there are fewer than ``least``, of a ball in a socket, and of robots other than serial arms.
    """
    if not is_serial_arm(chain) or not len(samples):
        return None
    f = int(np.argmax(np.bincount(samples.frame)))
    rows = np.flatnonzero((samples.frame == f) & (samples.is_pose | (samples.kind == "point")) & ~samples.moving)
    if len(rows) < least or samples.frames[f] in samples.sockets:
        return None
    return samples.select(rows[np.argsort(samples.stamps[rows], kind="stable")][:most])
