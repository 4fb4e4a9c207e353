"""Conventions proved by likelihood: what is written otherwise than read is refused by name, and what is right passes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import record, samples_of, ur10
from scipy.spatial.transform import Rotation

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.placing import Known
from modcal_core.errors import BadRecording
from modcal_core.evaluation import evaluate
from modcal_core.files import read_yaml
from modcal_core.geometry import se3, so3
from modcal_core.hypotheses.computed_part import computed_in_part
from modcal_core.hypotheses.hand_eye import HandEye
from modcal_core.hypotheses.meant import INVERTED, proved
from modcal_core.hypotheses.search import explain
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples, cut_stations
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import forward
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.tables import import_tables

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
CHAIN = ur10()


def composed(samples: Samples, meant: str, by: str) -> Samples:
    """Orientations whose angles were written down as one sequence and put together as another."""
    angles = Rotation.from_matrix(samples.R).as_euler(meant)
    return replace(samples, R=Rotation.from_euler(by, angles).as_matrix())


def quaternions(samples: Samples, columns: list[int]) -> Samples:
    return replace(samples, R=Rotation.from_quat(Rotation.from_matrix(samples.R).as_quat()[:, columns]).as_matrix())


def inverted(samples: Samples) -> Samples:
    T = np.linalg.inv(se3.transform(samples.R, samples.reading))
    return replace(samples, R=T[:, :3, :3], reading=T[:, :3, 3])


MISTAKES: dict[str, tuple[Callable[[Samples], Samples], str]] = {
    "wxyz": (lambda s: quaternions(s, [3, 0, 1, 2]), "quaternions look like w x y z read as x y z w"),
    "xyzw": (lambda s: quaternions(s, [1, 2, 3, 0]), "quaternions look like x y z w read as w x y z"),
    "conjugate": (lambda s: replace(s, R=np.swapaxes(s.R, 1, 2)), "orientations look inverse"),
    "ZYZ by ZYX": (lambda s: composed(s, "ZYZ", "ZYX"), "Euler angles composed as"),
    "radians as degrees": (
        lambda s: replace(
            s, R=Rotation.from_euler("xyz", np.radians(Rotation.from_matrix(s.R).as_euler("xyz"))).as_matrix()
        ),
        "look like radians read as degrees",
    ),
    "metres as millimetres": (lambda s: replace(s, reading=1e-3 * s.reading), "positions look like metres taken"),
    "joints converted twice": (lambda s: replace(s, q=np.radians(s.q)), "converted to radians twice"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_refused_and_named(mistake: str) -> None:
    spoil, said = MISTAKES[mistake]
    with pytest.raises(BadRecording, match=said):
        proved(spoil(record(1, 60).samples), CHAIN)


def test_an_inverse_pose_is_undone() -> None:
    samples = record(2, 60).samples
    undone, convention = proved(inverted(samples), CHAIN)
    assert convention == INVERTED
    assert np.allclose(undone.reading, samples.reading, atol=1e-9)
    assert np.allclose(undone.R, samples.R, atol=1e-9)


def test_three_postures_prove_nothing_however_often_they_are_read() -> None:
    """Three poses of a wrong arm may well fit an inverse better; sixty readings of them are no sixty witnesses."""
    samples = record(2, 40).samples
    few = samples.select(np.repeat(np.arange(3), 20))
    few = replace(few, station=np.arange(60), stamps=1.7e9 + 2.0 * np.arange(60))
    same, undone = proved(few, CHAIN)
    assert undone is None
    np.testing.assert_array_equal(same.R, few.R)
    # thirty of them are
    many = samples.select(np.repeat(np.arange(30), 3))
    many = replace(many, station=np.arange(90), stamps=1.7e9 + 2.0 * np.arange(90))
    assert proved(inverted(many), CHAIN)[1] == INVERTED


def test_stated_places_that_are_wrong_are_named_and_no_joint() -> None:
    """A tracker that is stated to stand a metre from where it stands once got a joint called coupled."""
    made = record(4, 60)
    T = made.world.T_tracker_base.copy()
    known = Known("tracker", "base", T, (2e-3, 2e-3))
    calibrate(made.samples, CHAIN, np.random.default_rng(0), Cell(known=(known,)), look_for_effects=False)
    T[:3, 3] += [0.8, -0.5, 0.3]
    wrong = Cell(known=(replace(known, T_frame_to=T),))
    with pytest.raises(BadRecording, match="places of frames that are stated .* it does not without them"):
        calibrate(made.samples, CHAIN, np.random.default_rng(0), wrong, look_for_effects=False)


@pytest.mark.parametrize("size", [1.0, 20.0])
def test_a_wrong_arm_is_not_a_wrong_convention(size: float) -> None:
    """A robot as far off its drawing as none is built: 10 mm and 20 mrad at every link."""
    samples = record(3, 60, length_std=5e-4 * size, angle_std=1e-3 * size).samples
    assert proved(samples, CHAIN) == (samples, None)


def retooled(samples: Samples, first: int, last: int, twist: np.ndarray) -> Samples:
    T = se3.transform(samples.R, samples.reading)
    T[first:last] = T[first:last] @ se3.exp(twist)
    return replace(samples, R=T[:, :3, :3], reading=T[:, :3, 3])


def test_another_tool_is_not_a_wrong_convention() -> None:
    samples = record(4, 120).samples
    for first, last, turn in ((60, 120, 0.1), (0, 15, 2.0), (50, 90, 2.0)):
        changed = retooled(samples, first, last, np.array([0.03, 0.02, 0.0, 0.0, turn, 0.0]))
        assert proved(changed, CHAIN)[1] is None
    changed = retooled(composed(samples, "XYZ", "xyz"), 60, 120, np.array([0.03, 0.02, 0.0, 0.0, 0.1, 0.0]))
    with pytest.raises(BadRecording, match="Euler angles"):
        proved(changed, CHAIN)


def test_readings_that_fit_nothing_are_given_no_name() -> None:
    """Neither nonsense in the orientations, nor readings of other postures, look like a convention."""
    rng = np.random.default_rng(0)
    samples = record(5, 60).samples
    assert proved(replace(samples, R=so3.exp(2.0 * rng.normal(size=(60, 3)))), CHAIN)[1] is None
    assert proved(replace(samples, q=rng.permutation(samples.q)), CHAIN)[1] is None


def test_calibrate_undoes_an_inverse_pose_and_evaluate_refuses_quaternions() -> None:
    made = record(6, 80)
    result = calibrate(inverted(made.samples), CHAIN, np.random.default_rng(0), look_for_effects=False)
    assert result.report.size_mm("final").rms < 0.2
    assert result.report.grounds.convention == INVERTED
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, (30, 6))
    again = samples_of(CHAIN, q, made.world.tool_in_tracker(q))
    with pytest.raises(BadRecording, match="w x y z"):
        evaluate(result.calibration, quaternions(again, [3, 0, 1, 2]), np.random.default_rng(0))
    assert evaluate(result.calibration, inverted(again), np.random.default_rng(0)).grounds.convention == INVERTED


def real(shared_data: Path, series: str, **change: object) -> tuple[Samples, Chain]:
    mapping = read_yaml(ROOT / "examples" / "import" / f"ipa_ur10_series_{series}.yaml")
    for table in mapping["tables"]:
        table["pose"]["inverse"] = change.get("inverse", False)
        table["pose"]["euler"]["sequence"] = change.get("sequence", "XYZ")
    recording = import_tables(mapping, shared_data, "mapping")
    chain = read_chain((ROOT / "examples" / "robots" / "ur10.urdf").read_text(), None, None)
    return cut_stations(recording, chain.names), chain


def test_real_cubes(shared_data: Path) -> None:
    """UR10 whose target hardly turns: orientations alone tell little, together with positions they do."""
    samples, chain = real(shared_data, "d")
    assert proved(samples, chain)[1] is None
    for sequence in ("xyz", "XZY"):
        with pytest.raises(BadRecording, match="XYZ"):
            proved(real(shared_data, "d", sequence=sequence)[0], chain)
    with pytest.raises(BadRecording, match="w x y z"):
        proved(quaternions(samples, [3, 0, 1, 2]), chain)
    assert proved(real(shared_data, "d", inverse=True)[0], chain)[1] == INVERTED


def test_real_grid(shared_data: Path) -> None:
    samples, chain = real(shared_data, "a")
    assert proved(samples, chain)[1] is None
    with pytest.raises(BadRecording, match="w x y z"):
        proved(quaternions(samples, [3, 0, 1, 2]), chain)


def test_what_is_wrong_in_one_half_of_real_cubes_is_not_said_of_a_joint(shared_data: Path) -> None:
    """Their target is near the last axis: reversed, that joint leaves positions as they are, and fits the other half."""
    every, chain = real(shared_data, "d")
    part = every.select(np.flatnonzero(np.arange(len(every)) // 10 % 3 == 0))
    seen = Samples.from_arrays(part.q, poses=se3.transform(part.R, part.reading), names=part.names)
    later = np.arange(len(seen)) >= len(seen) // 2
    half = replace(seen, R=np.where(later[:, None, None], quaternions(seen, [3, 0, 1, 2]).R, seen.R))
    said = "quaternions look like w x y z read as x y z w at stations 106 to 211, and not at the others"
    for samples, words in (
        (half, said), (replace(seen, q=seen.q * [1, 1, -1, 1, 1, 1]), "joint elbow_joint looks reversed"),
    ):  # fmt: skip
        case = HandEye.of(samples, chain)
        assert explain(case).what == words


BASE = se3.exp([1.0, 0.4, 0.2, 0.1, -0.3, 2.0])
CLEAN = record(11, 80).samples


@pytest.mark.parametrize("rows", [np.arange(20, 40), np.arange(0, 80, 4)])
def test_poses_that_the_controller_filled_in(rows: np.ndarray) -> None:
    """With any base and tool; a micrometre more than instruments resolve is a measurement again."""
    T = BASE @ forward(CHAIN, CLEAN.q[rows]) @ se3.exp([0.02, 0.05, 0.1, 0.4, 0.1, 0.0])
    reading, R = CLEAN.reading.copy(), CLEAN.R.copy()
    reading[rows], R[rows] = T[:, :3, 3], T[:, :3, :3]
    filled = replace(CLEAN, reading=reading, R=R)
    (said,) = computed_in_part(filled, CHAIN)
    assert "20 of 80 stations" in said
    assert "computed from the joints" in said
    reading[rows] += np.random.default_rng(2).normal(0.0, 2e-5, (20, 3))
    assert computed_in_part(replace(filled, reading=reading), CHAIN) == ()


def test_points_that_the_controller_filled_in_while_the_target_was_hidden() -> None:
    rows = np.arange(30, 62)
    reading = CLEAN.reading.copy()
    reading[rows] = se3.apply(BASE @ forward(CHAIN, CLEAN.q[rows]), np.ones(3) / 9)
    points = replace(CLEAN, reading=reading, kind=np.full(80, "point", CLEAN.kind.dtype))
    (said,) = computed_in_part(points, CHAIN)
    assert "stations 30 to 61" in said


def test_nothing_is_said_of_measured_readings() -> None:
    for samples in (CLEAN, CLEAN.select(np.zeros(80, int)), CLEAN.select(np.arange(15))):
        assert computed_in_part(samples, CHAIN) == ()
