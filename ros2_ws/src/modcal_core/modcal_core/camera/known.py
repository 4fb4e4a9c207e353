"""What a calibration by camera knows of itself, for other verbs: the covariance about the model as it is written.

The fit has its covariance about where its values ended, from the drawing on, with the lens, the target and the sheet's
size beside them; a calibration is written with the least change to its drawing. Both are the same small motions of the
tool, so the one is brought to the other by the derivatives of readings at general postures.
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import View
from modcal_core.calibration.structure import general_samples
from modcal_core.calibration.uncertainty import Uncertainty
from modcal_core.camera.fit import CameraFit
from modcal_core.measurements.recording import POSE


def uncertainty_about(model: Model, fit: CameraFit) -> Uncertainty:
    """The covariance of this model, which predicts as the fit does. What is uncertain of lens, target and sheet is in
    it.
    """
    poses = fit.poses
    count, P = poses.of_model, len(poses.parameters)
    samples = general_samples(model, [View(POSE, f) for f in range(len(model.frames))], each=max(24, count))
    ended = linearise(poses.model, poses.parameters, fit.state.values[:count], samples).J
    written = linearise(
        model, poses.parameters, np.concatenate([np.zeros(P), *(e.values for e in model.effects)]), samples
    ).J
    scale = 1.0 / np.maximum(np.linalg.norm(written, axis=1), 1e-300)
    to_written = scale[:, None] * np.linalg.lstsq((written * scale[:, None]).T, ended.T, rcond=1e-9)[0]
    covariance = to_written @ fit.covariance[:count, :count] @ to_written.T
    return Uncertainty(poses.parameters, 0.5 * (covariance + covariance.T))
