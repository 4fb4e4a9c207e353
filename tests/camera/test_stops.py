"""Images of one stop of the arm by several cameras: one error of the arm, and which images are of one stop."""

from __future__ import annotations

import numpy as np

from modcal_core.camera.corners import POSE
from modcal_core.camera.equations import ALONE, CameraRows, Equations, Sizes, numbered
from modcal_core.geometry.so3 import Array

SIZES = Sizes(noise=1.3, joint=0.2, shift=0.3, arm=0.1)
JOINTS, ROWS = 4, 30


def camera(rng: np.random.Generator, stop: list[int], K: int, columns: np.ndarray) -> tuple[Array, CameraRows]:
    """(rows of each image by its pose, what images share, and the residual, (N, 30, 22 + Z); their equations)."""
    N = len(stop)
    rows = rng.normal(size=(N, ROWS, POSE + len(columns) - K + 1))
    own = [rng.normal(size=(N, 6, k)) for k in (K, JOINTS + 3)]
    return rows, CameraRows(
        np.swapaxes(rows, 1, 2) @ rows, *own, columns, N * ROWS // 2, np.array(stop), np.empty((0, 2))
    )


def test_one_error_of_the_arm_a_stop_is_what_a_fit_of_every_stops_own_would_leave() -> None:
    """Against normal equations in which what joints and tool are off by at every stop are parameters themselves."""
    rng = np.random.default_rng(4)
    count = 5 + 15 + 4
    cameras = [
        camera(rng, [0, 1, 2, ALONE, ALONE, 3, ALONE, ALONE], 5, np.arange(count)),
        camera(rng, [3, 2, 9, ALONE, 1, 0], 3, np.r_[0, 1, -1, 5 + np.arange(17)]),
    ]
    offset, information = rng.normal(size=count), np.diag(rng.uniform(1.0, 2.0, count))
    together: dict[tuple[int, int], int] = {}
    rows, right = [], []
    for k, (seen, eq) in enumerate(cameras):
        for i, (own, stop) in enumerate(zip(seen / SIZES.noise, eq.stop, strict=True)):
            at = together.setdefault((0, int(stop)) if stop != ALONE and stop != 9 else (1 + k, i), len(together))
            row = np.zeros((ROWS, count + 20 * (JOINTS + 3)))
            by = np.concatenate([own[:, :6] @ eq.moved[i], own[:, 6:-1]], axis=1)
            row[:, eq.columns[eq.columns >= 0]] = by[:, eq.columns >= 0]
            of_stop = eq.own[i] * SIZES.off(eq.own.shape[2])
            row[:, count + at * (JOINTS + 3) + np.arange(JOINTS + 3)] = own[:, :6] @ of_stop
            rows.append(row)
            right.append(own[:, -1])
    assert len(together) == 8 + 6 - 4
    A, y = np.concatenate(rows), np.concatenate(right)
    H, b = A.T @ A, A.T @ y
    inner = H[count:, count:] + np.eye(len(H) - count)
    left = np.linalg.solve(inner, np.c_[H[count:, :count], b[count:]])
    expected = H[:count, :count] - H[:count, count:] @ left[:, :-1] + information
    every = tuple(eq for _, eq in cameras)
    found = Equations(every, offset, information, np.ones(count, bool), np.empty(0, int)).solve(SIZES)
    assert np.allclose(found.H, expected, rtol=1e-12)
    assert np.allclose(found.b, b[:count] - H[:count, count:] @ left[:, -1] - information @ offset)
    assert np.isclose(found.cost, y @ y - b[count:] @ left[:, -1] + offset @ information @ offset)
    noise = 2.0 * sum(eq.corners for eq in every) * np.log(SIZES.noise**2)
    assert np.isclose(found.spread, noise + np.linalg.slogdet(inner)[1])


def test_a_change_of_images_is_a_parameter_of_its_own() -> None:
    """Against normal equations with the change's two numbers beside the parameters; one camera saw a stop twice."""
    rng = np.random.default_rng(5)
    cameras = [camera(rng, [0, 1, 1, 2], 4, np.arange(10)), camera(rng, [2, 0], 3, np.r_[0, 1, -1, 4 + np.arange(6)])]
    changes = {k: rng.normal(size=(len(seen), seen.shape[2] - 1, 2)) for k, (seen, _) in enumerate(cameras)}
    for k, (_, eq) in enumerate(cameras):
        changes[k][eq.stop == 0] = 0.0  # before it
    size, m = 10 + 2 + 1, JOINTS + 3
    rows = []
    for k, (seen, eq) in enumerate(cameras):
        for i, own in enumerate(seen / SIZES.noise):
            row = np.zeros((ROWS, 3 * m + size))
            of_stop = eq.own[i] * SIZES.off(eq.own.shape[2])
            row[:, m * eq.stop[i] + np.arange(m)] = own[:, :POSE] @ of_stop
            by = np.concatenate([own[:, :POSE] @ eq.moved[i], own[:, POSE:-1]], axis=1)
            row[:, 3 * m + eq.columns[eq.columns >= 0]] = by[:, eq.columns >= 0]
            row[:, -3:] = np.c_[own[:, :-1] @ changes[k][i], own[:, -1]]
            rows.append(row)
    A = np.concatenate(rows)
    H = A.T @ A
    H[: 3 * m, : 3 * m] += np.eye(3 * m)
    expected = H[3 * m :, 3 * m :] - H[3 * m :, : 3 * m] @ np.linalg.solve(H[: 3 * m, : 3 * m], H[: 3 * m, 3 * m :])
    every = Equations(tuple(eq for _, eq in cameras), np.zeros(10), np.eye(10), np.ones(10, bool), np.empty(0, int))
    own, cross = every.by_change(SIZES, changes)
    assert np.allclose(own.sum(axis=0), expected[-3:-1, -3:-1])
    assert np.allclose(cross.sum(axis=0), np.c_[expected[-3:-1, :-3], expected[-3:-1, -1:]])
    assert np.allclose(own[0], 0.0)


def test_images_of_one_stop_by_name_by_joints_or_by_time() -> None:
    q = np.array([[0.0, 1.0], [0.5, 1.0], [0.0, 1.0], [2.0, 0.0]])
    unknown = [np.empty(0), np.empty(0)]
    named = numbered([q, q[[2, 0, 1]]], [["1", "2", "3", "4"], ["3", "1", "2"]], unknown)
    assert [list(one) for one in named] == [[0, 1, 2, ALONE], [2, 0, 1]]
    # names of their own: visits of one posture are taken in turn
    by_joints = numbered([q, q[[2, 0, 1]]], [["a1", "a2", "a3", "a4"], ["b1", "b2", "b3"]], unknown)
    assert [list(one) for one in by_joints] == [[0, 1, 2, ALONE], [0, 2, 1]]
    timed = numbered(
        [q, q[[0, 2]] + 2e-4],
        [["10", "20", "30", "40"], ["10.1", "30.1"]],
        [np.arange(1, 5) * 10.0, np.array([10.1, 30.1])],
    )
    assert [list(one) for one in timed] == [[0, ALONE, 1, ALONE], [0, 1]]
    far = numbered([q[:1], q[:1]], [["10"], ["90"]], [np.array([10.0]), np.array([90.0])])
    assert [list(one) for one in far] == [[ALONE], [ALONE]]
