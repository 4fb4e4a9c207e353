"""The rows of a linearisation at the readings of a check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import FINEST, NoiseModel
from modcal_core.geometry import Array
from modcal_core.measurements import Samples


@dataclass(frozen=True)
class RowKinds:
    """What each row of a linearisation is. sample: its index. component: 0 … 5. variance, known: of the spread and of
    the reading's own statement.
    """

    sample: np.ndarray
    component: np.ndarray
    variance: Array
    known: Array

    @classmethod
    def of(cls, samples: Samples, noise: NoiseModel) -> RowKinds:
        """The rows of these samples."""
        N, pose = len(samples), np.flatnonzero(samples.is_pose)
        sample = np.concatenate([np.tile(np.arange(N), 3), np.tile(pose, 3)])
        component = np.concatenate([np.repeat(np.arange(3), N), np.repeat(np.arange(3, 6), len(pose))])
        position = np.broadcast_to(np.maximum(noise.of(samples), FINEST) ** 2, N)
        rotation = max(noise.rotation, FINEST) ** 2
        turned = component >= 3
        known_p, known_r = (np.nan_to_num(s) ** 2 for s in (samples.sigma_position, samples.sigma_rotation))
        return cls(
            sample,
            component,
            np.where(turned, rotation, position[sample]),
            np.where(turned, known_r[sample], known_p[sample]),
        )
