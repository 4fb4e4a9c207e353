"""Stations that do not agree with the others, asked by themselves: another link, mixed joints, another order.

:mod:`consistency` explains them with the base and the tool of the others. What follows another link, or has other joint
columns, has a base and a tool of its own, so that it is looked at alone.
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration import consecutive
from modcal_core.measurements import Samples
from modcal_core.plausibility.agreement import Disagreement, limits
from modcal_core.plausibility.consensus import placed_by_most
from modcal_core.plausibility.joint_map import mixed_joints
from modcal_core.plausibility.links import other_link
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Mechanism, forward, is_serial_arm

_MIN, _MAX = 48, 400  # stations; two parts of 24, which links are told by
_MIN_SHARE = 0.2  # of the stations that must agree, lest chance finds that many
_CLEARLY = 2.0  # times what a nominal arm misses by


def part_apart(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """What looks wrong with the stations that do not agree with the others, by themselves; None where nothing is found.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = most_seen(samples, chain, _MIN, _MAX)
    if part is None or not is_serial_arm(chain):
        return None
    try:
        placed, agree = placed_by_most(part, chain)
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None
    if placed is None or agree.mean() < _MIN_SHARE:
        return None
    angle, distance = limits(chain)
    turned, missed = placed.residual(forward(chain, part.q), part)
    apart = (turned > _CLEARLY * angle) | (missed > _CLEARLY * distance)
    rest = part.select(np.flatnonzero(apart))
    found = other_link(rest, chain) or mixed_joints(rest, chain)
    if found is None:
        return None
    runs = consecutive(apart)
    number = part.station
    where = f"{int(apart.sum())} of {len(apart)} stations, here and there"
    if len(runs) <= 3:
        where = "stations " + " and ".join(f"{number[a]} to {number[b - 1]}" for a, b in runs)
    return Disagreement(f"at {where}, and not at the others, {found.what}", found.remedy, int(apart.sum()), len(apart))
