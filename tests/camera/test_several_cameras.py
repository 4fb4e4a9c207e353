"""Several cameras that watch one arm, images of one stop, and one error of the arm at each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from camera.boards import BOARD, views
from camera.fits import MEASURED, problem, true_error
from camera.scenes import BOARD_ON_TIP, CAMERA_IN_WORLD, CameraScene, scene
from finite_differences import assert_jacobian

from modcal_core.camera.bundle import PrintedTarget
from modcal_core.camera.claim import APPLY
from modcal_core.camera.corners import POSE
from modcal_core.camera.equations import CameraRows, Equations, Sizes, numbered
from modcal_core.camera.fit import CameraImages
from modcal_core.camera.lens import Lens
from modcal_core.camera.solve import CameraSolution, solve_camera
from modcal_core.camera.views import postures_in_view
from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

OTHER_LENS = Lens(np.array([620.0, 622.0, 318.0, 242.0, 0.05, -0.04, 0.0, 0.0005, 0.0]), (640, 480))
MIDDLE, AT = (
    np.array([0.0, 0.0, 0.47]),
    np.array([-0.25, 0.12, -0.12]),
)  # of the board; of a second tripod, from the first


def looking() -> Array:
    """The second camera from the first, looking at the middle of where the board is."""
    z = (MIDDLE - AT) / np.linalg.norm(MIDDLE - AT)
    x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
    return se3.transform(np.stack([x, np.cross(z, x), z], axis=1), AT)


def solved(s: CameraScene, *others: CameraImages) -> CameraSolution:
    return solve_camera(problem(s, *others, look_for_effects=False), np.random.default_rng(3))


def on_tripod(s: CameraScene, kicked_at: int | None = None, board: PrintedTarget = MEASURED) -> CameraImages:
    """What a second camera in the world saw of the board on the tip, of the scene's arm at its postures."""
    camera = CAMERA_IN_WORLD @ looking()
    T = se3.inverse(camera) @ _tip(s) @ BOARD_ON_TIP
    if kicked_at is not None:
        T = np.concatenate([T[:kicked_at], se3.exp([4e-3, 0.0, 0.0, 0.0, 5e-3, 0.0]) @ T[kicked_at:]])
    seen = views(np.random.default_rng(7), T, lens=OTHER_LENS, board=board)
    good = [i for i, v in enumerate(seen) if len(v) >= 8]
    return CameraImages(s.q[good], [seen[i] for i in good], board, OTHER_LENS.size, name="/second/image")


def _tip(s: CameraScene) -> Array:
    """True poses of the tip in the base, (N, 4, 4)."""
    return CAMERA_IN_WORLD @ s.T @ se3.inverse(BOARD_ON_TIP)


@pytest.fixture(scope="module")
def cell() -> CameraScene:
    return scene(61, False, count=14, board=MEASURED)


@pytest.fixture(scope="module")
def three(cell: CameraScene) -> CameraSolution:
    """Two tripods, which see the sheet on the tip, and a camera on the hand, which sees one that nobody has measured."""
    hand = scene(61, True, count=12, board=replace(BOARD, square=0.028, marker=0.02))
    other = CameraImages(hand.q, hand.views, hand.board, hand.lens.size, name="/hand/image")
    return solved(cell, on_tripod(cell), other)


@pytest.mark.slow
def test_three_cameras_know_the_arm_better_than_one(cell: CameraScene, three: CameraSolution) -> None:
    """Size and bow of the sheet on the tip are one for both that see it; the other sheet gets its size by the arm."""
    _, second, hand = three.fit.cameras.every
    assert (second.mounting.camera_on_tip, hand.mounting.camera_on_tip) == (False, True)
    _, state, of_hand = three.fit.states
    std = three.fit.std[1][len(state.values) + 1 :]
    assert second.table.views == len(on_tripod(cell).views) >= 10
    assert (np.abs(state.lens.values - OTHER_LENS.values)[:4] < 4.0 * std[:4]).all()
    assert std[:4].max() < 3.0
    assert (state.shape == three.fit.state.shape).all()
    assert not np.isclose(of_hand.shape[:2], three.fit.state.shape[:2]).any()
    assert three.fit.rms_px[2] < 0.5
    assert three.claim.decision.word == APPLY
    q = postures_in_view(three.fit, np.random.default_rng(1))
    assert true_error(cell, three.fit, q) < three.claim.in_view.interval[2]
    equations, sizes = three.fit.equations, three.fit.sizes
    arm = equations.arm
    alone = np.diag(replace(equations, cameras=equations.cameras[:1]).solve(sizes).covariance())[arm]
    better = np.diag(three.fit.covariance)[arm] / alone
    assert (better < 1.0 + 1e-9).all()
    assert np.median(better) < 0.6


