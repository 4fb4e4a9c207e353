"""Readings of several parts, one after the other, each with a base or a tool of its own.

A tracker that is set to zero after every break, or a target that is remounted, leaves no part in which most of the
stations agree. In order of time, the longest stretches that agree on one base and one tool are found one by one: a
window is placed in closed form and grows as long as stations agree with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place
from modcal_core.geometry import so3
from modcal_core.measurements import Samples
from modcal_core.plausibility.agreement import Disagreement, Placed, limits
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

_MIN, _MAX = 30, 400  # stations
_WINDOW_POSES, _WINDOW_POINTS = 6, 10  # stations that base and tool are found from
_CLEARLY = 2.0  # times what a nominal arm misses by
_LOST = 3  # stations in a row that do not agree, at which a stretch ends
_MAX_PARTS = 12  # stretches; a recording of more breaks tells nothing by them
_EXPLAINED = 0.8  # share of the stations that stretches of at least a window must hold
_SAME = 3.0  # times what a nominal arm misses by, up to which a base or a tool of two parts is the same


def several_placements(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """Where base or tool moved between stretches of a recording, each of which agrees in itself; None if it does not.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = most_seen(samples, chain, _MIN, _MAX)
    if part is None or not is_serial_arm(chain):
        return None
    try:
        stretches = _stretches(part, chain)
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None
    held = sum(b - a for a, b, _ in stretches)
    if not 2 <= len(stretches) <= _MAX_PARTS or held < _EXPLAINED * len(part):
        return None
    A = forward(chain, part.q)
    one_tool = _common(part, A, stretches, chain, tool=True)
    one_base = _common(part, A, stretches, chain, tool=False)
    if one_tool:
        who, do = "the base (or the tracker's zero)", "keep the tracker's zero"
    elif one_base:
        who, do = "the tool (or the target on it)", "keep the target where it is"
    else:
        who, do = "the base (or the tracker's zero), or the tool,", "keep tracker and target as they are"
    number = part.station
    where = ", ".join(f"{number[a]} to {number[b - 1]}" for a, b, _ in stretches)
    return Disagreement(
        f"{who} changed {len(stretches) - 1} times: stations {where} agree in themselves and not with each other",
        f"{do} over the whole recording, or give each part its own frame or recording",
        held,
        len(part),
    )


def _stretches(samples: Samples, chain: Chain) -> list[tuple[int, int, Placed]]:
    """Stretches (first, end) of stations in order of time that agree on base and tool, and these."""
    A, N = forward(chain, samples.q), len(samples)
    window = _WINDOW_POSES if samples.is_pose.all() else _WINDOW_POINTS
    angle, distance = limits(chain)
    out: list[tuple[int, int, Placed]] = []
    first = 0
    while first + window <= N:
        rows = np.arange(first, first + window)
        placed = _placed(A[rows], samples.select(rows))
        turned, missed = placed.residual(A[rows], samples.select(rows))
        good = (turned < _CLEARLY * angle) & (missed < _CLEARLY * distance)
        if not good.all():
            first += 1
            continue
        end = first + window
        while True:  # a base from more stations holds for more
            rest = samples.select(np.arange(end, N))
            turned, missed = placed.residual(A[end:], rest)
            agree = (turned < _CLEARLY * angle) & (missed < _CLEARLY * distance)
            lost = np.convolve(~agree, np.ones(_LOST), "valid") == _LOST if len(agree) >= _LOST else np.zeros(0, bool)
            stop = end + (int(np.argmax(lost)) if lost.any() else len(agree))
            while stop > end and not agree[stop - end - 1]:
                stop -= 1
            if stop <= end:
                break
            rows = np.arange(first, stop)[np.r_[np.ones(end - first, bool), agree[: stop - end]]]
            placed, end = _placed(A[rows], samples.select(rows)), stop
        out.append((first, end, placed))
        first = end
    return out


def _common(samples: Samples, A: np.ndarray, parts: list[tuple[int, int, Placed]], chain: Chain, tool: bool) -> bool:
    """Whether all parts agree with the tool (or the base) of the longest one, and a base (or a tool) of their own."""
    angle, distance = limits(chain)
    best = max(parts, key=lambda part: part[1] - part[0])[2]
    for first, end, own in parts:
        rows = np.arange(first, end)
        some, a_here = samples.select(rows), A[rows]
        if tool:
            point = a_here[:, :3, :3] @ best.x + a_here[:, :3, 3]
            Y = own.Y
            if samples.is_pose.all():
                Y = so3.nearest_rotation(np.sum(some.R @ np.swapaxes(a_here[:, :3, :3] @ best.X, 1, 2), axis=0))
            placed = replace(best, Y=Y, t=np.median(some.reading - point @ Y.T, axis=0))
        else:
            back = np.swapaxes(best.Y @ a_here[:, :3, :3], 1, 2)
            X = so3.nearest_rotation(np.sum(back @ some.R, axis=0)) if samples.is_pose.all() else own.X
            at = some.reading - best.t - a_here[:, :3, 3] @ best.Y.T
            placed = replace(best, X=X, x=np.median((back @ at[..., None])[..., 0], axis=0))
        turned, missed = placed.residual(a_here, some)
        if np.median(turned) > _SAME * angle or np.median(missed) > _SAME * distance:
            return False
    return True


def _placed(A: np.ndarray, samples: Samples) -> Placed:
    if samples.is_pose.all():
        Y, X = base_and_tool_turns(A[:, :3, :3], samples.R)
    else:
        Y, X = base_by_positions(A[None], samples.reading[None])[0], np.eye(3)
    _, x, t = tool_and_place(Y, A, samples.reading)
    return Placed(Y, X, x, t)
