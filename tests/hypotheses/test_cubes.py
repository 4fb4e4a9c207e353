"""A mistake is named where undoing it explains the whole recording, not one half of it."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import ur10
from scipy.spatial.transform import Rotation

from modcal_core.geometry import se3
from modcal_core.hypotheses.hand_eye import HandEye
from modcal_core.hypotheses.search import explain
from modcal_core.measurements.samples import Samples

CUBES = Path(__file__).resolve().parents[3] / "shared" / "data" / "ipa_ur10" / "series_d_iso_cubes.csv"
pytestmark = pytest.mark.skipif(not CUBES.is_file(), reason="recordings of real arms are not beside this checkout")


WORDS = "quaternions look like w x y z read as x y z w at stations 106 to 211, and not at the others"


def cubes() -> Samples:
    """Every third ten stations of a UR10 whose tool hardly turns."""
    with CUBES.open(encoding="utf-8") as stream:
        rows = [row for i, row in enumerate(csv.DictReader(stream, delimiter=";")) if (i // 10) % 3 == 0]

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name].replace(",", ".")) for name in names] for row in rows])

    R = Rotation.from_euler("XYZ", columns(*(f"measurement_r{a}" for a in "xyz")), degrees=True).as_matrix()
    p = 1e-3 * columns(*(f"measurement_{a}" for a in "xyz"))
    names = ur10().names
    return Samples.from_arrays(columns(*names), poses=se3.transform(R, p), names=names)


def named(samples: Samples) -> str:
    case = HandEye.of(samples, ur10())
    assert case is not None
    return explain(case).what


def test_quaternions_of_another_order_in_one_half_are_named_and_no_joint() -> None:
    """Their target is near the last axis: reversed, that joint leaves positions as they are, and fits the other half."""
    seen = cubes()
    later = np.arange(len(seen)) >= len(seen) // 2
    other = Rotation.from_quat(Rotation.from_matrix(seen.R).as_quat()[:, [3, 0, 1, 2]]).as_matrix()
    assert named(replace(seen, R=np.where(later[:, None, None], other, seen.R))) == WORDS


def test_a_joint_that_is_wrong_throughout_is_named() -> None:
    seen = cubes()
    assert named(replace(seen, q=seen.q * np.array([1, 1, -1, 1, 1, 1]))) == "joint elbow_joint looks reversed"
