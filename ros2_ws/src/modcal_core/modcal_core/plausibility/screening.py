"""Very many mistakes of joints at once, in closed form: which of them are worth a fit.

With base and tool in closed form (:mod:`closed_form`) a mistake costs a few small products, so that all subsets of
reversed joints and all threes of interchanged ones can be looked at.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.closed_form import base_and_tool_turns, base_by_positions, tool_and_place
from modcal_core.measurements.samples import Samples
from modcal_core.plausibility.mistakes import Mistake
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import forward

_FEW = 60  # stations, evenly along the recording
_AT_ONCE = 64  # mistakes in a block, for memory


def most_likely(samples: Samples, chain: Chain, mistakes: Sequence[Mistake], count: int) -> list[Mistake]:
    """So many of these mistakes of joints, by the median distance that a nominal arm misses by with them undone."""
    samples = samples.select(np.unique(np.linspace(0, len(samples) - 1, min(len(samples), _FEW)).astype(int)))
    missed: list[float] = []
    for first in range(0, len(mistakes), _AT_ONCE):
        some = mistakes[first : first + _AT_ONCE]
        q = np.concatenate([mistake.undone(samples).q for mistake in some])
        A = forward(chain, q).reshape(len(some), len(samples), 4, 4)
        position = np.broadcast_to(samples.reading, (len(some), len(samples), 3))
        if samples.is_pose.all():
            base, _ = base_and_tool_turns(A[..., :3, :3], np.broadcast_to(samples.R, A[..., :3, :3].shape))
        else:
            base = base_by_positions(A, position)
        gap, _, _ = tool_and_place(base, A, position)
        missed += np.median(np.linalg.norm(gap, axis=-1), axis=-1).tolist()
    return [mistakes[i] for i in np.argsort(missed, kind="stable")[:count]]
