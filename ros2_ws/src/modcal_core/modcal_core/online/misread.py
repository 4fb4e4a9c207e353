"""Whether what seems to have changed is how readings are written: units or a convention other than the calibration's.

A tracker's driver that is restarted with another setting looks like a base that has moved by metres, or like a load.
Once there are enough samples, the same question is asked as of a recording that is checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import NoiseModel
from modcal_core.calibration.score import errors
from modcal_core.errors import BadRecording
from modcal_core.measurements.samples import Samples
from modcal_core.online.change_hypothesis import ChangeHypothesis
from modcal_core.plausibility.mistakes import inverse_pose
from modcal_core.plausibility.recognise import MIN, MISREAD, ArmMiss, recognised

_UNTOLD = "readings in another unit or convention"


def or_misread(change: ChangeHypothesis, model: Model, rows: Sequence[Samples], noise: NoiseModel) -> ChangeHypothesis:
    """The change; the mistake in its place, where the samples (rows) since then are of the arm once that is undone.

    While there are too few to tell, a change that is larger than an arm's own is said to be either.
    """
    samples = reduce(Samples.followed_by, rows)
    off, reach = errors(model, samples), model.chain.reach()
    if len(samples) < MIN:
        turned = float(np.median(off.rotation_norm)) if samples.is_pose.all() else 0.0
        near = ArmMiss(float(np.median(off.position_norm)), turned).size(reach) < MISREAD * reach
        return change if near else replace(change, same_as=(_UNTOLD, *change.same_as))
    try:
        undone = recognised(model, samples, noise).undone
    except BadRecording as mistake:
        said = str(mistake)
    else:
        if undone is None:
            return change
        said = f"{inverse_pose().offender}: {inverse_pose().remedy}"
    size = float(np.sqrt(np.mean(off.position_norm**2)))
    return replace(change, place="tracker", direction="convention", size=size, same_as=(), mistake=said)
