"""Very many mistakes of joints at once, in closed form: which of them are worth a fit.

With base and tool in closed form (:mod:`modcal_core.calibration.initial`) a mistake costs a few small products, so that
all subsets of reversed joints and all threes of interchanged ones can be looked at.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place, turns_left
from modcal_core.measurements import Samples, spread_rows
from modcal_core.plausibility.agreement import Disagreement, limits
from modcal_core.plausibility.mistakes import Mistake, of_joints, of_several_joints
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

_FEW = 60  # stations, evenly along the recording
_MIN = 24  # stations; nine numbers of base and tool, and mistakes enough to hit by chance with fewer
_BETTER = 4.0  # times what is missed by as it is
_AT_ONCE = 64  # mistakes in a block, for memory


def wrong_joints(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """The mistake of one or several joints with which undone a nominal arm misses by no more than its own errors."""
    if not is_serial_arm(chain) or len(samples.frames) != 1 or len(samples) < _MIN or samples.moving.any():
        return None
    if not (samples.is_pose | (samples.kind == "point")).all() or samples.sockets:
        return None
    as_it_is = Mistake("", "", lambda s: s, "joints")
    mistakes = [as_it_is, *of_joints(samples.names), *of_several_joints(samples.names)]
    missed = _missed(samples, chain, mistakes)
    best = int(np.argmin(missed))
    angle, distance = limits(chain)
    if missed[best] > distance or _BETTER * missed[best] > missed[0]:
        return None
    if samples.is_pose.all():
        a = forward(chain, mistakes[best].undone(samples).q)[:, :3, :3]
        Y, X = base_and_tool_turns(a, samples.R)
        if np.median(np.linalg.norm(turns_left(Y, a, X, samples.R), axis=1)) > angle:
            return None
    return Disagreement(mistakes[best].offender, mistakes[best].remedy, len(samples), len(samples))


def most_likely(samples: Samples, chain: Chain, mistakes: Sequence[Mistake], count: int) -> list[Mistake]:
    """So many of these mistakes of joints, by the median distance that a nominal arm misses by with them undone."""
    return [mistakes[i] for i in np.argsort(_missed(samples, chain, mistakes), kind="stable")[:count]]


def _missed(samples: Samples, chain: Chain, mistakes: Sequence[Mistake]) -> list[float]:
    """Median distances [m] that a nominal arm misses by with each mistake of joints undone."""
    samples = samples.select(spread_rows(len(samples), _FEW))
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
    return missed
