"""What is left that has two values is named with what has them; scatter, waves and outliers are not two values."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, Recorded, record, samples_of, ur10

from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples

CHAIN = ur10()
BIT = 2.0 * np.pi / 4096.0


@pytest.fixture(scope="module")
def made() -> Recorded:
    return record(31, 120)


def said(samples: Samples) -> str:
    report = calibrate(samples, CHAIN, np.random.default_rng(0), look_for_effects=False).report
    return " ".join(s for s in report.judged.open_because if "two groups" in s)


def bent(made: Recorded, q: Array, tool: Array | None = None) -> Samples:
    """What is read of an arm that stands at q and reports other positions, its tool moved by twists (N, 6)."""
    T = made.world.tool_in_tracker(q)
    T = T if tool is None else T @ se3.exp(tool)
    noise = made.samples.reading - made.exact.reading
    seen = samples_of(CHAIN, made.samples.q, T)
    return replace(seen, reading=seen.reading + noise)


@pytest.mark.slow
def test_a_bit_that_an_encoder_lost(made: Recorded) -> None:
    """The reported position lacks the bit; the arm stands where it stands."""
    samples = made.samples
    q = samples.q.copy()
    q[:, 2] -= BIT * (np.floor(q[:, 2] / BIT) % 2.0)
    text = said(replace(samples, q=q))
    assert "joint elbow_joint had two positions" in text
    assert "1/4096 of a turn" in text


@pytest.mark.slow
def test_a_tracker_that_looks_with_either_face(made: Recorded) -> None:
    face = np.random.default_rng(1).choice([-1.0, 1.0], 120)[:, None]
    shifted = made.samples.reading + 3e-4 * face * [0.6, -0.8, 0.0]
    text = said(replace(made.samples, reading=shifted))
    assert "the tracker, in its positions, had two positions" in text
    apart = re.search(r"([0-9.]+) mm apart", text)
    assert apart is not None
    assert float(apart[1]) == pytest.approx(0.6, rel=0.1)  # the geometry takes up a part


@pytest.mark.slow
def test_two_groups_far_apart_keep_their_distance(made: Recorded) -> None:
    """A frozen model, of which nearly half of the readings stand 5 mm beside the others."""
    calibration = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    beside = np.where(np.arange(120) % 9 < 4, 5e-3, 0.0)[:, None] * [0.6, -0.8, 0.0]
    samples = replace(made.samples, reading=made.samples.reading + beside)
    judged = evaluate(calibration, samples, np.random.default_rng(0)).judged
    apart = re.search(r"([0-9.]+) mm apart", " ".join(judged.open_because))
    assert apart is not None
    assert float(apart[1]) == pytest.approx(5.0, rel=0.1)


@pytest.mark.slow
def test_a_target_that_sits_in_one_of_two_places(made: Recorded) -> None:
    seat = np.random.default_rng(2).random(120) < 0.4
    step = np.where(seat[:, None], [4e-4, 0.0, 3e-4, 8e-4, 0.0, 0.0], 0.0)
    assert "the tool (or the target on it) had two positions" in said(bent(made, made.samples.q, step))


@pytest.mark.slow
def test_one_of_two_targets_seen_by_points(made: Recorded) -> None:
    other = np.arange(120) % 3 == 2
    step = np.where(other[:, None], [4e-4, 0.0, 3e-4, 0.0, 0.0, 0.0], 0.0)
    seen = bent(made, made.samples.q, step)
    points = replace(seen, kind=np.full(120, "point"), R=np.broadcast_to(np.eye(3), seen.R.shape))
    assert "the tool (or the target on it) had two positions" in said(points)


@pytest.mark.slow
@pytest.mark.parametrize("off", ["normal", "uniform", "wave", "outliers"])
def test_what_has_more_values_than_two_is_not_split(made: Recorded, off: str) -> None:
    rng, q = np.random.default_rng(3), made.samples.q.copy()
    if off == "normal":
        q[:, 2] += 5e-4 * rng.normal(size=120)
    elif off == "uniform":
        q[:, 2] += 1e-3 * rng.uniform(-1.0, 1.0, 120)
    elif off == "wave":
        q[:, 2] += 8e-4 * np.sin(37.0 * q[:, 2])
    else:
        q[:, 2] += 5e-4 * rng.standard_t(2.0, 120)
    assert said(bent(made, q)) == ""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("pose", 0), ("point", 1)])
def test_nothing_is_split_on_clean_arms(seed: int, kind: str) -> None:
    assert said(record(40 + seed, 40, kind).samples) == ""


@pytest.mark.slow
def test_a_joint_that_was_mastered_again_is_not_two_trackers(made: Recorded) -> None:
    """Stations on two sides of the arm, which its new zero moves apart."""
    calibration = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    rng = np.random.default_rng(3)
    q = np.array([0.0, -1.5, 0.3, -0.5, 1.4, 0.3]) + 0.15 * rng.standard_normal((120, 6))
    q[:, 0] += rng.choice([-1.5, 1.5], 120)
    q[:, 3:] += rng.uniform(-1.5, 1.5, (120, 3))
    T = made.world.tool_in_tracker(q + 4e-3 * (np.arange(6) == 1))
    T[:, :3, 3] += NOISE_M * rng.standard_normal((120, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((120, 3)))
    judged = evaluate(calibration, samples_of(CHAIN, q, T), np.random.default_rng(0)).judged
    assert judged.status == "open"
    assert not any("two groups" in s for s in judged.open_because)
