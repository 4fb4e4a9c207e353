"""How well a motion whose path bends in its own frame explains what was seen, in the space and by the rules of all.

The path of a parametric model may bend in the frame that it moves along, so the direction t along it [unit vector]
differs from node to node, and so does the turn ω [rad] per metre of path. The latent place on the path, flat in metres,
is integrated out by what no place on the path can change: of each node's residuals e, φ and two directions U across t,

    x = Uᵀe,   y = φ − ω tᵀe

With covariances P and Q of positions and rotations between nodes, as for all motions, those of x and y are

    x_i x_j: P_ij U_iᵀU_j,   x_i y_j: −P_ij (U_iᵀt_j) ω_jᵀ,   y_i y_j: Q_ij I + P_ij (t_iᵀt_j) ω_i ω_jᵀ

Where t is the same everywhere, that is what ``terms`` has. A node beyond an end of the path pays for
how far it is beyond.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from modcal_core.articulation.models.parametric_motion import ParametricMotion
from modcal_core.articulation.motion import Motion
from modcal_core.articulation.scene import HELD, SWAYS, NodeScene, whitener
from modcal_core.articulation.terms import Terms, about_mean
from modcal_core.geometry.so3 import Array

_AT_END = 1e-9  # of the range of configurations


@dataclass(frozen=True)
class VaryingTerms(Terms):
    """position (2 k, 1 + size), rotation (3 k, 1 + size): x and y of all nodes, and derivatives by the parameters.

    beyond: (k, 1 + size) how far nodes lie beyond an end [m], zero for those that do not. U (k, 2, 3), t (k, 3),
    w (k, 3): directions across and along the path, and the turn per metre. turn: the rotations
    by node, None without.
    """

    position: Array
    rotation: Array
    beyond: Array
    U: Array
    t: Array
    w: Array
    turn: Array | None

    @classmethod
    def of(cls, scene: NodeScene, motion: Motion, play: float) -> Self:
        """Terms of all nodes. The play enters the linear system only."""
        assert isinstance(motion, ParametricMotion)
        track = scene.track
        a = motion.configurations(track, (1.0, 1e9))
        both, by_a = motion.expanded(track, a)
        speed = np.maximum(np.linalg.norm(by_a[:, :3], axis=1, keepdims=True), 1e-12)
        t, w = by_a[:, :3] / speed, by_a[:, 3:] / speed
        U = np.linalg.svd(t[:, None])[2][:, 1:]
        along = t[:, None] @ both[:, :3]
        model = motion.model
        inside = np.minimum(a - model.lower, model.upper - a) > _AT_END * (model.upper - model.lower)
        beyond = np.where(inside[:, None], 0.0, along[:, 0])
        width = both.shape[2]
        position = (U @ both[:, :3]).reshape(-1, width)
        turn = both[:, 3:] - w[:, :, None] * along if track.oriented else None
        rotation = np.empty((0, width)) if turn is None else turn.reshape(-1, width)
        return cls(motion, track.oriented, position, rotation, beyond, U, t, w, turn)

    def system(self, scene: NodeScene, play: float, column: int) -> tuple[float, Array, Array, float]:
        """(squares, gradient, curvature, log determinant), with the prior in the first three."""
        P = play**2 * scene.kernel + scene.position
        k = len(P)
        xx = np.einsum("ij,iac,jbc->iajb", P, self.U, self.U).reshape(2 * k, 2 * k)
        seen, S = self.position, xx
        held = self.turn is not None and bool(HELD[column])
        if self.turn is not None and not held:
            Q = float(SWAYS[column]) ** 2 * scene.kernel + scene.rotation
            xy = -np.einsum("ij,iac,jc,jb->iajb", P, self.U, self.t, self.w).reshape(2 * k, 3 * k)
            yy = np.einsum("ij,ia,jb->iajb", P * (self.t @ self.t.T), self.w, self.w).reshape(3 * k, 3 * k)
            S = np.block([[xx, xy], [xy.T, yy + np.kron(Q, np.eye(3))]])
            seen = np.concatenate([self.position, self.rotation])
        W, log_det = whitener(S)
        white = W @ seen
        over = self.beyond / np.sqrt(P.diagonal())[:, None]
        total = white.T @ white + over.T @ over
        if held:
            W, half = scene.by_sway(float(SWAYS[column]))
            squares, weight = about_mean(W, scene.turned)
            j = 1 + self.motion.start_turn
            total[0, 0] += squares
            total[[j, j + 1, j + 2], [j, j + 1, j + 2]] += weight
            log_det += 3 * half
        return self.with_prior(total, log_det)
