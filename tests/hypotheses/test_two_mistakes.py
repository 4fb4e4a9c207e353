"""Two mistakes at once: the refusal names the one that can be told, and does not let the other hide it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples

WORLD = record(11, 80)
CLEAN = WORLD.samples


def refused(samples: Samples) -> str:
    with pytest.raises(BadRecording) as found:
        calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)
    return str(found.value)


def swapped(q: Array) -> Array:
    return q[:, [0, 2, 1, 3, 4, 5]]


def reversed_wrist(q: Array) -> Array:
    return q * np.where(np.arange(6) == 4, -1.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joints", "words"),
    [
        (swapped, "joints shoulder_lift_joint and elbow_joint look swapped"),
        # half a turn of the joint before turns the wrist nearly alike, and is followed first
        (reversed_wrist, "wrist_2_joint looks reversed"),
    ],
)
def test_a_joint_is_named_though_orientations_are_of_another_convention(joints, words: str) -> None:  # type: ignore[no-untyped-def]
    scalar_first = Rotation.from_quat(Rotation.from_matrix(CLEAN.R).as_quat()[:, [3, 0, 1, 2]]).as_matrix()
    said = refused(replace(CLEAN, q=joints(CLEAN.q), R=scalar_first))
    assert words in said
    assert "quaternions look like w x y z" in said


@pytest.mark.slow
def test_no_joint_is_blamed_where_orientations_agree_with_it_as_it_is() -> None:
    q = CLEAN.q * np.where(np.arange(6) == 2, -1.0, 1.0)
    said = refused(replace(CLEAN, reading=WORLD.world.tool_in_tracker(q)[:, :3, 3]))
    assert "elbow_joint" not in said


@pytest.mark.slow
def test_millimetres_and_a_joint_are_both_named() -> None:
    said = refused(replace(CLEAN, q=swapped(CLEAN.q), reading=1e3 * CLEAN.reading))
    assert "positions look like millimetres" in said
    assert "joints shoulder_lift_joint and elbow_joint look swapped" in said
    assert "record metres" in said
    assert "correct the names in joint_states" in said


@pytest.mark.slow
def test_mirrored_points_and_a_joint_are_both_named() -> None:
    points = record(12, 60, "point").samples
    said = refused(replace(points, q=swapped(points.q), reading=points.reading * [1.0, -1.0, 1.0]))
    assert "positions look mirrored" in said
    assert "joints shoulder_lift_joint and elbow_joint look swapped" in said
