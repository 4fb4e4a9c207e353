"""Whether what a joint leaves vanishes by a smooth bend of its path: a mechanism that is near a joint, and no joint.

Play, a hand that settles and a camera's bias are rough: of what real doors and drawers leave beside noise, a smooth
bend along the path takes some, and about a tenth of the squares stays at least. What a linkage, a cam or a curved rail
leaves of the nearest line, circle or screw is smooth, and a bend takes all of it.
"""

from __future__ import annotations

import numpy as np

from modcal_core.articulation.furniture import PLAY
from modcal_core.articulation.telling import white
from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array

_DEGREE = 5  # of the bend, a polynomial along the path: two waves, longer than what is alike within a hand's width
_PARAMETERS = 6  # of a circle in space
# m: what the joint must leave beside noise for a bend to be considered, half the usual play, as for two motions
WORTH = 0.5 * float(np.exp(PLAY[0]))
_SURELY = 4.0  # deviations by which what is left must be more than noise
VANISHES = 0.04  # of its squares may stay: less than half of what the smoothest of 47 real tracks keeps
CAP = 0.03  # m: samples farther off are outliers


def bend_explains(track: Track, left: Array, along: Array) -> str:
    """Why a smooth bend is to be considered, as text; empty where it is not.

    left (n, 3): what the joint leaves of positions [m]. along (n,): configurations of the samples.
    """
    near = np.linalg.norm(left, axis=1) < CAP
    e, a = left[near], along[near]
    n, coefficients = len(e), 2 * (_DEGREE + 1)  # of the two directions across the path
    if 2 * n <= 2 * (_PARAMETERS + coefficients) or not float(np.ptp(a)) > 0.0:
        return ""
    waves = np.polynomial.legendre.legvander(2.0 * (a - a.min()) / float(np.ptp(a)) - 1.0, _DEGREE)
    rest = e - waves @ np.linalg.lstsq(waves, e, rcond=None)[0]
    noise = white(track.positions) ** 2
    one = float((e * e).sum()) / (2 * n - _PARAMETERS) - noise
    two = float((rest * rest).sum()) / (2 * n - _PARAMETERS - coefficients) - noise
    worth = WORTH**2 / 2.0
    if one <= max(worth, _SURELY * noise / np.sqrt(n)) or two > VANISHES * one:
        return ""
    return (
        f"a smooth bend leaves {1e3 * np.sqrt(2.0 * max(two, 0.0)):.1f} mm beside noise where it leaves "
        f"{1e3 * np.sqrt(2.0 * one):.1f} mm"
    )
