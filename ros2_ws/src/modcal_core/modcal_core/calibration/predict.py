"""Where a calibrated robot's tool is, at postures and beside whatever else they are known with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration.store import Calibration
from modcal_core.calibration.typical import outside_drivers
from modcal_core.effects.drivers import NominalArm
from modcal_core.errors import BadRecording, BadTable, MissingDriver
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POSE
from modcal_core.measurements.samples import KIND_NAMES, Samples


def predict(calibration: Calibration, q: ArrayLike | Samples, frame: str | None = None) -> Array:
    """Poses of the tool; see :meth:`modcal_core.calibration.store.Calibration.predict`."""
    model = calibration.calibrated
    samples = q.of_joints(model.chain.names) if isinstance(q, Samples) else _standing(calibration, q)
    names = samples.frames if frame is None and isinstance(q, Samples) else (frame or model.frames[0],)
    unknown = [name for name in names if name not in model.frames]
    if unknown:
        remedy = f"give one of {', '.join(model.frames)}"
        raise BadTable(f"frame {unknown[0]}", "is not in the calibration", remedy)
    index = np.array([model.frames.index(name) for name in names])
    at = (
        index[samples.frame] if len(names) == len(samples.frames) and frame is None else np.full(len(samples), index[0])
    )
    samples = replace(samples, frames=model.frames, frame=at)
    _require_drivers(calibration, samples)
    arm = replace(model.arm or NominalArm(calibration.nominal.chain), limits=calibration.driver_limits)
    return replace(model, arm=arm).predict_samples(samples)


def _standing(calibration: Calibration, q: ArrayLike) -> Samples:
    """Postures of an arm that stands still, of which nothing else is known."""
    chain = calibration.calibrated.chain
    postures = np.array(q, dtype=float)
    if postures.ndim != 2 or postures.shape[1] != chain.n or not np.isfinite(postures).all():
        said = f"has shape {postures.shape}, or is not finite; (N, {chain.n}) is read"
        raise BadRecording("q", said, f"give one posture a row, in the order {', '.join(chain.names)}")
    N, unknown = len(postures), np.full(len(postures), np.nan)
    return Samples(
        names=chain.names,
        frames=calibration.frames[:1],
        q=postures,
        stamps=unknown,
        station=np.arange(N),
        frame=np.zeros(N, int),
        kind=np.full(N, POSE, dtype=KIND_NAMES),
        reading=np.zeros((N, 3)),
        R=np.tile(np.eye(3), (N, 1, 1)),
        sigma_position=unknown,
        sigma_rotation=unknown,
        velocity=np.zeros_like(postures),
        moving=np.zeros(N, bool),
    )


def _require_drivers(calibration: Calibration, samples: Samples) -> None:
    """Raises MissingDriver unless all that the effects depend on is known at every sample."""
    for effect in calibration.calibrated.effects:
        for part in outside_drivers(effect):
            kind, _, of = part.partition(":")
            known = {
                "time": lambda of: np.isfinite(samples.stamps).all(),
                "effort": lambda of: np.isfinite(samples.effort[:, samples.names.index(of)]).all(),
            }.get(kind, lambda of, part=part: any(track.name == part for track in samples.signals))
            if not known(of):
                remedy = "give Samples that carry it, or calibrate without the effect"
                raise MissingDriver(part, f"the effect {effect.label} depends on it and it is not given", remedy)
