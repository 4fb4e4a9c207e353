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
from modcal_core.hypotheses.computed_part import computed_in_part
from modcal_core.hypotheses.hypothesis import Disagreement
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples

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
    rng = np.random.default_rng(0)
    order = rng.permutation(80)
    shuffled = replace(clean, reading=clean.reading[order], R=clean.R[order])
    points = replace(shuffled, kind=np.full(80, "point"), R=np.broadcast_to(np.eye(3), clean.R.shape))
    one_posture, few = clean.select(np.zeros(80, int)), clean.select(np.arange(15))
    for samples in (clean, shuffled, points, one_posture, few):
        assert disagreement(samples, CHAIN) is None
        assert computed_in_part(samples, CHAIN) == ()
    random = disagreement(replace(clean, R=Rotation.random(80, rng=rng).as_matrix()), CHAIN)
    assert random is not None
    assert random.what == "positions correlate with the posture and orientations do not"


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
def test_a_joint_that_was_never_reported(clean: Samples) -> None:
    never = found(with_joint(clean, ELBOW, np.zeros(80))).what
    assert "joint elbow_joint is reported as standing still" in never


@pytest.mark.slow
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


def test_a_target_of_its_own_in_each_frame_is_named_in_the_refusal(clean: Samples) -> None:
    frame = np.arange(80) % 2
    offset = frame[:, None] * [0.2, 0.1, 0.0]
    points = record(11, 80, "point").samples
    reading = points.reading + (clean.R @ offset[..., None])[..., 0]
    two = replace(points, reading=reading, frame=frame, frames=("a", "b"))
    with pytest.raises(BadRecording, match="frames a, b: agree with the arm one by one, not together"):
        calibrate(two, CHAIN, np.random.default_rng(0), look_for_effects=False)


def test_points_in_millimetres_for_a_part() -> None:
    points = record(12, 80, "point").samples
    said = found(replace(points, reading=points.reading * np.where(LATER, 1e3, 1.0)[:, None]))
    assert "millimetres at stations 45 to 79" in said.what


def test_positions_along_the_axes_of_the_tool_in_a_part(clean: Samples) -> None:
    own = (np.swapaxes(clean.R, 1, 2) @ clean.reading[..., None])[..., 0]
    said = found(replace(clean, reading=np.where(LATER[:, None], own, clean.reading))).what
    assert said.startswith("positions look as if they were given along the axes of the tool")
    assert "at stations 45 to 79" in said


@pytest.mark.slow
def test_three_joints_that_are_reversed_in_a_part(clean: Samples) -> None:
    q = clean.q.copy()
    q[np.ix_(LATER, [0, 2, 3])] *= -1.0
    said = found(replace(clean, q=q)).what
    assert all(CHAIN.names[j] in said for j in (0, 2, 3))
    assert "look reversed at stations 45 to 79" in said


@pytest.mark.slow
def test_a_stale_joint_seen_by_points(clean: Samples) -> None:
    points = replace(clean, kind=np.full(80, "point"), R=np.broadcast_to(np.eye(3), clean.R.shape))
    said = found(with_joint(points, ELBOW, np.where(LATER, clean.q[45, ELBOW], clean.q[:, ELBOW]))).what
    assert said.startswith(f"joint {CHAIN.names[ELBOW]} keeps its reported position at stations 4")


def test_joints_that_are_wrong_throughout(clean: Samples) -> None:
    q = clean.q.copy()
    q[:, [1, 2]] = q[:, [2, 1]]
    points = replace(clean, q=q, kind=np.full(80, "point"), R=np.broadcast_to(np.eye(3), clean.R.shape))
    assert found(points).what == f"joints {CHAIN.names[1]} and {CHAIN.names[2]} look swapped"


@pytest.mark.slow
def test_a_joint_of_another_arm_and_a_coupled_one_seen_by_points(clean: Samples) -> None:
    points = replace(clean, kind=np.full(80, "point"), R=np.broadcast_to(np.eye(3), clean.R.shape))
    other = np.random.default_rng(2).permutation(clean.q[:, ELBOW])
    said = found(with_joint(points, ELBOW, other)).what
    assert said == f"joint {CHAIN.names[ELBOW]} was not where it was reported"
    coupled = with_joint(points, ELBOW, clean.q[:, ELBOW] + clean.q[:, 1])
    known = disagreement(coupled, CHAIN)
    assert known is not None
    assert known.what.startswith(f"joint {CHAIN.names[ELBOW]} looks counted together with {CHAIN.names[1]}")


@pytest.mark.slow
def test_readings_that_move_on_while_the_joints_stand_are_named_in_the_refusal(clean: Samples) -> None:
    order = np.random.default_rng(3).permutation(80)
    late = replace(clean, reading=clean.reading[order], R=clean.R[order], sigma_position=np.full(80, 0.15))
    with pytest.raises(BadRecording, match="readings: go on moving while the joints stand still, by 150 mm"):
        calibrate(late, CHAIN, np.random.default_rng(0), look_for_effects=False)


@pytest.mark.slow
def test_two_joints_of_a_part(clean: Samples) -> None:
    half = len(clean) // 2
    q = clean.q.copy()
    q[half:, 3:5] = q[half, 3:5]
    said = found(replace(clean, q=q)).what
    assert f"joints {CHAIN.names[3]} and {CHAIN.names[4]} keep their reported positions at stations" in said


@pytest.mark.slow
def test_orientations_of_a_part_that_are_turned_and_a_part_in_another_unit(clean: Samples) -> None:
    some = np.arange(len(clean)) % 5 < 2
    flip = Rotation.from_rotvec([0.0, 0.0, np.pi]).as_matrix()
    for R, of in ((flip @ clean.R, "the tracker"), (clean.R @ flip, "the tool")):
        found = disagreement(replace(clean, R=np.where(some[:, None, None], R, clean.R)), CHAIN)
        assert found is not None
        assert "orientations look turned by 180° about" in found.what or "orientations look turned by 179" in found.what
        assert f"of {of} at {some.sum()} of {len(clean)} stations" in found.what
    inches = np.where(some[:, None], clean.reading / 0.0254, clean.reading)
    found = disagreement(replace(clean, reading=inches), CHAIN)
    assert found is not None
    assert "times as long as the others, in another unit (inches)" in found.what
