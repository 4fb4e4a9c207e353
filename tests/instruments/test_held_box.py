"""A held box, scanned with calibrated rays: pose and size within their own error bars, and what is open is said."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.held_box import FACES, measure_box

SIZE = np.array([0.12, 0.08, 0.05])
SIGMA = 1e-4


def scanned(T: Array, rng: np.random.Generator, each: int = 4, sigma: float = SIGMA) -> tuple[Array, Array, list[str]]:
    """(rays, lengths, faces): sensors around the box that look at points of its faces from outside, askew."""
    rays, lengths, faces = [], [], []
    for number, face in enumerate(FACES):
        normal = np.zeros(3)
        normal[number // 2] = 1.0 if number % 2 else -1.0
        for _ in range(each):
            on = rng.uniform(-0.45, 0.45, 3) * SIZE
            on[number // 2] = normal[number // 2] * SIZE[number // 2] / 2.0
            out = normal + rng.uniform(-0.3, 0.3, 3)
            start = on + rng.uniform(0.05, 0.2) * out
            way = T[:3, :3] @ (on - start)
            far = float(np.linalg.norm(way))
            rays.append(np.r_[T[:3, :3] @ start + T[:3, 3], way / far])
            lengths.append(far + sigma * rng.standard_normal())
            faces.append(face)
    return np.array(rays), np.array(lengths), faces


@pytest.mark.slow
def test_pose_and_size_lie_within_three_sigma() -> None:
    rng = np.random.default_rng(1)
    scores = []
    for _ in range(12):
        T = se3.exp(np.r_[rng.uniform(-0.3, 0.3, 3), rng.uniform(-1.5, 1.5, 3)])
        rays, lengths, faces = scanned(T, rng)
        box = measure_box(rays, lengths, faces, SIGMA)
        gap = se3.inverse(T) @ box.T_frame_box
        scores.append(np.r_[gap[:3, 3], so3.log(gap[:3, :3]), box.size - SIZE] / box.std)
    size = np.abs(np.concatenate(scores))
    assert np.mean(size < 3.0) >= 0.97
    assert 0.58 < np.mean(size < 1.0) < 0.78


def test_exact_points_give_the_box_itself() -> None:
    T = se3.exp([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
    rays, lengths, faces = scanned(T, np.random.default_rng(2), each=2, sigma=0.0)
    box = measure_box(rays, lengths, faces, SIGMA)
    assert np.abs(box.T_frame_box - T).max() < 1e-7
    assert np.abs(box.size - SIZE).max() < 1e-7
    assert np.abs(box.residual).max() < 1e-8


def test_a_known_size_stands_for_a_face_that_no_ray_meets() -> None:
    T = se3.exp([0.1, 0.0, 0.2, 0.2, 0.1, 0.3])
    rays, lengths, faces = scanned(T, np.random.default_rng(3))
    seen = np.array([f != "-z" for f in faces])
    rays, lengths, left = rays[seen], lengths[seen], [f for f in faces if f != "-z"]
    with pytest.raises(NotEnoughData, match="box, size along z: only one of its two faces was hit"):
        measure_box(rays, lengths, left, SIGMA)
    box = measure_box(rays, lengths, left, SIGMA, [np.nan, np.nan, SIZE[2]])
    gap = se3.inverse(T) @ box.T_frame_box
    assert np.abs(np.r_[gap[:3, 3], so3.log(gap[:3, :3])] / box.std[:6]).max() < 3.5
    assert box.size[2] == SIZE[2]
    assert box.std[8] == 0.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r, d, f: (r, d, ["top", *f[1:]]), "face 'top': is not a face of a box"),
        (lambda r, d, f: (r, d * np.nan, f), "rays on the box: a length is not positive or not finite"),
        (lambda r, d, f: (2.0 * r, d, f), "rays on the box: a direction does not have length one"),
        (lambda r, d, f: (r[8:], d[8:], f[8:]), "box, axis x: neither of its faces was hit"),
        (lambda r, d, f: (r[::4], d[::4], f[::4]), "6 rays on the box leave open"),
    ],
)
def test_what_cannot_be_measured_is_refused(change, said: str) -> None:  # type: ignore[no-untyped-def]
    rays, lengths, faces = scanned(np.eye(4), np.random.default_rng(4))
    with pytest.raises((BadTable, NotEnoughData), match=said):
        measure_box(*change(rays, lengths, faces), SIGMA)
