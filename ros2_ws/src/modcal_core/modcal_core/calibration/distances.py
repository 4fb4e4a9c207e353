"""Known distances between the origins of frames, such as two sockets in one plate: they give the scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.linearise import apply_deviations, deviations, local_twists
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import Parameter
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class Distance:
    """The origins of two frames are this far apart. between: frame names; distance, std: [m]."""

    between: tuple[str, str]
    distance: float
    std: float = 5e-5


@dataclass(frozen=True)
class DistanceRows:
    """residual: known minus modelled distances [m], (D,). J: (P, D). std: [m], (D,)."""

    residual: Array
    J: Array
    std: Array


def distance_rows(
    model: Model, parameters: Sequence[Parameter], values: Array, distances: Sequence[Distance]
) -> DistanceRows:
    """Residuals of known distances, and derivatives, with the parameters at these values about the given model."""
    errors = deviations(model, parameters, values)
    now = apply_deviations(model, errors)
    T_root_frame = se3.inverse(now.T_frame_base @ (model.chain.origins[0] @ se3.transform(model.chain.joint_basis[0])))
    origin = T_root_frame[:, :3, 3]
    residual = np.zeros(len(distances))
    J = np.zeros((len(parameters), len(distances)))
    twists = local_twists(errors.frames)
    for i, known in enumerate(distances):
        a, b = (model.frames.index(name) for name in known.between)
        gap = origin[a] - origin[b]
        length = max(float(np.linalg.norm(gap)), 1e-9)
        residual[i] = known.distance - length
        for j, parameter in enumerate(parameters):
            if parameter.place == 0 and parameter.frame in (a, b):
                v, w = np.split(twists[parameter.frame][parameter.direction], 2)
                # the frame's error carries the root, so its origin moves the other way when seen from the root
                moved = -(v + np.cross(w, origin[parameter.frame]))
                J[j, i] = (gap / length) @ moved * (1.0 if parameter.frame == a else -1.0)
    return DistanceRows(residual, J, np.array([d.std for d in distances]))
