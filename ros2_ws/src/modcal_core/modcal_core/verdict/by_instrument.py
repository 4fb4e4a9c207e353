"""What differs from instrument to instrument: features for the same regressor (see ``features``).

One arm that is seen by two instruments has one geometry and one tool. Where parameters seem to be others in one of the
frames, or its readings longer or oblique, an instrument, its place or its target is at fault, which no function of the
posture tells: half of the stations pull one way, the others the other.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.calibration import Model, RowView
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.verdict.features import Group

_MIN = 12  # readings of a frame: fewer do not tell the nine numbers of a scale and a shear from their noise
_MAX = 6  # frames; many are placements of a plate, each seen a few times


def by_instrument(model: Model, samples: Samples, weight: Array, by_parameters: Array) -> Iterator[Group]:
    """A group for each frame against the others, one for two; none where there is one instrument.

    weight: of the samples' six components, (6, N). by_parameters: derivatives by the parameters, in units of the noise,
    (K, 6, N).
    """
    count = np.bincount(samples.frame, minlength=len(samples.frames))
    seen = np.flatnonzero(count >= _MIN).tolist()
    if not 2 <= len(seen) <= _MAX or samples.sockets:
        return
    reading = RowView.of(model, samples, model.drivers(samples)).expected.copy()
    for f in range(len(samples.frames)):
        rows = samples.frame == f
        reading[:, rows] -= reading[:, rows].mean(axis=1, keepdims=True) if rows.any() else 0.0
    scales = np.zeros((3, 3, 6, len(samples)))
    for i in range(3):
        scales[:, i, i] = reading / max(float(reading.std()), 1e-12)
    scales = scales.reshape(9, 6, -1) * weight
    names = [samples.frames[f] for f in seen]
    for f in seen if len(seen) > 2 else seen[:1]:
        side = np.where(samples.frame == f, 1.0, -1.0)
        these = f"frame '{samples.frames[f]}' do" if len(seen) > 2 else f"frames '{names[0]}' and '{names[1]}' do"
        others = " with the others" if len(seen) > 2 else ""
        columns = side * np.concatenate([by_parameters, scales])
        size = np.sqrt(np.einsum("dcn,dcn->d", columns, columns))
        yield Group(
            f"which instrument reads it: those in {these} not agree{others} in scale, shape or target",
            columns[size > 1e-9 * size.max(initial=1e-300)],
        )
