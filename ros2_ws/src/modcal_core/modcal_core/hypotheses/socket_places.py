"""Sockets whose rows do not return to one place, where those of the others do: a plate that was moved, rows mixed up.

With postures A_i = (R_i, p_i) of the tip and the ball at x in the tip, R_i x + p_i = c is linear in x and the place c.
Where it fits each socket's rows alone as a nominal arm does, the socket stood; the tool that those agree on says
where the ball was in the others.
"""

from __future__ import annotations

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, se3
from modcal_core.hypotheses.conventions import joints, several_joints
from modcal_core.hypotheses.hand_eye import HandEye, limits
from modcal_core.hypotheses.hypothesis import Disagreement
from modcal_core.measurements import Samples
from modcal_core.robots import Mechanism, forward, is_serial_arm

_MIN = 6  # rows of a socket: three times what its place and the ball's ask for
_CLEARLY, _APART = 2.0, 4.0  # times what a nominal arm misses by, and what sockets that stood scatter by: elsewhere
_MIN_SHARE = 0.1  # of a socket's rows that lead elsewhere; fewer are wrong readings, and left out


def require_one_place(samples: Samples, chain: Mechanism) -> None:
    """Raises BadRecording where rows of a socket lead to several places, and those of another to one."""
    if not is_serial_arm(chain) or not samples.sockets:
        return
    limit = limits(chain)[1]
    of_each = {
        name: forward(chain, samples.q[samples.frame == f])
        for f, name in enumerate(samples.frames)
        if name in samples.sockets and (samples.frame == f).sum() >= _MIN
    }
    stood = [A for A in of_each.values() if _fits([A], limit)]
    if not stood or not _fits(stood, limit):
        return
    x = _ball(stood)
    clearly = max(_CLEARLY * limit, _APART * max(_spread(se3.apply(A, x)) for A in stood))
    points = {name: se3.apply(A, x) for name, A in of_each.items()}
    apart = {name: np.linalg.norm(p[:, None] - p[None], axis=-1) > clearly for name, p in points.items()}
    moved = {name: points[name] for name, far in apart.items() if far.mean(axis=1).min() > _MIN_SHARE}
    if not moved:
        return
    said = []
    for name, p in moved.items():
        k, by = _broken(p)
        whole = max(_spread(p[:k]), _spread(p[k:])) <= limit
        said.append(f"{name} is {1e3 * by:.0f} mm away from row {k + 1} on" if whole else f"{name} is in several")
    raise BadRecording(
        f"socket {', '.join(moved)}",
        f"the rows lead to more than one place ({', '.join(said)}), and those of each other socket to one",
        "see whether the plate was moved, or rows of another socket stand under this name, and give each place its own",
    )


def misread_joints(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """The mistake of joints with which undone each socket's rows lead to one place as a nominal arm's do, and did not.

    What keeps the arm where it stands returns to any socket, so that what is missed counts by how far the arm moved.
    """
    rows = np.isin(samples.frame, [f for f, name in enumerate(samples.frames) if name in samples.sockets])
    if not is_serial_arm(chain) or rows.sum() < _MIN:
        return None
    part, limit = samples.select(np.flatnonzero(rows)), limits(chain)[1]

    def missed(case: HandEye) -> float:
        sockets = [case.A[part.frame == f] for f in np.unique(part.frame)]
        x = _ball(sockets)
        return max(_spread(se3.apply(A, x)) for A in sockets) / max(_spread(case.A[:, :3, 3]), 1e-9)

    case = HandEye.holding(part, chain)
    table = [*joints(case.names), *several_joints(case.names)]
    as_is, left = missed(case), [missed(h.undone(case)) for h in table]
    best = int(np.argmin(left))
    if left[best] * _spread(case.A[:, :3, 3]) > limit or _APART * left[best] > as_is:
        return None
    return Disagreement(table[best].what, table[best].remedy, len(part), len(part))


def _ball(of_each: list[Array]) -> Array:
    """The ball in the tip (3,) [m] that the rows of some sockets agree on, by least squares."""
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    for A in of_each:  # the place is the mean, so that rows count about it
        R, p = (v - v.mean(axis=0) for v in (A[:, :3, :3], A[:, :3, 3]))
        normal += np.einsum("nki,nkj->ij", R, R)
        right -= np.einsum("nki,nk->i", R, p)
    return np.asarray(np.linalg.lstsq(normal, right, rcond=1e-9)[0])


def _fits(of_each: list[Array], limit: float) -> bool:
    """Whether the rows of every one of some sockets return to one place, RMS within the limit [m]."""
    x = _ball(of_each)
    return all(_spread(se3.apply(A, x)) <= limit for A in of_each)


def _spread(points: Array) -> float:
    return float(np.sqrt(points.var(axis=0).sum()))


def _broken(points: Array) -> tuple[int, float]:
    """The row from which on points (N, 3) are most likely elsewhere, and by how much [m]."""
    cuts = range(1, len(points))
    k = 1 + int(np.argmin([k * _spread(points[:k]) ** 2 + (len(points) - k) * _spread(points[k:]) ** 2 for k in cuts]))
    return k, float(np.linalg.norm(points[k:].mean(axis=0) - points[:k].mean(axis=0)))
