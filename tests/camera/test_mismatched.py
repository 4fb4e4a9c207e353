"""Tables in which images and joints do not belong together as they stand: what would is named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from camera.bodies import Faults, body_scene
from camera.fits import MEASURED
from camera.scenes import scene

from modcal_core.camera.bundle import BoardView
from modcal_core.camera.cameras import CameraImages
from modcal_core.camera.prepared import prepare_images, together
from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array

Spoil = Callable[[Array], Array]
EXCHANGED = [0, 1, 2, 3, 4, 6, 5]


def same(x: Array) -> Array:
    return x


@pytest.mark.parametrize(
    ("joints", "pixels", "said"),
    [
        (lambda q: np.roll(q, 1, axis=0), same, "with the joints of the image after they are"),
        (lambda q: np.roll(q, -1, axis=0), same, "with the joints of the image before they are"),
        (lambda q: q[:, EXCHANGED], same, "with panda_joint6 and panda_joint7 exchanged they are"),
        (lambda q: q * [1, 1, 1, 1, -1, 1, 1], same, "with panda_joint5 of the other sign they are"),
        (same, lambda p: p[:, ::-1], "with the pixels mirrored they are"),
        (same, lambda p: [0.0, 719.0] + p * [1.0, -1.0], "with the pixels mirrored they are"),
    ],
)
def test_what_would_belong_together_is_named(joints: Spoil, pixels: Spoil, said: str) -> None:
    s = scene(77, True, count=14, board=MEASURED)
    images = CameraImages(joints(s.q), _spoilt(s.views, pixels), s.board, s.lens.size)
    with pytest.raises(BadRecording, match=said):
        prepare_images(s.chain, images)


def test_joints_that_are_shuffled_are_explained_by_nothing(rng: np.random.Generator) -> None:
    s = scene(77, True, count=14, board=MEASURED)
    images = CameraImages(rng.permutation(s.q), s.views, s.board, s.lens.size)
    with pytest.raises(BadRecording, match="joints") as refused:
        prepare_images(s.chain, images)
    assert "with " not in refused.value.limit


def test_joints_of_a_body_s_images_that_are_exchanged() -> None:
    s = body_scene(3, 30, 1, Faults(late=0, misread=0.0), corners=True)
    (images,) = together(s.images)
    lens = replace(images, lens=s.lenses[0], q=images.q[:, EXCHANGED])
    with pytest.raises(BadRecording, match="with panda_joint6 and panda_joint7 exchanged"):
        prepare_images(s.chain, lens)


def _spoilt(views: Sequence[BoardView], pixels: Spoil) -> list[BoardView]:
    return [replace(v, pixels=pixels(v.pixels)) for v in views]
