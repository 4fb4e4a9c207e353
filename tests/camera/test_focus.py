"""A focal length that differs from image to image is named as that, and not taken for a camera that was moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from camera.boards import views
from camera.fits import MEASURED, solved
from camera.scenes import CameraScene, scene

from modcal_core.camera.solve import CameraSolution
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array


def scaled(s: CameraScene, zooms: Array) -> CameraSolution:
    """Of images each scaled about its middle, as autofocus, digital zoom, or a program that cuts and scales does."""
    T = se3.inverse(s.T) if s.on_tip else s.T
    middle = 0.5 * (np.array(s.lens.size) - 1.0)
    seen = []
    for i, zoom in enumerate(zooms):
        values = s.lens.values.copy()
        values[:2] *= zoom
        values[2:4] = middle + zoom * (values[2:4] - middle)
        lens = replace(s.lens, values=values)
        seen += views(np.random.default_rng([8, i]), T[i : i + 1], lens=lens, board=MEASURED)
    return solved(replace(s, views=seen), look_for_effects=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("on_tip", "what"), [(True, "autofocus"), (False, "every second image is larger"), (True, "nothing")]
)
def test_focus_that_hunts(on_tip: bool, what: str) -> None:
    s = scene(65, on_tip, count=20, board=MEASURED)
    zooms: Array = {
        "autofocus": 1.0 + 5e-3 * np.random.default_rng(2).standard_normal(len(s.q)),
        "every second image is larger": 1.0 + 0.02 * (np.arange(len(s.q)) % 2),
        "nothing": np.ones(len(s.q)),
    }[what].astype(float)
    r = scaled(s, zooms)
    named = [said for said in r.claim.decision.problems if "focal length differs from image to image" in said]
    assert r.evidence.moved is None
    assert bool(named) == (what != "nothing"), r.claim.decision.because
    if named:
        said = float(named[0].partition("by ")[2].partition(" %")[0])
        assert said == pytest.approx(100.0 * np.std(zooms), rel=0.3)
