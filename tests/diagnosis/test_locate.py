"""What a frozen model leaves over is placed: a joint that was adjusted since, a base that moved; noise is not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cells import ur10
from deltas import record_delta
from verdict.visits import visited

from modcal_core.calibration.store import Calibration
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.contents import Outcome


@cache
def calibration() -> Calibration:
    return calibrate(visited(3, 100), ur10(), np.random.default_rng(0), look_for_effects=False).calibration


def scored(samples: Samples) -> Outcome:
    return evaluate(calibration(), samples, np.random.default_rng(0))


def moved(samples: Samples, step: Array) -> Samples:
    T = step @ se3.transform(samples.R, samples.reading)
    return replace(samples, R=T[:, :3, :3], reading=T[:, :3, 3])


@pytest.mark.slow
def test_a_joint_that_was_adjusted_is_named() -> None:
    second = visited(3, 60)
    q = second.q.copy()
    q[:, 2] += 5e-4
    report = scored(replace(second, q=q))
    assert report.status == "open"
    assert report.left is not None
    assert (report.left.effect.place, report.left.effect.public_driver) == ("elbow_joint", "constant")


@pytest.mark.slow
@pytest.mark.parametrize("size", [50.0])
def test_a_base_that_moved_is_named(size: float) -> None:
    report = scored(moved(visited(3, 60), se3.exp(size * np.array([3e-4, -2e-4, 2e-4, 1e-4, 2e-4, -2e-4]))))
    assert report.status == "open"
    assert report.left is not None
    assert report.left.effect.place == "base"


def test_where_nothing_has_changed_nothing_is_named() -> None:
    report = scored(visited(3, 60))
    assert report.status != "open"
    assert report.left is None


@pytest.mark.slow
def test_geometry_alone_names_what_it_did_not_look_for() -> None:
    samples = visited(4, 120)
    q = samples.q.copy()
    q[:, 1] += 4e-4 * np.sin(3.0 * q[:, 1])
    report = calibrate(replace(samples, q=q), ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.status == "open"
    assert report.left is not None
    assert report.left.effect.place == "shoulder_lift_joint"


@pytest.mark.slow
def test_a_delta_whose_drive_was_adjusted_is_open_for_a_constant_error() -> None:
    told = record_delta(1, 70)
    known = calibrate(told.samples, told.nominal, np.random.default_rng(0), look_for_effects=False).calibration
    q = told.samples.q.copy()
    q[:, 1] += 1e-3
    report = evaluate(known, replace(told.samples, q=q), np.random.default_rng(0))
    assert report.status == "open"
    assert report.left is not None
    assert report.left.effect.public_driver == "constant"


@pytest.mark.slow
@pytest.mark.parametrize("again", [False, True])
def test_an_effect_that_has_grown_is_named_beside_base_and_tool_that_are_found_again(again: bool) -> None:
    """The columns of what the calibration knows hide nothing, and base and tool explain nothing that they took up."""

    def worn(size: float, seed: int) -> Samples:
        samples = visited(seed, 100)
        off = samples.q.copy()
        off[:, 1] += size * np.sin(3.0 * off[:, 1])
        return replace(samples, q=off)

    known = calibrate(worn(4e-4, 4), ur10(), np.random.default_rng(0)).calibration
    assert any(effect.place == "shoulder_lift_joint" for effect in known.calibrated.effects)
    report = evaluate(known, worn(8e-4, 4), np.random.default_rng(0), refit_base=again, refit_tool=again)
    assert report.status == "open"
    assert report.left is not None
    assert report.left.effect.place == "shoulder_lift_joint"
    assert "as an error of joint shoulder_lift_joint" in " ".join(report.open_because)
