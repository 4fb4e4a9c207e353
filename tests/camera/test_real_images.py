"""Sixteen real images of a ChArUco board on an arm's flange, seen by a fixed camera; no joints, only flange poses.

And a positioner of two axes, whose target a camera saw.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from camera.flange import flange_arm, flange_joints

from modcal_core.camera.bundle import CHARUCO, BoardView, PrintedTarget
from modcal_core.camera.corners import CornerTable
from modcal_core.camera.fit import CameraFit, CameraImages
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import first_lens, fit_lens
from modcal_core.camera.prepared import nominal, prepare_images
from modcal_core.files import read_yaml
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "industrial_calibration" / "charuco"
BOARD = PrintedTarget(CHARUCO, 5, 7, 0.036195, 0.018256, "DICT_6X6_250")
SIZE = (1600, 1200)
KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not DATA.is_dir(), reason=f"{DATA} is missing")]


@cache
def read() -> tuple[list[BoardView], Array]:
    """The board in all sixteen, and the flange poses (16, 4, 4)."""
    import cv2

    from modcal_nodes.vision.detection import detect

    views, poses = [], []
    for i in range(16):
        grey = cv2.imread(str(DATA / "images" / f"{i}.png"), cv2.IMREAD_GRAYSCALE)
        found = detect(grey, BOARD, f"{i}.png")
        assert found.view is not None, (i, found.reason)
        views.append(found.view)
        pose = read_yaml(DATA / "poses" / f"{i}.yaml")
        poses.append([pose[k] for k in KEYS])
    return views, se3.from_pose(np.array(poses))


def test_fitted_corners_agree_better_than_opencvs(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a lens and a flat board, that no simulation has made."""
    from modcal_nodes.vision import detection as detect
    from modcal_nodes.vision.saddle import SaddleFit

    def rms() -> float:
        table = CornerTable.of([replace(v, cov=np.tile(np.eye(2), (len(v), 1, 1))) for v in read()[0]], BOARD)
        return float(np.sqrt(fit_lens(table, first_lens(table, SIZE)).cost / len(table)))

    def unfitted(pixels: Array) -> SaddleFit:
        none = np.zeros(len(pixels))
        return SaddleFit(pixels, np.zeros((len(pixels), 2, 2)), none, none > 0.0)

    fitted = rms()
    with monkeypatch.context() as patch:
        patch.setattr(detect, "fit_board", lambda grey, target, ids, pixels: unfitted(pixels))
        read.cache_clear()
        opencv = rms()
    read.cache_clear()
    assert fitted < 0.98 * opencv


def placed(lens: Lens | None) -> CameraFit:
    """Camera and board placed by these images, with this lens or with one found from them; no guess is given."""
    views, A = read()
    images = CameraImages(flange_joints(A), views, BOARD, SIZE, lens=lens, stated="free" if lens is None else "fixed")
    ready = prepare_images(flange_arm(), images)
    assert not ready.mounting.camera_on_tip
    assert ready.mounting.rival > 3.0
    return nominal(ready)


def test_placed_without_a_guess_as_well_as_somebody_calibrated_it() -> None:
    """Distances of each image's board from the arm's, as the given intrinsics and as the images' own have them."""
    given = placed(Lens.of([[1352.02747, 0, 789.67065], [0, 1356.14287, 627.2995], [0, 0, 1]], [], SIZE))
    own = placed(None)
    assert own.converged
    assert own.rms_px[0] < given.rms_px[0]
    # where somebody put the camera: given as a guess in cal_data.yaml, and used for nothing but this
    guess = read_yaml(DATA / "cal_data.yaml")["camera_mount_to_camera_guess"]
    camera = np.linalg.inv(own.poses.model_at(own.state.values).T_frame_base[0])[:3, 3]
    assert np.linalg.norm(camera - [guess[k] for k in "xyz"]) < 0.05


def test_a_positioner_of_two_axes() -> None:
    """205 poses of a target on a positioner, by a camera: its maintainers fit 1.74 mm in the mean, here on held-out poses.

    Nothing is taken from their guesses: axes at right angles, half a metre apart.
    """
    data = read_yaml(DATA.parent / "positioner_measurements.yaml")
    q = np.array([data[k]["target_joints"] for k in sorted(data)])
    T = se3.from_pose(np.array([[data[k]["pose"][name] for name in KEYS] for k in sorted(data)]))
    origins = [np.eye(4), se3.exp([0.0, 0.0, 0.3, 0.5 * np.pi, 0.0, 0.0]), se3.exp([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])]
    limits = ([-7.0, -7.0], [7.0, 7.0])
    chain = Chain.build(("tilt", "turn"), origins, [[0, 0, 1], [0, 0, 1]], None, *limits, base="base", tip="table")
    samples = Samples.from_arrays(q, poses=T, names=chain.names)
    report = calibrate(samples, chain, np.random.default_rng(0), look_for_effects=False).report
    off = report.errors["geometric"].position_norm
    assert len(off) >= 50
    assert off.mean() < 0.5e-3
