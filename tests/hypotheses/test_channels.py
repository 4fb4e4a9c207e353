"""Of a recording that misses by far, the one channel that does not go along with the rest is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array
from modcal_core.hypotheses.hypothesis import Disagreement
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples

CHAIN = ur10()


@pytest.fixture(scope="module")
def clean() -> Samples:
    return record(12, 90).samples


def named(found: Disagreement | None) -> str:
    assert found is not None
    assert found.remedy
    return found.what


def turned(samples: Samples, R: Array) -> Samples:
    return replace(samples, R=R @ samples.R)


@pytest.mark.parametrize(("shift", "side"), [(1, "late"), (-2, "early")])
def test_a_table_that_slipped(clean: Samples, shift: int, side: str) -> None:
    position, R = np.roll(clean.reading, shift, axis=0), np.roll(clean.R, shift, axis=0)
    said = named(disagreement(replace(clean, reading=position, R=R), CHAIN))
    assert said.startswith(f"readings look {side} by {abs(shift)} station")


def test_one_column_and_the_orientations_alone_that_slipped(clean: Samples) -> None:
    position = clean.reading.copy()
    position[:, 2] = np.roll(position[:, 2], 1)
    said = named(disagreement(replace(clean, reading=position), CHAIN))
    assert said.startswith("column z of the positions looks late by 1 station:")
    said = named(disagreement(replace(clean, R=np.roll(clean.R, 1, axis=0)), CHAIN))
    assert said.startswith("orientations look late by 1 station:")


def test_orientations_in_another_frame_than_positions(clean: Samples) -> None:
    other = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    said = named(disagreement(turned(clean, other), CHAIN))
    assert f"turned by {np.degrees(np.linalg.norm([0.3, -0.5, 0.2])):.3g}°" in said
    cycled = replace(clean, reading=clean.reading[:, [1, 2, 0]])
    assert "turned by 120°" in named(disagreement(cycled, CHAIN))
    slightly = Rotation.from_rotvec([0.01, 0.0, 0.0]).as_matrix()  # what a displaced arm may do
    assert disagreement(turned(clean, slightly), CHAIN) is None


def test_a_coordinate_that_is_too_long(clean: Samples) -> None:
    inches = replace(clean, reading=clean.reading * [1.0, 1.0, 1.0 / 0.0254])
    said = named(disagreement(inches, CHAIN))
    assert said.startswith("coordinate z of the readings looks ")
    # an arm that is displaced knows the scale to some parts in a thousand
    assert float(said.partition("looks ")[2].partition(" times")[0]) == pytest.approx(39.37, rel=0.01)


def test_an_offset_taken_off_in_the_inverse_orientation(clean: Samples) -> None:
    offset = np.array([0.03, -0.05, 0.04])
    wrong = replace(clean, reading=clean.reading - np.swapaxes(clean.R, 1, 2) @ offset)
    said = named(disagreement(wrong, CHAIN))
    assert "not as those of one point of the tool" in said
    size = float(said.partition("an offset of ")[2].partition(" mm")[0])
    assert size == pytest.approx(1e3 * np.linalg.norm(offset), rel=0.2)


@pytest.mark.slow
def test_a_calibration_is_refused_by_name(clean: Samples) -> None:
    late = replace(clean, reading=np.roll(clean.reading, 1, axis=0), R=np.roll(clean.R, 1, axis=0))
    with pytest.raises(BadRecording, match="readings look late by 1 station"):
        calibrate(late, CHAIN, np.random.default_rng(0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "sign", "said"),
    [
        ([0, 1, 2, 3, 4, 5], [-1.0] * 6, "look reversed"),
        ([2, 1, 0, 3, 4, 5], [1.0, 1.0, -1.0, 1.0, 1.0, 1.0], "look swapped, and"),
    ],
)
def test_joints_of_other_signs_and_names(clean: Samples, order: list[int], sign: list[float], said: str) -> None:
    with pytest.raises(BadRecording, match=said):
        calibrate(replace(clean, q=clean.q[:, order] * sign), CHAIN, np.random.default_rng(0))
