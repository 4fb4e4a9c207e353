"""Frames that the calibration does not know: an instrument that was set up again under another name, a new socket.

Where such a frame stands is found from the readings of the check, with the arm and the tool of the calibration, and
stays open while changes are looked for: six numbers that are given to be other ones, and are no change of the arm. That
the base moved cannot be told there; what the arm and the tool did can.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import Calibration, Cell, Model, ModelParameter, Uncertainty, direction_names, refit_cell
from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import is_direct
from modcal_core.moves import FRAME, CellChange, GeometryMotion


def new_frames(calibration: Calibration, samples: Samples) -> tuple[str, ...]:
    """Frames of the samples that the calibration does not know. Raises BadTable where readings do not place one."""
    new = tuple(name for name in samples.frames if name not in calibration.frames)
    for name in new:
        rows = samples.frame == samples.frames.index(name)
        if not is_direct(np.unique(samples.kind[rows]).tolist()):
            raise BadTable(
                f"frame '{name}' of the recording",
                f"the calibration knows only {', '.join(calibration.frames)}, and such readings do not place it",
                "give the frame its name of then, or calibrate again with this instrument",
            )
    return new


def with_new_frames(calibration: Calibration, applied: Model, samples: Samples, new: tuple[str, ...]) -> Calibration:
    """The calibration with these frames where its arm and tool put them. Raises NotEnoughData for too few readings.

    applied: its model with the effects that these samples allow. Its covariance has the new frames' six numbers, taken
    for exact: what is not known of them is in the sizes of what is given.
    """
    part = _seen_from(samples, new)
    models = [
        _added(model, refit_cell(by, part, Cell(), base=True, tool=False).model.T_frame_base, new)
        for model, by in (
            (calibration.nominal, calibration.nominal),
            (calibration.calibrated, applied),
            (calibration.geometric, calibration.geometric),
        )
    ]
    known, nominal = calibration.uncertainty, models[0]
    if known is not None:
        first, P = len(calibration.frames), len(known.parameters)
        added = [p for i, name in enumerate(new) for p in _parameters(nominal, name, first + i, samples)]
        covariance = np.insert(np.insert(known.covariance, [P] * len(added), 0.0, 0), [P] * len(added), 0.0, 1)
        known = Uncertainty((*known.parameters, *added), covariance)
    return replace(calibration, nominal=nominal, calibrated=models[1], geometric=models[2], uncertainty=known)


def placed_anew(samples: Samples, new: tuple[str, ...]) -> tuple[CellChange, ...]:
    """What is given of these frames: each stands elsewhere than at its first guess."""
    return tuple(
        CellChange(FRAME, name, tuple(GeometryMotion(0, _unit(d), f) for d in _directions(samples, name)))
        for name in new
        for f in [samples.frames.index(name)]
    )


def _directions(samples: Samples, name: str) -> range:
    """A socket shows one point, which has no orientation."""
    return range(3) if samples.is_same_point(samples.frames.index(name)) else range(6)


def _unit(direction: int) -> tuple[float, ...]:
    return tuple(float(k == direction) for k in range(6))


def _parameters(model: Model, name: str, frame: int, samples: Samples) -> list[ModelParameter]:
    words = direction_names(model.chain.joint_basis[0])
    return [ModelParameter(f"frame {name}/{words[d]}", 0, d, frame) for d in _directions(samples, name)]


def _seen_from(samples: Samples, frames: tuple[str, ...]) -> Samples:
    """The readings in these frames alone."""
    numbers = [samples.frames.index(name) for name in frames]
    part = samples.select(np.flatnonzero(np.isin(samples.frame, numbers)))
    return replace(part, frames=frames, frame=np.array([numbers.index(f) for f in part.frame.tolist()], dtype=int))


def _added(model: Model, poses: Array, new: tuple[str, ...]) -> Model:
    """The model with these frames behind its own."""
    leaders = (*model.leaders, *range(len(model.frames), len(model.frames) + len(new))) if model.leaders else ()
    return replace(
        model, frames=(*model.frames, *new), T_frame_base=np.concatenate([model.T_frame_base, poses]), leaders=leaders
    )
