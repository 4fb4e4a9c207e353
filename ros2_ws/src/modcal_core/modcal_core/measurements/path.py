"""What a joint's path leaves behind: followers with play, which are pulled along only where they lag by their width.

A sum of such followers of different widths is any hysteresis that goes by the path and not by its speed (Prandtl 1928,
Ishlinskii 1944). What each is behind by is all that must be known to go on from a moment. Where a path begins nobody
knows it: two followers of each width, at either end of their play, are one once the path has taken both along.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array

# rad or m, half the slack: 0.6° to 115°, so close that sums of them are smooth
WIDTHS: Array = np.asarray(0.01 * 1.7 ** np.arange(11), dtype=np.float64)
TRAVEL = 5e-4  # rad or m; a joint that is farther from where it was has come from there
PLAY = (1.0 + 1e-6) * TRAVEL  # of a follower that tells it, a little more, so that to be just as far is not enough
UNKNOWN = np.stack([-WIDTHS, WIDTHS])  # of a joint of whose path nothing is known


def directions(step: Array) -> Array:
    """Which way joints go by a step (..., n) from one place to another, −1, 0 (unknown) or 1."""
    return np.where(np.abs(step) > TRAVEL, np.sign(step), 0.0)


def ahead(path: Array, widths: Array, rows: np.ndarray) -> Array:
    """How far numbers are ahead of followers with play at the least and at the most, (N, n, 2, widths).

    path: numbers in order (T, n). rows: of the path, (N,).
    """
    # what a stretch does to a follower is to keep it between two ends: stretches are walked along side by side
    T, n = path.shape
    length = int(np.ceil(np.sqrt(T)))
    stretch = np.pad(path, ((0, -T % length), (0, 0)), mode="edge").reshape(-1, length, n, 1)
    low = np.full((len(stretch), n, len(widths)), -np.inf)
    high = -low
    ends = np.empty((2, len(rows), n, len(widths)))
    which, within = np.divmod(rows, length)
    for k in range(length):
        least, most = stretch[:, k] - widths, stretch[:, k] + widths
        for end in (low, high):
            np.minimum(np.maximum(end, least, out=end), most, out=end)
        here = within == k
        ends[:, here] = low[which[here]], high[which[here]]
    begin = np.empty((len(stretch), n, 2, len(widths)))
    now = path[0][:, None, None] + np.stack([widths, -widths])
    for k in range(len(stretch)):
        begin[k] = now
        now = np.clip(now, low[k, :, None], high[k, :, None])
    return np.asarray(path[rows][..., None, None] - np.clip(begin[which], *ends[:, :, :, None]))


def went_on(behind: Array, way: Array, widths: Array = WIDTHS) -> Array:
    """The same, (..., n, 2, widths), once the joints have gone straight on by a way (..., n)."""
    return np.clip(behind + way[..., None, None], -widths, widths)


def at_samples(stamps: Array, at: Array, t: Array, q: Array, widths: Array = WIDTHS) -> Array:
    """What samples at postures ``at`` (N, n) are ahead of the followers of joint states q (T, n), (N, n, 2, widths)."""
    rows = np.maximum(np.searchsorted(t, stamps + 1e-9) - 1, 0)
    return went_on(ahead(q, widths, rows), at - q[rows], widths)


def came_by(behind: Array) -> Array:
    """Which way each joint last went, −1, 0 (unknown) or 1, (..., n), by followers whose play is PLAY, (..., n, 2).

    A joint is ahead of such a follower until it has gone back by more than that.
    """
    least, most = np.sign(behind[..., 0]), np.sign(behind[..., 1])
    return np.asarray(np.where(least == most, most, 0.0))
