"""Known distances, which give the scale: between the origins of frames, such as two sockets in one plate, and between
the places where the tool was at two stations, such as the ends of a gauge block or of a ball bar that were touched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.linearise import (
    RowView,
    apply_deviations,
    deviations,
    geometry_rows,
    model_at,
)
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects.effect import all_columns
from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.geometry.twists import local_twists
from modcal_core.measurements.recording import POINT
from modcal_core.measurements.samples import Samples

_NEAR = 0.5  # s between a stamp that is stated and the station that it means


@dataclass(frozen=True)
class Distance:
    """The origins of two frames are this far apart. between: frame names; distance, std: [m]."""

    between: tuple[str, str]
    distance: float
    std: float = 5e-5


@dataclass(frozen=True)
class StationDistance:
    """The tool was this far apart at two stations. stamps: of the stations [s]; distance, std: [m]. ends: the two
    samples, once they are known (see :meth:`met`).
    """

    stamps: tuple[float, float]
    distance: float
    std: float = 5e-5
    ends: Samples | None = None

    def met(self, samples: Samples) -> StationDistance:
        """The distance with its stations found among these samples; raises BadTable where there are none."""
        rows = []
        for stamp in self.stamps:
            row = int(np.argmin(np.abs(samples.stamps - stamp)))
            if abs(samples.stamps[row] - stamp) > _NEAR:
                raise BadTable(
                    f"known distance between stations at {self.stamps[0]:.3f} and {self.stamps[1]:.3f} s",
                    f"no station within {_NEAR:g} s of {stamp:.3f} s",
                    "give the stamps of two stations of this recording",
                )
            rows.append(row)
        # whatever was read there, what counts is where the tool was
        two = samples.select(np.array(rows))
        return replace(self, ends=replace(two, kind=np.array([POINT, POINT], dtype=samples.kind.dtype)))


AnyDistance = Distance | StationDistance


@dataclass(frozen=True)
class DistanceRows:
    """residual: known minus modelled distances [m], (D,). J: (K, D), of the values they are at. std: [m], (D,)."""

    residual: Array
    J: Array
    std: Array

    @property
    def cost(self) -> float:
        """What the distances add to the cost of a fit."""
        return float(np.sum((self.residual / self.std) ** 2))


def distance_rows(
    model: Model, parameters: Sequence[ModelParameter], values: Array, distances: Sequence[AnyDistance]
) -> DistanceRows:
    """Residuals of known distances, and derivatives, with the parameters at these values about the given model.

    values: of the parameters, and behind them, where given, those of the model's effects.
    """
    rows = [
        _between_stations(model, parameters, values, known)
        if isinstance(known, StationDistance)
        else _between_frames(model, parameters, values, known)
        for known in distances
    ]
    J = np.stack([row for _, row in rows], axis=1)
    return DistanceRows(np.array([r for r, _ in rows]), J, np.array([d.std for d in distances]))


def distance_cost(
    model: Model, parameters: Sequence[ModelParameter], values: Array, distances: Sequence[AnyDistance]
) -> float:
    """What known distances add to the cost of a fit with the parameters at these values."""
    return distance_rows(model, parameters, values, distances).cost


def _between_frames(
    model: Model, parameters: Sequence[ModelParameter], values: Array, known: Distance
) -> tuple[float, Array]:
    errors = deviations(model, parameters, values[: len(parameters)])
    now = apply_deviations(model, errors)
    T_root_frame = se3.inverse(now.T_frame_base @ now.chain.T_base_root)
    origin = T_root_frame[:, :3, 3]
    twists = local_twists(errors.frames)
    a, b = (model.frames.index(name) for name in known.between)
    gap = origin[a] - origin[b]
    length = max(float(np.linalg.norm(gap)), 1e-9)
    row = np.zeros(len(values))
    for j, parameter in enumerate(parameters):
        if parameter.place == 0:
            v, w = np.split(twists[parameter.frame][parameter.direction], 2)
            for f, sign in ((a, 1.0), (b, -1.0)):
                if model.leader(f) == parameter.frame:
                    # the frame's error carries the root, so its origin moves the other way when seen from the root
                    row[j] -= sign * float((gap / length) @ (v + np.cross(w, origin[f])))
    return known.distance - length, row


def _between_stations(
    model: Model, parameters: Sequence[ModelParameter], values: Array, known: StationDistance
) -> tuple[float, Array]:
    assert known.ends is not None
    now = model_at(model, parameters, values)
    at = model.drivers(known.ends)
    view = RowView.of(now, known.ends, at)
    gap = view.f.p[-1][:, 1] - view.f.p[-1][:, 0]
    length = max(float(np.linalg.norm(gap)), 1e-9)
    rows = [geometry_rows(view, model, parameters, values)]
    if len(values) > len(parameters):
        rows += [view.moved_by(terms)[None] for terms in all_columns(now.effects, at)]
    moved = np.concatenate(rows).reshape(len(values), 3, 2)
    return known.distance - length, (moved[:, :, 1] - moved[:, :, 0]) @ (gap / length)
