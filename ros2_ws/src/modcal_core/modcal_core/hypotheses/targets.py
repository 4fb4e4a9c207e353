"""Points of one target on the tool, or of several that a column tells apart, fitted so that single rows do not rule."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array, so3
from modcal_core.hypotheses.hand_eye import ASTRAY, INDEPENDENT, ErrorScale, HandEye, placed
from modcal_core.hypotheses.meanings import Match
from modcal_core.robots import Chain

_ROUNDS = 8  # iterations
_ODDS = float(np.log(20.0))  # by which a reading that may say anything must be the likelier one


def points_match(
    chain: Chain, q: Array, position: Array, log_volume: float = 0.0, group: np.ndarray | None = None
) -> Match:
    """How well points (N, 3) [m] fit the nominal arm. group (N,): which target each is of; None: of one.

    log_volume: of what a unit shrank a reading by.
    """
    N, targets = len(q), 1 if group is None else len(np.unique(group))
    gaps = points_left(chain, q, position, group)
    total = float(_scale(chain, q, position).rows(np.zeros_like(gaps), gaps).sum()) + N * log_volume
    score = total * min(1.0, INDEPENDENT / N) - (3.0 + 1.5 * targets) * float(np.log(N))
    return Match(score, float(np.median(np.linalg.norm(gaps, axis=1))), 0.0)


def points_left(chain: Chain, q: Array, position: Array, group: np.ndarray | None = None) -> Array:
    """What base and tool leave of points (N, 3) [m]; every target of a group has a place of its own."""
    case = HandEye.of_arrays(chain, q, position)
    fit = placed(case)
    if group is None:
        return fit.placement.left(case)[1]
    of = np.unique(group, return_inverse=True)[1]
    Y, t, A = fit.placement.Y, fit.placement.t, case.A
    x = np.tile(fit.placement.x, (int(of.max()) + 1, 1))
    for _ in range(_ROUNDS):
        point = (A[:, :3, :3] @ x[of][..., None])[..., 0] + A[:, :3, 3]
        gaps = position - (point @ Y.T + t)
        G = np.zeros((len(q), 3, 6 + x.size))
        G[:, :, :3] = -Y @ so3.hat(point)
        G[:, :, 3:6] = np.eye(3)
        for k in range(len(x)):
            G[of == k, :, 6 + 3 * k : 9 + 3 * k] = Y @ A[of == k, :3, :3]
        square = np.sum(gaps**2, axis=1)
        weight = 1.0 / (max(float(np.median(square)) / 2.366, case.scale.position**2) + square)  # Cauchy
        H = np.einsum("n,nij,nik->jk", weight, G, G)
        unit = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        g = np.einsum("n,nij,ni->j", weight, G, gaps)
        step = unit * np.linalg.solve(H * np.outer(unit, unit) + 1e-9 * np.eye(len(H)), unit * g)
        step = step / max(float(np.linalg.norm(step[:3])), 1.0)
        Y, t, x = Y @ so3.exp(step[:3]), t + step[3:6], x + step[6:].reshape(-1, 3)
        if np.linalg.norm(step[:3]) < 1e-6:
            break
    return np.asarray(position - ((A[:, :3, :3] @ x[of][..., None])[..., 0] + A[:, :3, 3]) @ Y.T - t)


def is_astray(chain: Chain, position: Array, gaps: Array) -> np.ndarray:
    """Rows (N,) whose residuals (N, 3) are twenty times as likely of a reading that may say anything."""
    scale, square = _scale(chain, np.zeros((len(gaps), chain.n)), position), np.sum(gaps**2, axis=1)
    sigma = max(scale.position, float(np.sqrt(np.median(square) / 2.366)))
    inside = np.log1p(-ASTRAY) - 1.5 * np.log(2.0 * np.pi * sigma**2) - 0.5 * square / sigma**2
    return np.asarray(np.log(ASTRAY) - scale.volume - inside > _ODDS)


def _scale(chain: Chain, q: Array, position: Array) -> ErrorScale:
    return HandEye.of_arrays(chain, q, position).scale
