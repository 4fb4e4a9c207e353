"""Known distances, which give the scale: between the origins of frames, such as two sockets in one plate, and between
the places where the tool was at two stations, such as the ends of a gauge block or of a ball bar that were touched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.linearisation import RowView, deviations, geometry_rows, model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects import all_columns
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, error_transform, local_twists
from modcal_core.measurements import POINT, Samples

CONTRADICTED = 4.0  # combined standard deviations, from which readings contradict a distance
_TOUCHING = 1e-9  # m; ends that lie in one point have no direction
_NEAR = 0.5  # s between a stamp that is stated and the station that it means


@dataclass(frozen=True)
class Distance:
    """Known distance between the origins of two frames. between: frame names; distance, std: [m]."""

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
    origin = _origins(model, parameters, values)
    motion = _motions(model, parameters, values, origin)
    residual, rows = [], []
    for known in distances:
        if isinstance(known, StationDistance):
            length, row = _between_stations(model, parameters, values, known)
        else:
            gap = _gap(model, known, origin)
            length = max(float(np.linalg.norm(gap)), _TOUCHING)
            row = _gap(model, known, motion) @ (gap / length)
        residual.append(known.distance - length)
        rows.append(row)
    return DistanceRows(np.array(residual), np.stack(rows, axis=1), np.array([d.std for d in distances]))


def distance_cost(
    model: Model, parameters: Sequence[ModelParameter], values: Array, distances: Sequence[AnyDistance]
) -> float:
    """What known distances add to the cost of a fit with the parameters at these values."""
    if any(isinstance(known, StationDistance) for known in distances):
        return distance_rows(model, parameters, values, distances).cost
    origin = _origins(model, parameters, values)
    gaps = [_gap(model, known, origin) for known in distances if isinstance(known, Distance)]
    missed = (np.array([d.distance for d in distances]) - np.linalg.norm(gaps, axis=1)) / [d.std for d in distances]
    return float(missed @ missed)


def _origins(model: Model, parameters: Sequence[ModelParameter], values: Array) -> Array:
    """Origins of the frames as seen from the root (F, 3) [m], with the parameters at these values."""
    errors = deviations(model, parameters, values[: len(parameters)])
    poses = model.T_frame_base @ model.chain.T_base_root @ error_transform(errors.frames)
    return np.asarray(-np.einsum("fji,fj->fi", poses[:, :3, :3], poses[:, :3, 3]))


def _motions(model: Model, parameters: Sequence[ModelParameter], values: Array, origin: Array) -> Array:
    """Derivatives of frame origins by every value, (F, K, 3)."""
    out = np.zeros((len(model.frames), len(values), 3))
    of_frames = [j for j, p in enumerate(parameters) if p.place == 0]
    if not of_frames:
        return out
    frame = np.array([parameters[j].frame for j in of_frames])
    errors = deviations(model, parameters, values[: len(parameters)])
    twist = local_twists(errors.frames)[frame, [parameters[j].direction for j in of_frames]]
    # the frame's error carries the root, so its origin moves the other way when seen from the root
    moved = -(twist[:, :3] + np.cross(twist[:, 3:], origin[:, None]))
    leader = np.array([model.leader(f) for f in range(len(model.frames))])
    out[:, of_frames] = np.where((frame == leader[:, None])[..., None], moved, 0.0)
    return out


def _gap(model: Model, known: Distance, at: Array) -> Array:
    """From one end to the other, of values (F, …) of all frames."""
    a, b = (model.frames.index(name) for name in known.between)
    return np.asarray(at[a] - at[b])


def _between_stations(
    model: Model, parameters: Sequence[ModelParameter], values: Array, known: StationDistance
) -> tuple[float, Array]:
    assert known.ends is not None
    now = model_at(model, parameters, values)
    at = model.drivers(known.ends)
    view = RowView.of(now, known.ends, at)
    gap = view.f.p[-1][:, 1] - view.f.p[-1][:, 0]
    length = max(float(np.linalg.norm(gap)), _TOUCHING)
    rows = [geometry_rows(view, model, parameters, values)]
    if len(values) > len(parameters):
        rows += [view.moved_by(terms)[None] for terms in all_columns(now.effects, at)]
    moved = np.concatenate(rows).reshape(len(values), 3, 2)
    return length, (moved[:, :, 1] - moved[:, :, 0]) @ (gap / length)
