"""Which stations of a long recording a check looks at: spread over its time and over its postures.

A long recording is mostly a grid, and most stations of a grid have others close by that say the same. So of each
stretch of the recording the station is taken whose posture is farthest from those taken before.
"""

from __future__ import annotations

import numpy as np

from modcal_core.measurements import Samples


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
