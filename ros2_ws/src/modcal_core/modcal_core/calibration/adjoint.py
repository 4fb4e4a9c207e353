"""Calibration in which every joint stays a joint: twists moved by adjoints (Gao et al. 2014).

The true twist of joint i is ``Ad(exp η_i) ξ_i``: a unit screw of no pitch that was moved as a whole, so no later step
has to bring it back to one. With P_i = exp(ξ_1 q_1) … exp(ξ_{i-1} q_{i-1}) a small η_i moves the tool by the twist

    Ad(P_i) η_i − Ad(P_i exp(ξ_i q_i)) η_i,        seen from the base,

for it is put in before the joint and taken out again behind it. What is along the joint's own motion commutes with it
and drops out: a shift along and a turn about the axis of a joint that turns; all shifts, and that turn, of one that
slides. η_i is therefore written in the joint's own frame and only what remains is solved for, 4 numbers or 2. Six of
the tool at zero (3 where points are read, 6 where poses are) complete the model: 4 r + 2 p + 6, the least there can be,
with nothing left to a generalised inverse. A wrong base frame is part of it: it moves all twists alike, and the tool.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.fit import require_enough
from modcal_core.calibration.model import Model
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples

_MAX = 20  # iterations
_SETTLED = 1e-6  # relative change of the RMS error that ends it


@dataclass(frozen=True)
class AdjointFit:
    """What was found.

    model: calibrated; its base frame is the one it started from. eta: η_1 … η_n, (n, 6) [m, rad], in the base of the
    start. history: RMS of the weighted residuals before each step and after the last [m]. rank, condition: of the last
    system, columns scaled to unit length. parameters: how many were solved for.
    """

    model: Model
    eta: Array
    history: tuple[float, ...]
    parameters: int
    rank: int
    condition: float

    @property
    def iterations(self) -> int:
        """Steps taken until a further one changed nothing."""
        return len(self.history) - 1


def identify_twists(start: Model, samples: Samples, metres_per_radian: float = 1.0) -> AdjointFit:
    """The fit of all twists and of the tool at zero to readings of one frame, by Gauss and Newton.

    start: base and tool roughly placed. metres_per_radian: what an orientation residual counts against a distance.
    Raises NotEnoughData when the readings are too few.
    """
    chain = start.chain
    n = chain.n
    # joint frames at zero with z as the axis, and the tool, in the frame of the readings
    G = start.T_frame_base[0] @ _homes(start)
    first = G.copy()
    pose = bool(samples.is_pose.all())
    kept = [np.array([0, 1, 3, 4] if turns else [3, 4]) for turns in chain.revolute]
    tool = np.arange(6 if pose else 3)
    count = sum(map(len, kept)) + len(tool)
    require_enough(samples, count)
    ends = np.cumsum([len(k) for k in kept])
    history: list[float] = []
    rank, condition = 0, np.inf
    for _ in range(_MAX):
        before, behind, T = _frames(G, samples.q, chain.revolute)
        r = _residual(T, samples, pose, metres_per_radian)
        history.append(float(np.sqrt(np.mean(r**2))))
        if len(history) > 1 and history[-1] >= history[-2] * (1.0 - _SETTLED):
            break
        columns = [
            _moved(se3.adjoint(before[i]) - se3.adjoint(behind[i]), T, pose, metres_per_radian)[:, kept[i]]
            for i in range(n)
        ]
        columns.append(_moved(se3.adjoint(T), T, pose, metres_per_radian)[:, tool])
        J = np.concatenate(columns, axis=1)
        scale = np.linalg.norm(J, axis=0)
        step, _, rank, values = np.linalg.lstsq(J / scale, r, rcond=1e-12)
        condition = float(values[0] / max(values[-1], 1e-300))
        parts = np.split(step / scale, ends)
        for i in range(n + 1):
            xi = np.zeros(6)
            xi[kept[i] if i < n else tool] = parts[i]
            G[i] = G[i] @ se3.exp(xi)
    eta = se3.log(G[:n] @ se3.inverse(first[:n]))
    to_base = se3.adjoint(se3.inverse(start.T_frame_base[0]))
    return AdjointFit(
        _with_homes(start, G), (to_base @ eta[..., None])[..., 0], tuple(history), count, int(rank), condition
    )


def _homes(model: Model) -> Array:
    """Joint frames at zero, z along the axes, then the tool, in the base, (n + 1, 4, 4)."""
    T, out = np.eye(4), []
    for M in model.serial.along_z:
        T = T @ M
        out.append(T)
    return np.stack([*out[:-1], out[-1] @ model.T_tip_tool])


def _with_homes(start: Model, G: Array) -> Model:
    """The model whose joint frames and tool at zero are these, seen from the readings' frame."""
    n = start.chain.n
    basis = se3.transform(start.chain.joint_basis)
    plain = np.concatenate([G[:n] @ se3.inverse(basis), (G[n] @ se3.inverse(start.T_tip_tool))[None]])
    ends = np.concatenate([start.T_frame_base[:1], plain])
    return start.with_chain(start.serial.with_origins(se3.inverse(ends[:-1]) @ ends[1:]))


def _frames(G: Array, q: Array, revolute: np.ndarray) -> tuple[list[Array], list[Array], Array]:
    """Joint frames before and behind their motions, n times (N, 4, 4), and the tool, (N, 4, 4)."""
    before, behind = [], []
    P = np.tile(np.eye(4), (len(q), 1, 1))
    for i in range(len(G) - 1):
        xi = np.zeros((len(q), 6))
        xi[:, 5 if revolute[i] else 2] = q[:, i]
        before.append(P @ G[i])
        behind.append(before[i] @ se3.exp(xi))
        P = behind[i] @ se3.inverse(G[i])
    return before, behind, P @ G[-1]


def _residual(T: Array, samples: Samples, pose: bool, length: float) -> Array:
    gap = samples.reading - T[:, :3, 3]
    if not pose:
        return gap.ravel()
    turn = so3.log(samples.R @ np.swapaxes(T[:, :3, :3], 1, 2))
    return np.concatenate([gap.ravel(), length * turn.ravel()])


def _moved(twists: Array, T: Array, pose: bool, length: float) -> Array:
    """What the tool does, (3 N or 6 N, m), per unit of base-frame twists (N, 6, m)."""
    v = twists[:, :3] + np.cross(twists[:, 3:], T[:, :3, 3, None], axis=1)
    shift = v.reshape(-1, twists.shape[2])
    return np.concatenate([shift, length * twists[:, 3:].reshape(shift.shape)]) if pose else shift
