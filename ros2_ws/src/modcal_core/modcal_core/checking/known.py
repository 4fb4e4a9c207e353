"""A frozen calibration as a check uses it: the model beside the new samples, what it knows, and where it was made.

Its covariance says how well its parameters are known, not how well an arm of those parameters is the arm. Within the
ranges it was made from that has been tried; beyond, what it does not have may be as large as what it has corrected.

Where a frame stands that the calibration does not know (an instrument set up again under another name, a new socket) is
found from the readings of the check, and stays open while changes are looked for. That the base moved cannot be told
there; what the arm and the tool did can.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    Model,
    ModelParameter,
    Uncertainty,
    direction_names,
    refit_cell,
)
from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.moves import FRAME, CellChange, FrozenKnowledge, towards

PATTERN = 0.25  # share of the variance that is taken to be common to neighbouring postures where no report says it
_MIN_PATTERN = 0.1  # the same where a report saw none: of 160 stations it sees no less than some ten per cent
_MAX = 0.5  # of the stations, beyond which what they say together is of places where nothing was tried
_MARGIN = 0.02  # of a range, as where samples outside are counted
_ASKED = 10  # stations of the calibration's own that are proposed: as many as a check is to have


def pattern_of(predictable: float | None) -> float:
    """The share of the noise that neighbouring postures have in common, by the predictable share in the calibration's
    report; None where there is no report.
    """
    return PATTERN if predictable is None else float(np.clip(predictable, _MIN_PATTERN, 1.0))


def frozen(calibration: Calibration, applied: Model, pattern: float) -> FrozenKnowledge:
    """What the calibration knows of itself; nothing where it keeps no covariance.

    applied: its model with the effects that the samples allow. pattern: share of its noise that postures have in
    common.
    """
    own = calibration.uncertainty or Uncertainty((), np.zeros((0, 0)))
    effects, index = [], [*range(len(own.parameters))]
    first = len(index)
    for effect in calibration.calibrated.effects if calibration.uncertainty else ():
        count = len(effect.values)
        if any(effect is e or (effect.key == e.key and len(e.values) == count) for e in applied.effects):
            effects.append(effect)
            index += range(first, first + count)
        first += count
    at = np.array(index, dtype=int)
    return FrozenKnowledge(own.parameters, own.covariance[np.ix_(at, at)], tuple(effects), calibration.noise, pattern)


def in_known_frames(samples: Samples, calibration: Calibration) -> Samples:
    """The samples with the calibration's frames, by their numbers there."""
    number = np.array([calibration.frames.index(name) for name in samples.frames])
    return replace(samples, frames=calibration.frames, frame=number[samples.frame])


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
    numbers = [samples.frames.index(name) for name in new]
    part = samples.select(np.flatnonzero(np.isin(samples.frame, numbers)))
    part = replace(part, frames=new, frame=np.array([numbers.index(f) for f in part.frame.tolist()], dtype=int))
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
        words = direction_names(nominal.chain.joint_basis[0])
        added = [
            ModelParameter(f"frame {name}/{words[d]}", 0, d, first + i)
            for i, name in enumerate(new)
            for d in _directions(samples, name)
        ]
        covariance = np.insert(np.insert(known.covariance, [P] * len(added), 0.0, 0), [P] * len(added), 0.0, 1)
        known = Uncertainty((*known.parameters, *added), covariance)
    return replace(calibration, nominal=nominal, calibrated=models[1], geometric=models[2], uncertainty=known)


def placed_anew(samples: Samples, new: tuple[str, ...]) -> tuple[CellChange, ...]:
    """What is given of these frames: each stands elsewhere than at its first guess."""
    return tuple(
        CellChange(FRAME, name, towards(0, _directions(samples, name), samples.frames.index(name))) for name in new
    )


def _directions(samples: Samples, name: str) -> range:
    """A socket shows one point, which has no orientation."""
    return range(3) if samples.is_same_point(samples.frames.index(name)) else range(6)


def _added(model: Model, poses: Array, new: tuple[str, ...]) -> Model:
    """The model with these frames behind its own."""
    leaders = (*model.leaders, *range(len(model.frames), len(model.frames) + len(new))) if model.leaders else ()
    return replace(
        model, frames=(*model.frames, *new), T_frame_base=np.concatenate([model.T_frame_base, poses]), leaders=leaders
    )


@dataclass(frozen=True)
class BeyondRanges:
    """outside: how many of the stations stand beyond the ranges, of how many. corrected: RMS [m] at the tool by which
    the calibration differs from the nominal arm at these stations.
    """

    outside: int
    of: int
    corrected: float

    @property
    def mostly(self) -> bool:
        """Whether most of them do."""
        return self.outside > _MAX * self.of

    @property
    def untried_mm(self) -> float:
        """RMS [mm] that the model may lack where most stations stand beyond the ranges; else 0."""
        return 1e3 * self.corrected if self.mostly else 0.0


def beyond_ranges(calibration: Calibration, model: Model, samples: Samples) -> BeyondRanges:
    """How many of these stations stand where the calibration was not made. model: the frozen one, for these samples."""
    low, high = calibration.seen
    margin = _MARGIN * (high - low)
    first = np.unique(samples.station, return_index=True)[1]
    q = samples.q[first]
    out = ((q < low - margin) | (q > high + margin)).any(axis=1)
    nominal = calibration.nominal.predict(q, samples.frame[first])[:, :3, 3]
    moved = model.predict_samples(samples.select(first))[:, :3, 3] - nominal
    return BeyondRanges(int(out.sum()), len(first), float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))))


def tried_stations(calibration: Calibration) -> Array:
    """Ten of the postures (k, n) that the calibration was made from."""
    return np.asarray(calibration.postures[spread_rows(len(calibration.postures), _ASKED)])


def spread_out(samples: Samples, most: int) -> Samples:
    """The samples at no more than so many stations, one of each stretch of the recording; all, where there are fewer.

    Distances between postures are those of their joint positions [rad, m].
    """
    stations, first = np.unique(samples.station, return_index=True)
    if len(stations) <= most:
        return samples
    q = samples.q[first]
    nearest = np.linalg.norm(q - q.mean(axis=0), axis=1)
    taken = []
    for k, stretch in enumerate(np.array_split(np.arange(len(stations)), most)):
        at = int(stretch[np.argmax(nearest[stretch])])
        taken.append(at)
        away = np.linalg.norm(q - q[at], axis=1)
        nearest = away if k == 0 else np.minimum(nearest, away)
    return samples.select(np.flatnonzero(np.isin(samples.station, stations[taken])))
