"""Where only a part of a recording agrees with the robot, the rest is named: by convention, base, tool or joint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.plausibility.consistency import Disagreement, disagreement

CHAIN = ur10()
LATER = np.arange(80) >= 45
ELBOW = 2


@pytest.fixture(scope="module")
def clean() -> Samples:
    return record(11, 80).samples


def found(samples: Samples) -> Disagreement:
    out = disagreement(samples, CHAIN)
    assert out is not None
    return out


def with_joint(samples: Samples, j: int, column: Array) -> Samples:
    q = samples.q.copy()
    q[:, j] = column
    return replace(samples, q=q)


def placed(samples: Samples, T: Array, rows: np.ndarray) -> Samples:
    """Readings (4, 4) that are others at some rows."""
    position = np.where(rows[:, None], T[:, :3, 3], samples.reading)
    return replace(samples, reading=position, R=np.where(rows[:, None, None], T[:, :3, :3], samples.R))


@pytest.mark.slow
def test_nothing_is_said_of_a_clean_recording_and_of_nonsense(clean: Samples) -> None:
    assert disagreement(clean, CHAIN) is None
    rng = np.random.default_rng(0)
    assert disagreement(replace(clean, R=Rotation.random(80, rng=rng).as_matrix()), CHAIN) is None
    assert disagreement(clean.select(np.zeros(80, int)), CHAIN) is None


def test_a_joint_is_not_blamed_for_what_only_makes_the_whole_worse(clean: Samples) -> None:
    """Positions that scatter by more than an arm's: the joint would stand where it is reported."""
    noise = 0.02 * np.random.default_rng(1).normal(size=(80, 3))
    assert disagreement(replace(clean, reading=clean.reading + noise), CHAIN) is None


def test_another_order_of_quaternions_from_some_station_on(clean: Samples) -> None:
    wrong = Rotation.from_quat(Rotation.from_matrix(clean.R).as_quat()[:, [3, 0, 1, 2]]).as_matrix()
    said = found(replace(clean, R=np.where(LATER[:, None, None], wrong, clean.R)))
    assert "w x y z" in said.what
    assert "stations 45 to 79" in said.what
    assert (said.stations, said.of) == (35, 80)


@pytest.mark.slow
def test_two_trackers_and_two_targets_under_one_name(clean: Samples) -> None:
    T = se3.transform(clean.R, clean.reading)
    rows = np.random.default_rng(3).random(80) < 0.4
    away = se3.exp([0.3, -0.2, 0.1, 0.2, 0.1, -0.3])
    assert "base (or the tracker) is displaced" in found(placed(clean, away @ T, rows)).what
    assert "tool (or the target on it) is displaced" in found(placed(clean, T @ away, rows)).what


@pytest.mark.slow
def test_a_joint_that_is_stale_or_was_never_reported(clean: Samples) -> None:
    stale = with_joint(clean, ELBOW, np.where(LATER, clean.q[45, ELBOW], clean.q[:, ELBOW]))
    said = found(stale).what
    assert "joint elbow_joint keeps its reported position at stations 46 to 79" in said
    never = found(with_joint(clean, ELBOW, np.zeros(80))).what
    assert "joint elbow_joint is reported as standing still" in never


@pytest.mark.parametrize(
    ("column", "words"),
    [
        (lambda q: q + 0.5 * np.pi, "reads 90"),
        (lambda q: q / (2.0 * np.pi), "counted in revolutions"),
        (lambda q: 0.7 * q**2, "was not where it was reported"),
    ],
)
def test_a_joint_that_is_off_throughout(clean: Samples, column, words: str) -> None:  # type: ignore[no-untyped-def]
    said = found(with_joint(clean, 3, column(clean.q[:, 3]))).what
    assert "wrist_1_joint" in said
    assert words in said


@pytest.mark.slow
def test_the_refusal_names_it(clean: Samples) -> None:
    with pytest.raises(BadRecording, match="elbow_joint is reported as standing still"):
        calibrate(with_joint(clean, ELBOW, np.zeros(80)), CHAIN, np.random.default_rng(0), look_for_effects=False)


def test_points_in_millimetres_for_a_part() -> None:
    points = record(12, 80, "point").samples
    said = found(replace(points, reading=points.reading * np.where(LATER, 1e3, 1.0)[:, None]))
    assert "millimetres at stations 45 to 79" in said.what
