"""A frozen calibration as a check uses it: the model beside the new samples, and what it knows of itself there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import INSTRUMENT, Calibration, Model, with_frames
from modcal_core.checking.noise import FrozenKnowledge
from modcal_core.measurements import Samples

PATTERN = 0.25  # share of the variance that is taken to be common to neighbouring postures where no report says it
_MIN_PATTERN = 0.1  # the same where a report saw none: of 160 stations it sees no less than some ten per cent


@dataclass(frozen=True)
class FrozenCalibration:
    """model: for these samples. known: what it knows of itself. kept: whether the calibration keeps a covariance.
    index: of the covariance's rows, those that these samples have.
    """

    model: Model
    known: FrozenKnowledge
    kept: bool
    index: np.ndarray


def pattern_of(predictable: float | None) -> float:
    """The share of the noise that neighbouring postures have in common, by the predictable share in the calibration's
    report; None where there is no report.
    """
    return PATTERN if predictable is None else float(np.clip(predictable, _MIN_PATTERN, 1.0))


def frozen(calibration: Calibration, applied: Model, samples: Samples, pattern: float) -> FrozenCalibration:
    """The calibration beside these samples.

    applied: its model with the effects that these samples allow. pattern: share of its noise that postures have in
    common. Raises BadTable for a frame that it does not know.
    """
    model = with_frames(applied, samples.frames)
    own = calibration.uncertainty
    if own is None:
        return FrozenCalibration(
            model, FrozenKnowledge((), np.zeros((0, 0)), (), calibration.noise, pattern), False, np.empty(0, int)
        )
    # parameters of frames and instruments that these samples have, by their numbers there
    of_frame = {calibration.calibrated.frames.index(name): f for f, name in enumerate(samples.frames)}
    kept_instruments = [i for i, one in enumerate(calibration.calibrated.instruments) if one.frame in samples.frames]
    of_instrument = {i: k for k, i in enumerate(kept_instruments)}
    leaders = calibration.calibrated.leaders
    parameters, index = [], []
    for i, p in enumerate(own.parameters):
        if p.place == INSTRUMENT:
            if p.instrument not in of_instrument:
                continue
            p = replace(p, instrument=of_instrument[p.instrument], frame=of_frame.get(p.frame, -1))
        elif p.place == 0 and p.frame >= 0:
            led = [f for f in of_frame if (leaders[f] if leaders else f) == p.frame]
            if len(led) != 1:  # of frames that shared an error none stands for the others here
                continue
            p = replace(p, frame=of_frame[led[0]])
        parameters.append(p)
        index.append(i)
    effects, first = [], len(own.parameters)
    for effect in calibration.calibrated.effects:
        count = len(effect.values)
        if any(effect is e or (effect.key == e.key and len(e.values) == count) for e in model.effects):
            effects.append(effect)
            index += range(first, first + count)
        first += count
    at = np.array(index, dtype=int)
    return FrozenCalibration(
        model,
        FrozenKnowledge(tuple(parameters), own.covariance[np.ix_(at, at)], tuple(effects), calibration.noise, pattern),
        True,
        at,
    )
