"""Where base and tool are, before anything is known of them: closed forms that need no starting guess.

For poses this is the robot-world / hand-eye problem ``T_frame_base FK(q) T_tip_tool = reading``. The rotations obey a
linear system whose null vector is found by SVD (Kronecker form, Shah 2013) and projected to rotations; the positions
then follow linearly. Points give up the orientation of the tool; tool point and base are improved in turn from several
starts, each step in closed form. Poses that hardly turn make the first way fail, and points that hardly move the
second, so poses are located both ways and the better one is kept. Fixed points are linear in all that is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modcal_core.calibration.instruments import new_instruments
from modcal_core.calibration.locate_instruments import (
    MAX_ROWS,
    Known,
    find_tool,
    leaders,
    place_instruments,
    require_placeable,
    require_readings,
)
from modcal_core.calibration.model import Model
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.rows import indirect_rows
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows
from modcal_core.robots.mechanism import forward

_DEAR = 1e-3  # how much smaller the tool is preferred to be, where base and tool can stand for each other
_GOOD = 0.005  # median miss, as a share of the arm's reach, that needs no further start


def locate(model: Model, samples: Samples, known: Sequence[Known] = (), own_target: Sequence[str] = ()) -> Model:
    """The model with base frames, tool and instruments placed so that the readings are roughly met.

    known: frames whose place relative to others is known. own_target: frames whose instrument watches a point of the
    tool of its own. Raises NotEnoughData where a frame has fewer than 3 readings, or an instrument fewer than it needs.
    """
    instruments = new_instruments(samples, own_target)
    led = leaders(model.frames, known)
    require_placeable(known, samples)
    if not instruments:
        return _known_relative(_locate(model, samples), known, led)
    require_readings(instruments, samples)
    indirect = indirect_rows(samples)
    shown = np.unique(samples.frame[~indirect]).tolist()
    located = model
    if shown:
        located = _locate(model, samples.select(np.flatnonzero(~indirect)), shown)
    T_base_tip = forward(model.chain, samples.q)
    tool = located.T_tip_tool
    if not shown:
        tool = find_tool(instruments, samples, T_base_tip, located.T_frame_base, known)
    placed, poses = place_instruments(instruments, samples, T_base_tip @ tool, located.T_frame_base, shown, known)
    located = replace(located, T_tip_tool=tool, T_frame_base=poses, instruments=placed)
    return _known_relative(located, known, led)


def _known_relative(model: Model, known: Sequence[Known], led: tuple[int, ...]) -> Model:
    """The model with the frames whose place is known put there."""
    if not known:
        return model
    poses = np.array(model.T_frame_base)
    for _ in known:  # what is known relative to something known
        for k in known:
            if k.frame in model.frames:
                poses[model.frames.index(k.frame)] = k.T_frame_base(model.frames, poses)
    return replace(model, T_frame_base=poses, leaders=led)


def _locate(model: Model, samples: Samples, shown: Sequence[int] | None = None) -> Model:
    """The model with tool and base frames, or those of them that are shown, placed from positions."""
    order = list(range(len(model.frames))) if shown is None else list(shown)
    T_base_tip = forward(model.chain, samples.q)
    for f in order:
        _require_readings(model.frames[f], int((samples.frame == f).sum()))
    order = sorted(order, key=lambda f: -_knowledge(samples, f))
    T_frame_base = np.array(model.T_frame_base)
    tool: Array | None = None
    if all(samples.is_same_point(f) for f in order):
        tool, T_frame_base = _fixed_points(samples, T_base_tip, order, T_frame_base)
        order = []
    for f in order:
        rows = np.flatnonzero(samples.frame == f)
        rows = rows[spread_rows(len(rows), MAX_ROWS)]
        A = T_base_tip[rows]
        if samples.is_pose[rows].all():
            base, found = _pose_tool(A, se3.transform(samples.R[rows], samples.reading[rows]))
            tool = found if tool is None else tool
        elif tool is None or samples.is_same_point(f):
            base, point = _point_tool(A, samples.reading[rows])
            tool = se3.transform(p=point) if tool is None else tool
        else:
            base = procrustes((A @ tool)[:, :3, 3], samples.reading[rows])
        T_frame_base[f] = base
    assert tool is not None
    return replace(model, T_frame_base=T_frame_base, T_tip_tool=tool)


def locate_base(model: Model, samples: Samples, known: Sequence[Known] = (), own_target: Sequence[str] = ()) -> Model:
    """The model, its tool kept, with the base frames and instruments placed so that the readings are roughly met."""
    T_frame_base = np.array(model.T_frame_base)
    instruments = new_instruments(samples, own_target, model.instruments)
    require_placeable(known, samples)
    require_readings(instruments, samples)
    indirect = indirect_rows(samples)
    shown = np.unique(samples.frame[~indirect]).tolist()
    for f in shown:
        rows = np.flatnonzero((samples.frame == f) & ~indirect)
        _require_readings(model.frames[f], len(rows))
        T = forward(model.chain, samples.q[rows]) @ model.T_tip_tool
        if samples.is_same_point(f):
            T_frame_base[f] = se3.transform(p=samples.reading[rows[0]] - T[:, :3, 3].mean(axis=0))
        elif samples.is_pose[rows].all():
            R = so3.mean(samples.R[rows] @ np.swapaxes(T[:, :3, :3], 1, 2))
            T_frame_base[f] = se3.transform(R, (samples.reading[rows] - T[:, :3, 3] @ R.T).mean(axis=0))
        else:
            T_frame_base[f] = procrustes(T[:, :3, 3], samples.reading[rows])
    T = forward(model.chain, samples.q) @ model.T_tip_tool
    placed, T_frame_base = place_instruments(instruments, samples, T, T_frame_base, shown, known)
    located = replace(model, T_frame_base=T_frame_base, instruments=placed)
    return _known_relative(located, known, leaders(model.frames, known))


def _require_readings(frame: str, count: int) -> None:
    if count < 3:
        raise NotEnoughData(
            f"frame '{frame}'", f"{count} readings, at least 3 are needed", "record more stations in it"
        )


def _knowledge(samples: Samples, frame: int) -> int:
    """How much a frame says of the tool: poses before points, then the number of readings."""
    rows = samples.frame == frame
    return int(rows.sum()) * (1000 if samples.is_pose[rows].all() else 1)


def _pose_tool(A: Array, B: Array) -> tuple[Array, Array]:
    """(Y, X) with ``B ≈ Y A X`` for poses A, B (N, 4, 4): by rotations first or by positions first, the better one."""
    base, point = _point_tool(A, B[:, :3, 3])
    R = so3.mean(np.swapaxes(base[:3, :3] @ A[:, :3, :3], 1, 2) @ B[:, :3, :3])
    reach = float(np.linalg.norm(A[:, :3, 3], axis=1).mean())

    def miss(solution: tuple[Array, Array]) -> float:
        gap = se3.log(se3.inverse(solution[0] @ A @ solution[1]) @ B)
        return float(np.median(np.linalg.norm(gap * np.array([1.0] * 3 + [reach] * 3), axis=1)))

    return min(hand_eye(A, B), (base, se3.transform(R, point)), key=miss)


def hand_eye(A: Array, B: Array) -> tuple[Array, Array]:
    """(Y, X) with ``B ≈ Y A X`` for poses A, B (N, 4, 4)."""
    Ra, Rb = A[:, :3, :3], B[:, :3, :3]
    # R_b Z = Y R_a with Z = R_xᵀ: rows of (R_b ⊗ I) z − (I ⊗ R_aᵀ) y, row-major
    K = np.einsum("nji,nlk->ikjl", Rb, Ra).reshape(9, 9)  # sum of b.T ⊗ a.T; z = Kᵀ-aligned with y
    U, _, Vt = np.linalg.svd(K)
    z, y = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3)
    sign = np.sign(np.linalg.det(y))
    Ry, Rx = so3.nearest_rotation(sign * y), so3.nearest_rotation(sign * z).T
    # positions: p_b = Y p_a + Y R_a x + t
    G = np.concatenate([Ry @ Ra, np.broadcast_to(np.eye(3), Ra.shape)], axis=2).reshape(-1, 6)
    h = (B[:, :3, 3] - A[:, :3, 3] @ Ry.T).reshape(-1)
    x, t = np.split(np.linalg.lstsq(G, h, rcond=1e-9)[0], 2)
    return se3.transform(Ry, t), se3.transform(Rx, x)


def procrustes(a: Array, b: Array) -> Array:
    """The transforms T (..., 4, 4) with ``b ≈ T a`` for points a, b (..., N, 3) (Kabsch)."""
    ca, cb = a.mean(axis=-2, keepdims=True), b.mean(axis=-2, keepdims=True)
    R = so3.nearest_rotation(np.swapaxes(b - cb, -1, -2) @ (a - ca))
    return se3.transform(R, cb[..., 0, :] - (R @ ca[..., 0, :, None])[..., 0])


def _point_tool(A: Array, y: Array) -> tuple[Array, Array]:
    """(Y, x) with ``y ≈ Y (A x)`` for tip poses A and points y (N, 3): tool point and base in turn, several starts."""
    reach = np.linalg.norm(A[:, :3, 3], axis=1).mean()
    starts = np.concatenate([np.zeros((1, 3)), 0.25 * reach * np.r_[np.eye(3), -np.eye(3)]])
    best: tuple[float, Array, Array] | None = None
    for x in starts:
        for _ in range(60):
            Y = procrustes(se3.apply(A, x), y)
            # the tool counts as dear: what could as well be the base's place, where no turn tells, goes there
            G = np.concatenate(
                [_DEAR * Y[:3, :3] @ A[:, :3, :3], np.broadcast_to(np.eye(3), A[:, :3, :3].shape)], axis=2
            )
            h = (y - A[:, :3, 3] @ Y[:3, :3].T).reshape(-1)
            new = _DEAR * np.linalg.lstsq(G.reshape(-1, 6), h, rcond=1e-9)[0][:3]
            step, x = np.linalg.norm(new - x), new
            if step < 1e-6:
                break
        Y = procrustes(se3.apply(A, x), y)
        gap = y - se3.apply(Y, se3.apply(A, x))
        cost = float(np.median(np.linalg.norm(gap, axis=1)))
        if best is None or cost < best[0] - 1e-9:
            best = (cost, Y, x)
        if cost < _GOOD * reach:
            break
    assert best is not None
    return best[1], best[2]


def _fixed_points(
    samples: Samples, T_base_tip: Array, order: Sequence[int], T_frame_base: Array
) -> tuple[Array, Array]:
    """Tool and frames where every frame shows one fixed point: linear in the tool point and the points' positions."""
    F, N = len(order), len(samples)
    G = np.zeros((N, 3, 3 + 3 * F))
    G[:, :, :3] = T_base_tip[:, :3, :3]
    for i, f in enumerate(order):
        G[samples.frame == f, :, 3 + 3 * i : 6 + 3 * i] = -np.eye(3)
    x = np.linalg.lstsq(G.reshape(-1, 3 + 3 * F), -T_base_tip[:, :3, 3].reshape(-1), rcond=1e-9)[0]
    T_frame_base = T_frame_base.copy()
    for i, f in enumerate(order):
        reading = samples.reading[np.flatnonzero(samples.frame == f)[0]]
        T_frame_base[f, :3, 3] = reading - x[3 + 3 * i : 6 + 3 * i]
    return se3.transform(p=x[:3]), T_frame_base
