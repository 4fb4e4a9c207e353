"""What else is known of the arm at the moments of the images: what effects depend on besides posture."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.recording import POSE, SignalTrack
from modcal_core.measurements.samples import Samples


def _nothing() -> Array:
    return np.empty((0, 0))


@dataclass(frozen=True)
class ImageMoments:
    """stamps: of the images [s], (N,); empty where only their order is known. approach: the direction each joint last
    moved in, −1, 0 (unknown) or 1, (N, n). effort: of the actuators, (N, n). Empty where unknown. signals: tracks of
    whatever else was recorded. stop: number of the stop of each image, which images of other cameras share, (N,); −1,
    or empty, where none does.
    """

    stamps: Array = field(default_factory=lambda: np.empty(0))
    approach: Array = field(default_factory=_nothing)
    effort: Array = field(default_factory=_nothing)
    signals: tuple[SignalTrack, ...] = ()
    stop: np.ndarray = field(default_factory=lambda: np.empty(0, int))

    def select(self, rows: np.ndarray) -> ImageMoments:
        """Moments of some of the images."""
        each = (self.stamps, self.approach, self.effort, self.stop)
        stamps, approach, effort, stop = (a[rows] if len(a) else a for a in each)
        return ImageMoments(stamps, approach, effort, self.signals, stop)

    def elsewhere(self) -> ImageMoments:
        """What is known of postures that nobody has measured: nothing."""
        return NOTHING_KNOWN

    def samples(self, q: Array, velocity: Array, names: tuple[str, ...], frames: tuple[str, ...]) -> Samples:
        """Pose samples (N) at these moments, whose readings say nothing: for drivers and derivatives."""
        N = len(q)
        timed = len(self.stamps) == N and N > 0
        return Samples(
            names=names,
            frames=frames,
            q=q,
            stamps=self.stamps if timed else np.arange(N, dtype=float),
            station=np.arange(N),
            frame=np.zeros(N, int),
            kind=np.full(N, POSE, dtype=KIND_NAMES),
            reading=np.zeros((N, 3)),
            R=np.broadcast_to(np.eye(3), (N, 3, 3)),
            sigma_position=np.full(N, np.nan),
            sigma_rotation=np.full(N, np.nan),
            velocity=velocity,
            moving=np.zeros(N, bool),
            approach=self.approach if len(self.approach) == N else _nothing(),
            effort=self.effort if len(self.effort) == N else _nothing(),
            signals=self.signals,
            clock=timed,
        )


NOTHING_KNOWN = ImageMoments()
