"""Joints under each other's names in any order, and joints that slide where they turn, or the reverse.

All orders of the columns are compared without knowing base and tool (:mod:`joint_columns`); the likeliest, and each
joint with its type changed, are then placed in closed form and must explain the readings as a nominal arm does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place, turns_left
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.plausibility.agreement import Disagreement, limits
from modcal_core.plausibility.joint_columns import MIN_ROWS, likely_orders
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

_MAX = 100  # stations; more say the same
_LIKELY = 6  # orders that are placed
_BETTER = 4.0  # times what is missed by as it is


def other_order(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """The order of the joints' columns that the readings ask for, and one of them that is reversed beside it; None
    where those as written do as well as any.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = _some(samples, chain)
    if part is None or not is_serial_arm(chain):
        return None
    n = chain.n
    most_angle, most = limits(chain)
    found: list[tuple[float, tuple[int, ...], int | None]] = []
    try:
        before = _missed(chain, part.q, part)[1]
        for reversed_ in (None, *range(n)):
            q = part.q.copy()
            if reversed_ is not None:
                q[:, reversed_] *= -1.0
            for order in likely_orders(chain, np.c_[q, part.reading], 1.0, range(n), [(n, n + 1, n + 2)], _LIKELY):
                angle, distance = _missed(chain, q[:, list(order.columns)], part)
                if angle < most_angle and distance < most and _BETTER * distance < before:
                    found.append((distance, order.columns, reversed_))
            if found:  # with fewer mistakes it is likelier
                break
    except np.linalg.LinAlgError:
        return None
    if not found:
        return None
    _, columns, reversed_ = min(found, key=lambda f: f[0])
    moved = [k for k in range(n) if columns[k] != k]
    if not moved:  # one that is reversed alone is named elsewhere
        return None
    names = part.names or chain.names
    each = ", ".join(f"{names[k]} under the name {names[columns[k]]}" for k in moved)
    shift = next((s for s in range(1, n) if columns == tuple((k + s) % n for k in range(n))), 0)
    how = ""
    if shift:
        by = min(shift, n - shift)
        how = f", all by {by} place{'s' if by > 1 else ''} (a list counted from another number)"
    if reversed_ is not None:
        each += f"; and {names[columns.index(reversed_)]} looks reversed"
    return Disagreement(
        f"joints stand in another order than they are named, as if permuted{how}: {each}",
        "correct the order of the names in joint_states" + (", and the sign" if reversed_ is not None else ""),
        len(part),
        len(part),
    )


def other_type(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """The joint that turns where the URDF lets it slide, or the reverse; None where none explains the readings.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = _some(samples, chain)
    if part is None or not is_serial_arm(chain):
        return None
    found: list[tuple[float, int]] = []
    try:
        before = _missed(chain, part.q, part)[1]
        for j, other in _types(chain):
            angle, distance = _missed(other, part.q, part)
            most_angle, most = limits(other)
            if angle < most_angle and distance < min(most, limits(chain)[1]) and _BETTER * distance < before:
                found.append((distance, j))
    except np.linalg.LinAlgError:
        return None
    if not found:
        return None
    j = min(found)[1]
    name = chain.names[j]
    written, real = ("revolute", "slide") if chain.revolute[j] else ("prismatic", "turn")
    return Disagreement(
        f"joint {name} is {written} in the URDF, and the readings show it {real}",
        f'check <joint type="..."> of {name}',
        len(part),
        len(part),
    )


def _types(chain: Chain) -> Iterator[tuple[int, Chain]]:
    for j in range(chain.n):
        revolute = chain.revolute.copy()
        revolute[j] = not revolute[j]
        lower, upper = chain.lower.copy(), chain.upper.copy()
        lower[j], upper[j] = -np.pi, np.pi
        yield j, replace(chain, revolute=revolute, lower=lower, upper=upper)


def _some(samples: Samples, chain: Mechanism) -> Samples | None:
    part = most_seen(samples, chain, MIN_ROWS, 10 * _MAX)
    if part is None:
        return None
    return part.select(spread_rows(len(part), _MAX))


def _missed(chain: Chain, q: Array, samples: Samples) -> tuple[float, float]:
    """Median angle [rad] and distance [m] that a nominal arm misses by at these postures."""
    A = forward(chain, q)
    if not samples.is_pose.all():
        Y = base_by_positions(A[None], samples.reading[None])[0]
        return 0.0, float(np.median(np.linalg.norm(tool_and_place(Y, A, samples.reading)[0], axis=1)))
    Y, X = base_and_tool_turns(A[:, :3, :3], samples.R)
    turned = np.linalg.norm(turns_left(Y, A[:, :3, :3], X, samples.R), axis=1)
    gap = np.linalg.norm(tool_and_place(Y, A, samples.reading)[0], axis=1)
    return float(np.median(turned)), float(np.median(gap))
