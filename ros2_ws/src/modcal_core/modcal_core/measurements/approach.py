"""Which way each joint last went: backlash and friction depend on it, long after the joint has stopped."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from modcal_core.geometry import Array

TRAVEL = 5e-4  # rad or m; a joint that is this far from where it was has come from there


@dataclass
class Approach:
    """Remembers which way each joint of an arm last went. Fed with every posture, in order of time."""

    direction: Array = field(default_factory=lambda: np.empty(0))
    _anchor: Array = field(default_factory=lambda: np.empty(0))

    def update(self, q: Array) -> Array:
        """The directions (n,), −1, 0 (unknown) or 1, now that the joints are at q (n,)."""
        if self._anchor.shape != q.shape:
            self._anchor, self.direction = q.copy(), np.zeros(len(q))
        way = q - self._anchor
        moved = np.abs(way) > TRAVEL
        self.direction = np.where(moved, np.sign(way), self.direction)
        # while a joint goes on the same way its anchor goes with it, so that turning back is noticed at once
        onward = moved | (way * self.direction > 0.0)
        self._anchor = np.where(onward, q, self._anchor)
        return self.direction


# --- Postures that were left and come back to from another side: what shows how well an arm repeats

MIN_RETURNS = 6  # to as many distinct postures; a spread of 18 degrees of freedom is known to about a sixth
SAME = 1e-3  # rad or m; controllers come back to some 1e-4, and a model corrects for what is left
LEFT = 2e-2  # rad or m; what a joint must move in between, far beyond backlash and settling
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)  # golden ratio: no two of its multiples are near each other, modulo 1


def returns(q: Array, approach: Array | None = None) -> list[np.ndarray]:
    """For each posture that was come back to the rows of its visits, in order of time.

    q: postures in order of time (N, n) [rad, m]; neighbours that are alike are one visit. approach: the direction each
    joint last moved in, −1, 0 or 1, (N, n). Where it is unknown, it is taken from where the arm stood before: arms go
    from one station to the next. A visit counts when a joint was more than LEFT away since the one before it, and when
    at least one joint arrives the other way than at the first one that counts.
    """
    if len(q) < 3:
        return []
    stood = np.r_[False, np.abs(np.diff(q, axis=0)).max(axis=1) <= SAME]
    first = np.flatnonzero(~stood)
    visited = q[first]
    side = _sides(np.zeros_like(visited) if approach is None else approach[first], visited)
    out = []
    for visits in _alike(visited):
        known = [v for v in visits if side[v].any()]
        used = known[:1]
        for visit in known[1:]:
            away = np.abs(visited[used[-1] : visit] - visited[visit]).max() > LEFT
            if away and (side[visit] * side[used[0]] < 0).any():
                used.append(visit)
        if len(used) > 1:
            out.append(first[used])
    return out


def posture_numbers(q: Array) -> np.ndarray:
    """For each row of q (N, n) the row where its posture stood first, (N,)."""
    out = np.arange(len(q))
    for rows in _alike(q):
        out[rows] = rows[0]
    return out


def _alike(q: Array) -> list[list[int]]:
    """Rows of q (N, n) of the same posture, for each that stands there more than once, in order."""
    # On a line in no special direction postures that are alike are neighbours, and hardly any others; the first joints
    # tell nearly all of these apart
    along = 0.5 + 0.5 * (_GOLDEN * np.arange(1, q.shape[1] + 1) % 1.0)
    x = q @ along
    order = np.argsort(x, kind="stable")
    x, joints = x[order], np.ascontiguousarray(q[order].T)
    limit = SAME * float(np.sum(along))
    pairs = []
    for ahead in range(1, len(q)):
        close = np.flatnonzero(x[ahead:] - x[:-ahead] <= limit)
        if not len(close):
            break
        for joint in joints:
            close = close[np.abs(joint[close] - joint[close + ahead]) <= SAME]
        if len(close):
            pairs.append(np.sort(np.stack([order[close], order[close + ahead]], axis=1), axis=1))
    groups: dict[int, list[int]] = {}
    leader: dict[int, int] = {}
    for a, b in sorted(map(tuple, np.concatenate(pairs).tolist() if pairs else [])):
        head = leader.get(a, a)
        if b not in leader and (head == a or np.abs(q[head] - q[b]).max() <= SAME):
            leader[b] = head
            groups.setdefault(head, [head]).append(b)
    return [sorted(rows) for rows in groups.values()]


def _sides(approach: Array, q: Array) -> Array:
    """Which way each joint arrives, −1, 0 or 1, (N, n): as recorded, else as it comes from the visit before."""
    step = np.diff(q, axis=0, prepend=q[:1])
    come = np.where(np.abs(step) > TRAVEL, np.sign(step), 0.0)
    known = (approach != 0.0).any(axis=1)
    return np.asarray(np.where(known[:, None], approach, come))
