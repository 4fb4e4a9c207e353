"""What goes on sample by sample while a calibration is trusted: the running estimate, and the watch on the model."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.store import Calibration
from modcal_core.measurements.kinds.registry import is_direct
from modcal_core.measurements.samples import Samples
from modcal_core.online.change_detector import ChangeDetector
from modcal_core.online.change_hypothesis import ChangeHypothesis, find_change
from modcal_core.online.estimator import Estimator, RandomWalk
from modcal_core.online.misread import or_misread

_RIDGE = 1e-12  # of each variance; a covariance that was written down may have lost its last digits


class Live:
    """Follows one calibration with every sample.

    estimator: the parameters as they stand now. detector: whether the calibration still holds. hypothesis: what has
    changed, None while nothing has. changed: since when [s]. since: samples taken in after that. strange: samples of
    frames that the calibration does not know, and of kinds that are no positions.
    """

    def __init__(self, calibration: Calibration, random_walk: RandomWalk | None = None) -> None:
        """Begin with a calibration that carries its uncertainty; raises ValueError for one that does not."""
        known = calibration.uncertainty
        if known is None:
            raise ValueError("a calibration without its uncertainty cannot be followed")
        covariance = known.covariance + _RIDGE * np.diag(np.diag(known.covariance))
        self.calibration = calibration
        model, noise = calibration.calibrated, calibration.noise
        self.estimator = Estimator(model, known.parameters, noise, covariance, random_walk, calibration.kind)
        self.detector = ChangeDetector(model, known.parameters, covariance, noise)
        self.hypothesis: ChangeHypothesis | None = None
        self.changed: float | None = None
        self.since = 0
        self.strange = 0

    def add(self, sample: Samples) -> None:
        """Take in one sample (a row)."""
        known = int(sample.frame[0]) < len(self.calibration.calibrated.frames)
        if not known or not is_direct([str(sample.kind[0])]):
            self.strange += 1
            return
        self.estimator.update(sample)
        changed = self.detector.add(sample)
        if changed is not None and self.hypothesis is None:
            self.changed = changed
        if self.changed is None:
            return
        self.since += 1
        # asked again as samples come in: the first answer rests on very few
        if self.hypothesis is None or (self.since & (self.since - 1)) == 0:
            self.hypothesis = self._asked(min(self.changed, self.detector.seen[-1].stamp))

    def _asked(self, since: float) -> ChangeHypothesis:
        rows = [seen.sample for seen in self.detector.seen if seen.stamp >= since]
        return or_misread(find_change(self.detector, since), self.detector.model, rows, self.calibration.noise)
