"""Stated distances that cannot be, where all else is in order: which of them, and whether two stand for each other.

The lengths of a nominal arm tell the distances between sockets to some millimetres without any of them being stated. So
where the arm fits its readings alone, and not beside the distances, these are compared one by one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration import AnyDistance, Distance, Fit
from modcal_core.geometry import se3
from modcal_core.hypotheses.hypothesis import Disagreement

_OFF = 0.003  # of the reach; by which distances of a nominal arm may differ from true ones
_ALIKE = 0.5  # of what a distance is off by, that another's statement must be nearer to it


def wrong_distances(alone: Fit, distances: Sequence[AnyDistance]) -> Disagreement | None:
    """The stated distances that a fit without them contradicts, None where there is none.

    alone: of base and tool to the readings alone.
    """
    model = alone.model
    known = [d for d in distances if isinstance(d, Distance) and set(d.between) <= set(model.frames)]
    if not known:
        return None
    origin = se3.inverse(model.T_frame_base @ model.chain.T_base_root)[:, :3, 3]
    at = {name: origin[f] for f, name in enumerate(model.frames)}
    found = np.array([float(np.linalg.norm(at[d.between[0]] - at[d.between[1]])) for d in known])
    stated = np.array([d.distance for d in known])
    off = np.abs(found - stated)
    wrong = np.flatnonzero(off > _OFF * model.chain.reach())
    if not len(wrong):
        return None
    each = [
        f"{_name(known[k])} is stated as {1e3 * stated[k]:.4g} mm and the readings say {1e3 * found[k]:.4g} mm"
        for k in wrong
    ]
    swapped = [
        (a, b)
        for i, a in enumerate(wrong)
        for b in wrong[i + 1 :]
        if abs(stated[a] - found[b]) < _ALIKE * off[b] and abs(stated[b] - found[a]) < _ALIKE * off[a]
    ]
    more = "".join(f"; those of {_name(known[a])} and {_name(known[b])} look exchanged" for a, b in swapped)
    return Disagreement(
        f"known distances look wrong: {', '.join(each)}{more}",
        "correct the distances in the cell file, or the names of the sockets",
        len(wrong),
        len(known),
    )


def _name(known: Distance) -> str:
    return f"the distance between {known.between[0]} and {known.between[1]}"
