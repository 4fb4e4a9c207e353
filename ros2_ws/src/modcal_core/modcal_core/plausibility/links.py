"""Readings that follow another link than the tip: a target on the elbow, a tracker that the arm carries.

Between any two frames along the chain, that of one link seen from another, base and target are found in closed form.
The tip seen from the base is what is expected; where the readings follow another pair as a nominal arm does, the target
or what it is seen from is mounted there, or the topic is that of another target.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place, turns_left
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.plausibility.agreement import Disagreement, limits
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Chain, Mechanism, frames, is_serial_arm

_MIN = 24  # stations; nine numbers of base and tool, and pairs enough to hit by chance with fewer
_MAX = 100  # the same at most
_MOVES = 4.0  # times what a nominal arm misses by, that readings must move by to follow anything


def other_link(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """The link that the readings follow instead of the tip, None where they follow the tip, or none.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = most_seen(samples, chain, _MIN, 10 * _MAX)
    if part is None or not is_serial_arm(chain) or chain.n < 2:
        return None
    part = part.select(spread_rows(len(part), _MAX))
    angle, distance = limits(chain)
    spread = np.linalg.norm(part.reading - np.median(part.reading, axis=0), axis=1)
    if float(np.median(spread)) < _MOVES * distance:
        return None
    pairs, A = _between(chain, part.q)
    try:
        turned, missed = _missed(A, part)
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None
    good = (missed < distance) & (turned < angle)
    whole = [pairs.index((0, chain.n, inverse)) for inverse in (False, True)]
    if good[whole].any() or not good.any():
        return None
    # of those that fit, the one with fewest joints: what is between others of them stood still
    first, last, inverse = min((pairs[k] for k in np.flatnonzero(good)), key=lambda p: (p[1] - p[0], p[2]))
    what, remedy = _sentence(chain, first, last, inverse)
    return Disagreement(what, remedy, len(part), len(part))


def _between(chain: Chain, q: Array) -> tuple[list[tuple[int, int, bool]], Array]:
    """Pairs of links, counted by the joints before them, whether inverted, and the poses of each (P, N, 4, 4)."""
    f = frames(chain, q)
    # the frame before joint k + 1 ends the link behind joint k, and does not turn with joint k + 1
    T = [f.transform(k) for k in range(chain.n + 1)]
    pairs, A = [], []
    for first, last in combinations(range(chain.n + 1), 2):
        T_first_last = se3.inverse(T[first]) @ T[last]
        pairs += [(first, last, False), (first, last, True)]
        A += [T_first_last, se3.inverse(T_first_last)]
    return pairs, np.stack(A)


def _missed(A: Array, samples: Samples) -> tuple[Array, Array]:
    """Median angle [rad] and distance [m] that each pair's poses (P, N, 4, 4) miss by, (P,)."""
    a = A[..., :3, :3]
    position = np.broadcast_to(samples.reading, (*A.shape[:2], 3))
    by_position = base_by_positions(A, position)
    gap = np.median(np.linalg.norm(tool_and_place(by_position, A, position)[0], axis=-1), axis=-1)
    if not samples.is_pose.all():
        return np.zeros(len(A)), gap
    R = np.broadcast_to(samples.R, a.shape)
    # few joints do not tell base and tool by turns alone, and places do
    X = so3.nearest_rotation(np.sum(np.swapaxes(by_position[:, None] @ a, -1, -2) @ R, axis=1))
    turned = _typical(turns_left(by_position, a, X, R))
    Y, X = base_and_tool_turns(a, R)
    other = _typical(turns_left(Y, a, X, R))
    other_gap = _typical(tool_and_place(Y, A, position)[0])
    better = np.where(np.maximum(other, other_gap) < np.maximum(turned, gap), True, False)
    return np.where(better, other, turned), np.where(better, other_gap, gap)


def _typical(vectors: Array) -> Array:
    return np.asarray(np.median(np.linalg.norm(vectors, axis=-1), axis=-1))


def _sentence(chain: Chain, first: int, last: int, inverse: bool) -> tuple[str, str]:
    """Refusal of readings that follow link ``last`` as seen from link ``first``."""
    n, names, links = chain.n, chain.names, chain.links
    before = f"{links[first]}, " if first and len(links) == n else ""
    behind = f"{links[last]}, " if last < n and len(links) == n else ""
    target = f"the link before {names[last]} ({behind}behind {names[last - 1]})" if last < n else "the tool"
    seen = f"the link behind {names[first - 1]} ({before}before {names[first]})" if first else "the base"
    still = [*names[:first], *names[last:]]
    *most, final = still
    moved = f"{', '.join(most)}{' and ' if most else ''}{final} do{'' if most else 'es'} not move them"
    if inverse:
        what = f"readings look like the pose of {seen} seen from {target}"
    elif first == 0:
        what = f"readings follow {target}, and not the tool: the target is mounted there, or the topic is another's"
    elif last == n:
        what = f"readings follow the tool as seen from {seen}: the tracker or its reference is mounted there"
    else:
        what = f"readings follow {target} as seen from {seen}"
    return (
        f"{what}; {moved}",
        "record the topic of the target on the tool in a frame that stands, or give --tip and --base as the links that "
        "carry target and tracker",
    )