@pytest.mark.slow
def test_derivatives_and_shared_sheet(three: CameraSolution) -> None:
    """The gradient of the likelihood by every parameter, those of further cameras included."""
    fit = three.fit
    rng = np.random.default_rng(0)
    count = len(fit.covariance)
    off = np.sqrt(np.diag(fit.covariance)) * rng.normal(size=count)
    x0 = fit.x + off
    sizes = replace(fit.sizes, joint=1e-9, shift=1e-9)  # what images have of their own is not differentiated

    def cost(x: Array) -> Array:
        return np.array([fit.cameras.equations(x0 + x).solve(sizes).cost])

    here = fit.cameras.equations(x0).solve(sizes)
    free = here.use
    gradient = np.zeros(count)
    gradient[free] = -2.0 * here.b
    chosen = np.zeros((count, 4))  # along a few directions, of the size of what is known
    for k in range(4):
        chosen[free, k] = np.sqrt(np.diag(fit.covariance))[free] * rng.normal(size=len(free))
    assert_jacobian(lambda x: cost(chosen @ x), gradient[None] @ chosen, np.zeros(4), tolerance=1e-4)


def test_a_kick_of_one_tripod_is_not_said_of_the_other(cell: CameraScene) -> None:
    r = solved(cell, on_tripod(cell, 6))
    assert r.evidence.moved is None
    assert [said for said in r.claim.decision.problems if "was moved" in said] == [
        said
        for said in r.claim.decision.problems
        if said.startswith("The camera of /second/image was moved before image 6")
    ]
    assert any("/second/image was moved" in said for said in r.claim.decision.problems)


def test_a_camera_is_given_once(cell: CameraScene) -> None:
    with pytest.raises(BadRecording, match="given twice"):
        solved(cell, replace(on_tripod(cell), name="images"))


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
    count = 5 + 15 + 4 + 1
    cameras = [
        camera(rng, [0, 1, 2, 20, 21, 3, 22, 23], 5, np.arange(count - 1)),
        camera(rng, [3, 2, 9, 24, 1, 0], 3, np.r_[0, 1, count - 1, 5 + np.arange(17)]),
    ]
    offset, information = rng.normal(size=count), np.diag(rng.uniform(1.0, 2.0, count))
    together, rows, right = dict[int, int](), [], []
    for seen, eq in cameras:
        for i, (own, stop) in enumerate(zip(seen / SIZES.noise, eq.stop, strict=True)):
            at = together.setdefault(int(stop), len(together))
            row = np.zeros((ROWS, count + 20 * (JOINTS + 3)))
            row[:, eq.columns] = np.concatenate([own[:, :6] @ eq.moved[i], own[:, 6:-1]], axis=1)
            row[:, count + at * (JOINTS + 3) + np.arange(JOINTS + 3)] = own[:, :6] @ (eq.own[i] * SIZES.off(JOINTS + 3))
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


def test_images_of_one_stop_by_name_by_joints_or_by_time() -> None:
    q = np.array([[0.0, 1.0], [0.5, 1.0], [0.0, 1.0], [2.0, 0.0]])
    unknown = [np.empty(0), np.empty(0)]
    named = numbered([q, q[[2, 0, 1]]], [["1", "2", "3", "4"], ["3", "1", "2"]], unknown)
    assert [list(one) for one in named] == [[0, 1, 2, 3], [2, 0, 1]]
    # names of their own: visits of one posture are taken in turn
    by_joints = numbered([q, q[[2, 0, 1]]], [["a1", "a2", "a3", "a4"], ["b1", "b2", "b3"]], unknown)
    assert [list(one) for one in by_joints] == [[0, 1, 2, 3], [0, 2, 1]]
    timed = numbered(
        [q, q[[0, 2]] + 2e-4],
        [["10", "20", "30", "40"], ["10.1", "30.1"]],
        [np.arange(1, 5) * 10.0, np.array([10.1, 30.1])],
    )
    assert [list(one) for one in timed] == [[0, 1, 2, 3], [0, 2]]
    far = numbered([q[:1], q[:1]], [["10"], ["90"]], [np.array([10.0]), np.array([90.0])])
    assert [list(one) for one in far] == [[0], [1]]
