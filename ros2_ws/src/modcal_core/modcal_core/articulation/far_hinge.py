"""Whether an arc proves a hinge that is far away, and whether a line excludes one that is as near as most.

Hinges lie 10 cm to 1.6 m from the handle. Within that, what bends evenly is probably a hinge. Beyond it, hinges are as
rare as mechanisms that draw other curves: a pantograph's parabola, a sagging rail. Then the arc has to be long enough
that a curve whose bend changes along the way by as much as it is, from half to one and a half times its mean, would
have been noticed. Of its nearest arc such a curve leaves κ L² (2/5) / (48 √7), RMS, where κ is the mean bend and L the
length: the part of s³ κ / (6 L) that no shift, turn or radius takes, a Legendre polynomial of the third degree.

What is certainly a line has to leave less of it than the arc of a usual hinge, 40 cm away, would: κ L² / (12 √5), RMS.
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.articulation.furniture import DISTORTION, PLAY, RADIUS
from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.motion import Motion
from modcal_core.geometry.so3 import Array

FARTHEST = math.exp(RADIUS[0] + 2.0 * RADIUS[1])  # m, 1.6: of 95 % of hinges
_LEAVES = 0.4 / (48.0 * math.sqrt(7.0))  # of κ L², the RMS that an arc leaves of a bend that changes by its mean
_OF_LINE = 1.0 / (12.0 * math.sqrt(5.0))  # of κ L², the RMS that a line leaves of an arc
_USUAL = math.hypot(math.exp(PLAY[0]), DISTORTION[0])  # m: what handles and cameras leave


def unproved(motion: Motion, a: Array) -> str:
    """Why a hinge so far away is to be doubted, as text; empty where it is not. a (n,): configurations."""
    if not (isinstance(motion, AxisMotion) and motion.turns) or motion.r <= FARTHEST:
        return ""
    turned = _span(a)
    if turned * turned * motion.r * _LEAVES > _USUAL:  # κ L² = angle² r
        return ""
    return (
        f"hinges are seldom farther away than {FARTHEST:.1f} m, and {math.degrees(turned):.0f}° tell one from no other "
        "curve"
    )


def hidden(motion: Motion, a: Array, left: float) -> str:
    """Why a line is to be doubted, as text: it leaves so much [m] that a hinge would not be seen. a (n,): [m]."""
    bow = _OF_LINE * _span(a) ** 2 / math.exp(RADIUS[0])
    if motion.turns or not motion.flat or left <= bow:
        return ""
    return f"it leaves {1e3 * left:.0f} mm, where the arc of a hinge at 40 cm is {1e3 * bow:.0f} mm from a line"


def _span(a: Array) -> float:
    low, high = np.quantile(a, [0.01, 0.99])
    return float(high - low)
