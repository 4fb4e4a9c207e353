"""Where base and tool are, before anything is known of them: closed forms that need no starting guess.

For poses this is the robot-world / hand-eye problem ``T_frame_base FK(q) T_tip_tool = reading``. The rotations obey a
linear system whose null vector is found by SVD (Kronecker form, Shah 2013) and projected to rotations; the positions
then follow linearly. Points give up the orientation of the tool; tool point and base are improved in turn from several
starts, each step in closed form. Poses that hardly turn make the first way fail, and points that hardly move the
second, so poses are located both ways and the better one is kept. Fixed points are linear in all that is unknown.

Y, t: the arm's base in the readings' frame; A: poses of the arm's tip in its base; X, x: the tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modcal_core.calibration.model import Model, new_instruments
from modcal_core.calibration.placing import (
    MAX_ROWS,
    Known,
    find_tool,
    leaders,
    place_instruments,
    require_placeable,
    require_readings,
)
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import indirect_rows
from modcal_core.robots import forward

_DEAR = 1e-3  # how much smaller the tool is preferred to be, where base and tool can stand for each other
_INITIAL_GOOD = 0.005  # median miss, as a share of the arm's reach, that needs no further start


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
    if not shown and (watching := [i for i in instruments if i.of_kind.target]):
        followed = {i.frame for i in watching}
        links = [k for k in known if k.frame in followed and (k.to == "base" or k.to in followed)]
        tool = se3.transform(p=find_tool(watching, samples, T_base_tip, links).x)
    elif not shown:
        tool = np.eye(4)
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
    pose = [samples.is_pose[samples.frame == f] for f in range(len(model.frames))]
    order.sort(key=lambda f: -len(pose[f]) * (1000 if pose[f].all() else 1))  # poses say more of the tool than points
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
    Ry, Rx = base_and_tool_turns(A[:, :3, :3], B[:, :3, :3])
    _, x, t = tool_and_place(Ry, A, B[:, :3, 3])
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
        if cost < _INITIAL_GOOD * reach:
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


# --- Base and tool of readings in closed form, many recordings at a time: ``R ≈ Y A X`` and ``p ≈ Y (A x) + t``

_ALTERNATIONS = 20  # iterations
_HELD = 6e-9  # of the weight of all stations


def base_and_tool_turns(A: Array, R: Array) -> tuple[Array, Array]:
    """(Y, X) with ``R ≈ Y A X`` for rotations A, R (…, N, 3, 3): by SVD (Shah 2013)."""
    # sum of kron(Rᵀ, Aᵀ), which takes y to z
    flat = (np.swapaxes(x.reshape(*x.shape[:-2], 9), -1, -2) for x in (R, A))
    left, right = flat
    products = (left @ np.swapaxes(right, -1, -2)).reshape(*A.shape[:-3], 3, 3, 3, 3)  # R_ji A_lk at j i l k
    U, _, Vt = np.linalg.svd(np.moveaxis(products, (-4, -3, -2, -1), (-2, -4, -1, -3)).reshape(*A.shape[:-3], 9, 9))
    z, y = U[..., 0].reshape(*U.shape[:-2], 3, 3), Vt[..., 0, :].reshape(*U.shape[:-2], 3, 3)
    sign = np.where(np.linalg.det(y) < 0.0, -1.0, 1.0)[..., None, None]
    return so3.nearest_rotation(sign * y), np.swapaxes(so3.nearest_rotation(sign * z), -1, -2)


def turns_left(Y: Array, A: Array, X: Array, R: Array) -> Array:
    """Rotation vectors (…, N, 3) from the predicted to the read orientation, in the tool."""
    return so3.log(np.swapaxes(Y[..., None, :, :] @ A @ X[..., None, :, :], -1, -2) @ R)


def base_by_positions(A: Array, position: Array, rounds: int = _ALTERNATIONS, within: float = 1e-5) -> Array:
    """How bases are turned (C, 3, 3) as positions (C, N, 3) say: base and tool point in turn, so often at most.

    within: [m] that tool points move by at the end.
    """
    x, Y = np.zeros((len(A), 3)), np.empty((len(A), 3, 3))
    centred = np.swapaxes(position - position.mean(axis=1, keepdims=True), 1, 2)
    still = np.arange(len(A))  # those that still change
    for _ in range(rounds):
        Y[still] = so3.nearest_rotation(centred[still] @ _points(A[still], x[still]))
        _, new, _ = tool_and_place(Y[still], A[still], position[still])
        step = np.linalg.norm(new - x[still], axis=1)
        x[still] = new
        still = still[step >= within]
        if not len(still):
            break
    return Y


def _points(A: Array, x: Array) -> Array:
    """Points x (…, 3) moved by poses A (…, N, 4, 4), (…, N, 3)."""
    return np.asarray((A[..., :3, :3] @ x[..., None, :, None])[..., 0] + A[..., :3, 3])


def tool_and_place(Y: Array, A: Array, position: Array) -> tuple[Array, Array, Array]:
    """(residuals (…, N, 3), tool point x (…, 3), base's place t (…, 3)) of ``p ≈ Y (A x) + t``, robust.

    As ``u ≈ a x + s`` in the base: a is a rotation, so that normal equations need the sums of w, w a and w aᵀu alone.
    """
    a = A[..., :3, :3]
    u = position @ Y - A[..., :3, 3]
    rows = a.reshape(*a.shape[:-3], -1, 3)
    back = np.einsum("...ij,...i->...j", a, u)
    sums = np.concatenate([a.reshape(*a.shape[:-2], 9), back, u], axis=-1)
    weight, half = np.ones(sums.shape[:-1]), sums.shape[-2] // 2
    for _ in range(3):
        weight = weight / weight.sum(axis=-1, keepdims=True)
        mean = (weight[..., None, :] @ sums)[..., 0, :]
        turn = mean[..., :9].reshape(*mean.shape[:-1], 3, 3)
        transposed = np.swapaxes(turn, -1, -2)
        held = 1.0 + _HELD  # where no turn tells the tool from the base's place, neither runs away
        H = held * np.eye(3) - transposed @ turn / held
        g = mean[..., 9:12] - (transposed @ mean[..., 12:, None])[..., 0] / held
        x = np.linalg.solve(H, g[..., None])
        s = (mean[..., 12:] - (turn @ x)[..., 0]) / held
        gap = u - s[..., None, :] - (rows @ x).reshape(u.shape)
        square = np.sum(gap**2, axis=-1)
        middle = np.partition(square, half, axis=-1)[..., half, None]
        weight = 1.0 / (square + np.maximum(middle, 1e-18))  # Cauchy
    return gap @ np.swapaxes(Y, -1, -2), x[..., 0], (Y @ s[..., None])[..., 0]
