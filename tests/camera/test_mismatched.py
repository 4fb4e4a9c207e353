"""Tables in which images and joints do not belong together as they stand: what would is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from camera.fits import MEASURED
from camera.scenes import scene

from modcal_core.camera.fit import CameraImages
from modcal_core.camera.prepared import prepare_images
from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array

EXCHANGED = [0, 1, 2, 3, 4, 6, 5]


@pytest.mark.parametrize(
    ("joints", "mirror", "said"),
    [
        (lambda q: np.roll(q, 1, axis=0), 1.0, "readings look early by 1 station"),
        (lambda q: q[:, EXCHANGED], 1.0, "panda_joint6.*panda_joint7"),
        (lambda q: q, -1.0, "mirror image"),
    ],
)
def test_what_would_belong_together_is_named(joints: Callable[[Array], Array], mirror: float, said: str) -> None:
    s = scene(77, True, count=18, board=MEASURED)
    views = [replace(v, pixels=[0.0, 360.0 - 360.0 * mirror] + v.pixels * [1.0, mirror]) for v in s.views]
    with pytest.raises(BadRecording, match=said):
        prepare_images(s.chain, CameraImages(joints(s.q), views, s.board, s.lens.size))


def test_joints_that_are_shuffled_are_explained_by_nothing(rng: np.random.Generator) -> None:
    s = scene(77, True, count=14, board=MEASURED)
    images = CameraImages(rng.permutation(s.q), s.views, s.board, s.lens.size)
    with pytest.raises(BadRecording, match="joints") as refused:
        prepare_images(s.chain, images)
    assert refused.value.limit.endswith(("off)", "in the median"))
