"""The last stations, as the viewer keeps them, and what two models make of them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.correction import ArmState, Correction, Residuals, arm_state_of, known_to, residuals
from modcal_core.measurements import Samples, SignalTrack

_MIN_GAP = 0.2  # s between readings of an arm in motion that are kept


@dataclass(frozen=True)
class JudgedStations:
    """calibrated, nominal: by how much either model misses the stations. moments: theirs, for the calibrated arm.
    strangers: frames of readings that the calibration does not know.
    """

    calibrated: Residuals
    nominal: Residuals
    moments: tuple[ArmState, ...]
    strangers: tuple[str, ...]


class Stations:
    """The last so many stations; of an arm in motion, readings some time apart."""

    def __init__(self, most: int) -> None:
        self._kept: deque[Samples] = deque(maxlen=most)

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, sample: Samples) -> bool:
        """Keep one sample (a row), if it is wanted; returns whether it was."""
        since = float(sample.stamps[0] - self._kept[-1].stamps[0]) if self._kept else _MIN_GAP
        if sample.moving[0] and 0.0 <= since < _MIN_GAP:
            return False
        self._kept.append(sample)
        return True

    def clear(self) -> None:
        """Forget them."""
        self._kept.clear()

    @property
    def postures(self) -> np.ndarray:
        """Joint positions of them all, (N, n); (0, 0) while there are none."""
        return np.concatenate([s.q for s in self._kept]) if self._kept else np.empty((0, 0))

    def judged(self, correction: Correction, signals: tuple[SignalTrack, ...]) -> JudgedStations | None:
        """What a calibration and its nominal arm make of them; None while there are none that it can tell of.

        signals: what the effects depend on. Raises MissingDriver where that is not known.
        """
        if not self._kept:
            return None
        calibration, (*before, last) = correction.calibration, self._kept
        of_frame = [s.frames[int(s.frame[0])] for s in self._kept]
        strangers = tuple(sorted(set(of_frame) - set(calibration.calibrated.frames)))
        samples = replace(known_to(calibration.calibrated, last.join(*before)), signals=signals)
        if not len(samples):
            return JudgedStations(_NOTHING, _NOTHING, (), strangers)
        moments = tuple(arm_state_of(samples.select(np.array([i])), signals) for i in range(len(samples)))
        for at in moments:
            correction.require(at)
        models, noise = (calibration.calibrated, calibration.nominal), calibration.noise
        calibrated, nominal = (residuals(model, samples, noise) for model in models)
        return JudgedStations(calibrated, nominal, moments, strangers)


_NOTHING = Residuals(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, bool))
