"""One direction of time for a track and for its reverse, where what is done would depend on it.

A door that closes is the door that opened. Where a whole track is looked at, samples that are pooled, drawn or counted
one after the other are taken in the same order either way.
"""

from __future__ import annotations

import numpy as np

from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array


def backwards(positions: Array) -> bool:
    """Whether positions (n, 3) are to be taken from the last to the first: they end nearer to their middle than begin.

    The reverse of a track gives the opposite, a moved or mirrored one the same. A track that is its own mirror image
    has no direction, and none matters to it.
    """
    away = ((positions - positions.mean(axis=0)) ** 2).sum(axis=1)
    late = np.arange(len(away)) - 0.5 * (len(away) - 1)
    return float(late @ away) < 0.0


def one_way(track: Track) -> Track:
    """The track, or its reverse: of both the same. Stamps are left out."""
    p, R = track.positions, track.rotations
    if not backwards(p):
        return Track.trusted(p, R)
    return Track.trusted(p[::-1], None if R is None else R[::-1])
