"""Whether the order of the stations goes with the posture: what changes in time may then change with the posture."""

from __future__ import annotations

import numpy as np

from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows

_NEAREST = 3  # stations that are asked
_RIGHT = 0.95  # share of the stations that their neighbours in posture put on the right side of a moment
_MAX = 500  # stations that are asked; spread over the recording


def explained_by_posture(samples: Samples, at: float) -> tuple[str, ...]:
    """Joints whose position alone tells whether a station comes before a moment [s] or after it.

    Each station is put on the side on which the stations lie that are nearest to it in that joint. Where the order has
    nothing to do with the joint, that is right for half of them.
    """
    rows = spread_rows(len(samples), _MAX)
    after = samples.stamps[rows] >= at
    if min(after.sum(), (~after).sum()) <= _NEAREST:
        return ()
    return tuple(name for j, name in enumerate(samples.names) if _told(samples.q[rows, j], after) >= _RIGHT)


def joints_instead(samples: Samples, at: float) -> tuple[str, ...]:
    """Names, as in ``same_as``, of the joints' errors that may be what seems to have happened at a moment [s]."""
    return tuple(f"{name} axis by position:{name}" for name in explained_by_posture(samples, at))


def _told(q: np.ndarray, after: np.ndarray) -> float:
    """Share of the stations that the nearest others in q (n,) put on the right side, both sides weighing the same."""
    gap = np.abs(q[:, None] - q[None])
    np.fill_diagonal(gap, np.inf)
    near = np.argsort(gap, axis=1, kind="stable")[:, :_NEAREST]
    right = (after[near].mean(axis=1) > 0.5) == after
    return float(0.5 * (right[after].mean() + right[~after].mean()))
