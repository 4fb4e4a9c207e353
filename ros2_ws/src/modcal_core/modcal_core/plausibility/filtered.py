"""Readings that a filter mixed with those of the rows before or after: a mean of several, or one that settles slowly.

A filtered position is the same mean of Y (A x) + t over the rows, which is linear in the poses A: with the poses
averaged as the filter does, base and tool are found in closed form as ever.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from modcal_core.calibration import base_by_positions, tool_and_place
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.plausibility.agreement import Disagreement, limits
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Mechanism, forward, is_serial_arm

_MIN, _MAX = 24, 400  # stations
_BEFORE, _AFTER = 8, 3  # rows that a filter reaches
_SETTLING = (0.2, 0.35, 0.5, 0.65, 0.8)  # shares that a filter keeps of the reading before
_BETTER = 4.0  # times what is missed by as it is


def filtered_readings(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """What a filter made of the readings of a frame with which a nominal arm misses no more than by its own errors.

    samples: all of them; in a frame of several, that with most readings is looked at. None where no filter is likely.
    """
    part = most_seen(samples, chain, _MIN, _MAX)
    if part is None or not is_serial_arm(chain):
        return None
    said, kernels = zip(*_kernels(), strict=True)
    A = np.moveaxis(sliding_window_view(forward(chain, part.q), len(kernels[0]), axis=0), -1, 1)  # (N, rows, 4, 4)
    poses = np.einsum("ck,nkij->cnij", np.array(kernels), A)
    position = np.broadcast_to(part.reading[_BEFORE : len(part) - _AFTER], (*poses.shape[:2], 3))
    try:
        gap, _, _ = tool_and_place(base_by_positions(poses, position), poses, position)
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None
    missed = np.median(np.linalg.norm(gap, axis=-1), axis=-1)
    best = int(np.argmin(missed))
    if missed[best] > limits(chain)[1] or _BETTER * missed[best] > missed[0]:
        return None
    return Disagreement(
        f"readings look filtered: each as {said[best]}",
        "turn the instrument's filter or averaging off, or wait at each station until it has settled, and record again",
        len(part),
        len(part),
    )


def _kernels() -> list[tuple[str, Array]]:
    """Each filter with its description and its weights of neighbouring rows; the first is no filter."""
    rows = np.arange(-_BEFORE, _AFTER + 1)
    made = [("", (rows == 0).astype(float))]
    for half in range(1, _AFTER + 1):
        made.append((f"the mean of {2 * half + 1} rows about its own", (np.abs(rows) <= half).astype(float)))
    for count in range(2, 6):
        made.append(
            (f"the mean of its own row and the {count - 1} before", ((rows <= 0) & (rows > -count)).astype(float))
        )
    for kept in _SETTLING:
        said = f"if {100 * kept:.0f}% of the reading before were still in it"
        made.append((said, np.where(rows <= 0, kept ** np.maximum(-rows, 0.0), 0.0)))
    return [(said, weights / weights.sum()) for said, weights in made]
