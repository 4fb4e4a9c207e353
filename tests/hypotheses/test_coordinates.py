"""Positions that were written as something else than places in the tracker's frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.geometry.so3 import Array
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.measurements.samples import Samples

CHAIN = ur10()


@pytest.fixture(scope="module")
def clean() -> Samples:
    return record(12, 90).samples


def turned(R: Array, p: Array) -> Array:
    return np.asarray((R @ p[..., None])[..., 0])


def said(samples: Samples, position: Array) -> str:
    found = disagreement(replace(samples, reading=position), CHAIN)
    assert found is not None
    return found.what


def test_other_axes(clean: Samples) -> None:
    p, R = clean.reading, clean.R
    back = np.swapaxes(R, 1, 2)
    assert "along the axes of the tool" in said(clean, turned(back, p))
    assert "inverse poses (tracker in the tool" in said(clean, -turned(back, p))
    assert "turned by the orientation once too often" in said(clean, turned(R, p))


def test_steps_and_angles(clean: Samples) -> None:
    p = clean.reading
    assert "increments" in said(clean, np.diff(p, axis=0, prepend=0.0 * p[:1]))
    r = np.linalg.norm(p, axis=1)
    azimuth, elevation = np.arctan2(p[:, 1], p[:, 0]), np.arcsin(p[:, 2] / r)
    points = replace(clean, kind=np.full(90, "point"), R=np.broadcast_to(np.eye(3), clean.R.shape))
    found = said(points, np.stack([azimuth, elevation, r], axis=1))
    assert "polar coordinates (azimuth, elevation, range; angles in radians, range in metres)" in found
    found = said(clean, np.stack([r, np.degrees(-azimuth), 90.0 - np.degrees(elevation)], axis=1))
    assert "(range, azimuth, zenith angle; angles in degrees, range in metres, azimuth clockwise)" in found
