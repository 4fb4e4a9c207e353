"""Images of a target on disk: what a calibrator goes on from after a restart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera.boards import BOARD, facing, views

from modcal_core.camera.bundle import BoardView
from modcal_core.camera.target_file import scale_of_rulers
from modcal_core.errors import BadTable
from modcal_nodes.calibrating.state import forget_images, read_images, write_images


def test_images_come_back_as_they_were(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    seen = [replace(v, stamp=float(i)) for i, v in enumerate(views(rng, facing(rng, 4)))]
    images = [(v, rng.normal(size=7)) for v in seen]
    assert read_images(tmp_path / "state", BOARD) is None
    write_images(tmp_path / "state", images, (1280, 720), BOARD, True)
    kept = read_images(tmp_path / "state", BOARD)
    assert kept is not None
    assert (kept.size, kept.trusted) == ((1280, 720), True)
    for (view, q), (expected, joints) in zip(kept.images, images, strict=True):
        assert (view.name, view.stamp) == (expected.name, expected.stamp)
        assert (view.ids == expected.ids).all()
        assert (view.pixels == expected.pixels).all()
        assert (view.cov == expected.cov).all()
        assert (q == joints).all()
    measured = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.201, 0.12), "rulers"))
    assert read_images(tmp_path / "state", measured) is not None  # the same sheet, measured since
    assert read_images(tmp_path / "state", replace(BOARD, square=0.031)) is None


def test_damaged_images_are_refused(tmp_path: Path) -> None:
    (tmp_path / "images.npz").write_bytes(b"PK")
    with pytest.raises(BadTable, match="damaged"):
        read_images(tmp_path, BOARD)
    forget_images(tmp_path)
    assert read_images(tmp_path, BOARD) is None


def test_images_of_a_further_camera_are_kept_beside(tmp_path: Path) -> None:
    """Each in a file of its own; all are forgotten together."""
    images = [(BoardView("0", np.arange(4), np.zeros((4, 2)), np.tile(np.eye(2), (4, 1, 1)), stamp=1.5), np.zeros(7))]
    write_images(tmp_path, images, (1280, 720), BOARD, False)
    write_images(tmp_path, images * 2, (640, 480), BOARD, False, 2)
    first, second = (read_images(tmp_path, BOARD, camera) for camera in (1, 2))
    assert first is not None
    assert second is not None
    assert (first.size, second.size) == ((1280, 720), (640, 480))
    assert (len(first.images), len(second.images)) == (1, 2)
    forget_images(tmp_path)
    assert read_images(tmp_path, BOARD) is None
    assert read_images(tmp_path, BOARD, 2) is None
