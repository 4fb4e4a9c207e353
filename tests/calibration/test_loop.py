"""The main path: three sets that never meet, a score on the one that nothing has seen, frozen scores elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.data_split import split
from modcal_core.errors import BadRecording, BadTable
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3
from modcal_core.loop import calibrate
from modcal_core.report.as_json import to_json_data


@pytest.mark.parametrize("block", [1, 7, None])
def test_the_three_sets_never_meet(block: int | None) -> None:
    samples = record(1, 160).samples
    # two instruments at every station
    both = samples.select(np.r_[np.arange(160), np.arange(160)])
    sets = split(both, np.random.default_rng(3), block)
    stations = [set(both.station[rows]) for rows in (sets.train, sets.explain, sets.held_out)]
    assert sum(len(s) for s in stations) == 160 == len(set.union(*stations))
    assert [len(s) for s in stations] == [80, 32, 48] if block in (1, None) else sets.unit == "block"


def test_a_dense_recording_is_split_by_blocks() -> None:
    samples = record(1, 600).samples
    walk = np.cumsum(0.01 * np.random.default_rng(0).normal(size=(600, 6)), axis=0)
    sets = split(replace(samples, q=walk), np.random.default_rng(0))
    assert sets.unit == "block"
    assert np.mean(np.diff(np.sort(sets.held_out)) == 1) > 0.8


def test_so_few_that_no_effect_is_told_from_noise_are_for_the_geometry() -> None:
    made = record(4, 11, "pose")
    report = calibrate(made.samples, ur10(), np.random.default_rng(0)).report
    assert (len(report.sets.train), len(report.sets.explain), len(report.sets.held_out)) == (8, 0, 3)
    assert not report.searched
    claim = report.claim
    assert claim is not None
    q = made.samples.q[:1] + 0.1 * np.random.default_rng(1).standard_normal((200, 6))
    low, high = made.samples.q.min(axis=0), made.samples.q.max(axis=0)
    shipped = calibrate(made.samples, ur10(), np.random.default_rng(0)).calibration
    q = np.clip(q, low, high)
    gap = shipped.predict(q)[:, :3, 3] - made.world.tool_in_tracker(q)[:, :3, 3]
    assert np.percentile(1e3 * np.linalg.norm(gap, axis=1), 95) < claim.mm["p95"].ci95[1]


@pytest.mark.slow
def test_held_out_error_is_that_of_the_world() -> None:
    made = record(2, 160)
    result = calibrate(made.samples, ur10(), np.random.default_rng(0))
    data = to_json_data(result.report)
    assert data["split"] == {"unit": "station", "train": 80, "explain": 32, "held_out": 48}
    assert data["error_mm"]["nominal"]["rms"] > 10 * data["error_mm"]["final"]["rms"]
    # noise of 0.05 mm an axis, and the scatter of 30 parameters from 80 poses
    assert data["error_mm"]["final"]["rms"] == pytest.approx(0.05 * np.sqrt(3), rel=0.25)
    assert data["identifiability"]["rank"] == 30
    assert data["identifiability"]["unobservable"] == []
    q = np.random.default_rng(4).uniform(-np.pi, np.pi, (200, 6))
    gap = result.calibration.calibrated.predict(q)[:, :3, 3] - made.world.tool_in_tracker(q)[:, :3, 3]
    assert np.sqrt(np.mean(np.sum(gap**2, axis=1))) < 3e-5


@pytest.mark.slow
def test_outliers_are_counted_and_do_not_count() -> None:
    samples = record(3, 160).samples
    position = samples.reading.copy()
    wrong = np.arange(5, 160, 16)
    position[wrong] += 0.01
    report = calibrate(replace(samples, reading=position), ur10(), np.random.default_rng(0)).report
    assert report.rejected == len(wrong)
    size = report.size_mm("final")
    assert size is not None
    assert size.max < 1.0


@pytest.mark.slow
def test_a_moved_base_and_tool_are_found_again() -> None:
    made = record(4, 160)
    calibration = calibrate(made.samples, ur10(), np.random.default_rng(0)).calibration
    rng = np.random.default_rng(9)
    q = rng.uniform(-np.pi, np.pi, (100, 6))
    moved = se3.exp(rng.normal(size=6)) @ made.world.tool_in_tracker(q) @ se3.exp(0.1 * rng.normal(size=6))
    samples = samples_of(ur10(), q, moved, frame="another")
    with pytest.raises(BadTable, match="--refit-base"):
        evaluate(calibration, samples, rng)
    report = evaluate(calibration, samples, rng, refit_base=True, refit_tool=True)
    before, after = report.size_mm("nominal"), report.size_mm("final")
    assert before is not None
    assert after is not None
    assert after.rms < 0.05 < 0.3 < before.rms
    assert report.set_sizes()["held_out"] == 30
    only_base = evaluate(calibration, samples, rng, refit_base=True).size_mm("final")
    assert only_base is not None
    assert only_base.rms > 10.0  # the tool has changed too


@pytest.mark.slow
def test_frozen_without_refit_scores_every_station() -> None:
    made = record(5, 160)
    calibration = calibrate(made.samples, ur10(), np.random.default_rng(0)).calibration
    again = np.random.default_rng(1).uniform(-np.pi, np.pi, (40, 6))
    report = evaluate(
        calibration, samples_of(ur10(), again, made.world.tool_in_tracker(again)), np.random.default_rng(0)
    )
    assert report.set_sizes() == {"train": 0, "explain": 0, "held_out": 40}
    size = report.size_mm("final")
    assert size is not None
    assert size.rms < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "offender"),
    [
        (lambda q: q[:, [0, 2, 1, 3, 4, 5]], "joints shoulder_lift_joint and elbow_joint look swapped"),
        (lambda q: q * [1, 1, -1, 1, 1, 1], "joint elbow_joint looks reversed"),
        (lambda q: q * [1, -1, 1, 1, -1, 1], "joints shoulder_lift_joint and wrist_2_joint look reversed"),
        (lambda q: q[:, [0, 3, 1, 2, 4, 5]], "shoulder_lift_joint, elbow_joint and wrist_1_joint look interchanged"),
        (lambda q: np.degrees(0.03 * q), "joint positions look like degrees"),
        (lambda q: np.roll(q, 1, axis=0), "readings look"),
    ],
)
def test_mistakes_in_pairing_are_named(spoil: object, offender: str) -> None:
    made = record(6, 120)
    q = made.samples.q if "degrees" not in offender else 0.03 * made.samples.q
    T = made.world.tool_in_tracker(q)
    wrong = spoil(made.samples.q)  # type: ignore[operator]
    with pytest.raises(BadRecording, match=offender):
        calibrate(samples_of(ur10(), wrong, T), ur10(), np.random.default_rng(0))


@pytest.mark.slow
def test_the_description_of_a_left_arm_for_a_right_one() -> None:
    """What a mirror shows of the arm is what the arm of the mirrored description does."""
    made = record(6, 80)
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    seen = mirror @ made.world.tool_in_tracker(made.samples.q) @ mirror
    with pytest.raises(BadRecording, match="mirror image of its URDF"):
        calibrate(samples_of(ur10(), made.samples.q, seen), ur10(), np.random.default_rng(0))
