"""The certificate: its result is that of the tolerance, no doubt is left out; and two calibrations side by side."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cells import record, samples_of, slider_arm, ur10
from report.judged import CANNOT, FLOOR, OPEN
from report.reports import points
from report.test_page import Elements
from scipy.optimize import least_squares

from modcal_core.calibration.noise import Errors
from modcal_core.calibration.stated import Stated
from modcal_core.calibration.store import Calibration
from modcal_core.errors import BadRobot, BadTable, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.outcome import tool_difference
from modcal_core.outcome.contents import Outcome
from modcal_core.report.blocks import text
from modcal_core.report.certificates import (
    Certificate,
    Hashes,
    Particulars,
    certificate,
)
from modcal_core.report.comparison import Side, compare
from modcal_core.report.report import to_json_data
from modcal_core.verdict.iso9283 import CYCLES, POSES, pose_test
from modcal_core.verdict.tolerance import Asked
from modcal_core.verdict.verdict import Reason, Verdict
from modcal_nodes.simulation.mjcf import World

INSTRUMENT = Stated(instrument_mm=0.03)
PREDICTABLE = Verdict("open", (Reason("predictable", "About 20 % can be predicted."),))


def report(judged: Verdict, mm: float = 1.0) -> Outcome:
    """Points whose claim rests on readings alone."""
    made = points()
    assert made.claim is not None
    shown = replace(made.claim, unshown_mm=0.0)
    return replace(made, judged=judged, searched=None, claim=shown).with_tolerance(Asked(mm))


@pytest.mark.parametrize(
    ("judged", "mm", "stated", "heading", "tone"),
    [
        (FLOOR, 1.0, INSTRUMENT, "PASS", "good"),
        (FLOOR, 1.0, Stated(), "PASS, with reservations", "warn"),
        (FLOOR, 1.0, Stated(instrument_mm=0.4), "PASS, with reservations", "warn"),
        (CANNOT, 1.0, INSTRUMENT, "PASS, with reservations", "warn"),
        (PREDICTABLE, 1.0, INSTRUMENT, "PASS, with reservations", "warn"),
        (OPEN, 1.0, INSTRUMENT, "CANNOT TELL", "warn"),
        (FLOOR, 0.001, INSTRUMENT, "FAIL", "bad"),
        (OPEN, 0.001, INSTRUMENT, "FAIL", "bad"),
    ],
)
def test_a_pass_is_calm_only_where_nothing_is_left_in_doubt(
    judged: Verdict, mm: float, stated: Stated, heading: str, tone: str
) -> None:
    one = certificate(report(judged, mm), stated)
    assert (one.heading, one.tone) == (heading, tone)
    assert one.met.result == heading.partition(",")[0]
    if heading != "PASS":
        assert one.reservations or judged is FLOOR
    page = one.html()
    assert all(reason.split("'")[0] in page for reason in one.reservations)


def test_a_tolerance_below_the_floor_is_named_as_what_it_is() -> None:
    one = certificate(report(replace(FLOOR, floor_mm=0.4), 0.001), INSTRUMENT)
    assert one.met.result == "FAIL"
    assert one.reservations[0].startswith("Arm and instrument alone scatter by 0.4 mm RMS, more than the tolerance")
    assert not certificate(report(replace(FLOOR, floor_mm=0.0005), 0.001), INSTRUMENT).reservations


def test_without_a_tolerance_there_is_none() -> None:
    with pytest.raises(BadTable, match="--tolerance-mm"):
        certificate(points())


def test_texts_are_short_enough_for_one_page() -> None:
    with pytest.raises(BadTable, match="certificate: conditions: has 91 characters"):
        Particulars(conditions="x" * 91)


def full() -> Certificate:
    """As much as a certificate can hold."""
    reasons = tuple(Reason("above_floor", f"{k}. " + "The residual correlates with something. " * 6) for k in range(9))
    said = Particulars(**dict.fromkeys(("robot", "serial", "instrument", "conditions"), "Müller ≤ Ω <b> " * 6))
    hashes = Hashes("ab" * 32, "cd" * 32, "ef" * 32)
    return certificate(report(Verdict("open", reasons), 0.001), INSTRUMENT, said, hashes)


def test_the_page_is_well_formed_and_says_what_the_certificate_says() -> None:
    one = full()
    page = one.html()
    found = Elements(page)
    assert not found.unclosed
    assert "://" not in page
    assert "<b> " not in page
    assert all(digest in page for digest in vars(one.hashes).values())
    assert all(a["role"] == "img" and len(a["aria-label"]) > 10 for a in found.of("svg"))
    assert page.count('class="line"') == 2


def test_figures_of_iso_9283_are_those_of_its_definitions() -> None:
    """An offset of 0.1 mm is AP, scatter of a known sequence RP; worked out here from the standard's sums."""
    made = record(2, POSES)
    q = np.tile(made.samples.q, (CYCLES, 1))
    rng = np.random.default_rng(3)
    T = made.world.tool_in_tracker(q)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
    turn = 1e-4 * rng.standard_normal((len(q), 3))
    T[:, :3, :3] = so3.exp(turn) @ T[:, :3, :3]
    samples = samples_of(ur10(), q, T, "pose")
    moved = T.copy()
    moved[:, :3, 3] -= [0.0, 1e-4, 0.0]
    gap = Errors(samples.reading - moved[:, :3, 3], turn)
    test = pose_test(samples, {"nominal": gap, "final": gap})
    assert not test.missing
    assert [p.visits for p in test.poses] == [CYCLES] * POSES
    for k, pose in enumerate(test.poses):
        p = T[k::POSES, :3, 3]
        apart = np.sqrt(((p - p.mean(axis=0)) ** 2).sum(axis=1))
        deviation = np.sqrt(((apart - apart.mean()) ** 2).sum() / (CYCLES - 1))
        assert pose.rp_mm == pytest.approx(1e3 * (apart.mean() + 3.0 * deviation))
        assert pose.ap_mm["final"] == pytest.approx(0.1, rel=1e-6)
        assert pose.ap_deg is not None
        assert pose.rp_deg is not None
        assert pose.ap_deg["final"] == pytest.approx(np.degrees(turn[k::POSES].mean(axis=0)))
        assert pose.rp_deg == pytest.approx(3.0 * np.degrees(turn[k::POSES].std(axis=0, ddof=1)), rel=1e-3)


def test_too_few_visits_or_visits_from_two_sides_give_no_figures() -> None:
    made = record(2, POSES + 1)
    five, away = made.samples.q[:POSES], made.samples.q[POSES:]
    for q, said in (
        (np.tile(five, (CYCLES - 1, 1)), f"5 poses were visited more than once from one side, at most {CYCLES - 1}"),
        (np.tile(five[:2], (CYCLES, 1)), "so often 2 poses were visited here"),
        (made.samples.q, "no scored pose was visited twice"),
    ):
        samples = samples_of(ur10(), q, made.world.tool_in_tracker(q), "point")
        gap = Errors(np.zeros_like(samples.reading), np.empty((0, 3)))
        assert said in pose_test(samples, {"nominal": gap, "final": gap}).missing
    # every second cycle runs the other way round
    cycles = [five if k % 2 else np.r_[away, five[::-1]] for k in range(CYCLES)]
    q = np.concatenate(cycles)
    samples = samples_of(ur10(), q, made.world.tool_in_tracker(q), "point")
    gap = Errors(np.zeros_like(samples.reading), np.empty((0, 3)))
    assert pose_test(samples, {"nominal": gap, "final": gap}).missing


@cache
def world(seed: int) -> World:
    rng = np.random.default_rng(seed)
    return World(
        ur10(), rng, 5e-4, 1e-3, se3.exp([1.0, 0.2, 0.1, 0.3, 0.2, -1.0]), se3.exp([0.05, 0.03, 0.12, 0, 0, 0])
    )


@cache
def session(of: int, seed: int, remounted: bool = False) -> tuple[Calibration, Outcome]:
    """A calibration of an arm; a tracker and a target that stand elsewhere, where remounted."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (60, 6))
    T = world(of).tool_in_tracker(q)
    T[:, :3, 3] += 5e-5 * rng.standard_normal((60, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(5e-5 * rng.standard_normal((60, 3)))
    if remounted:
        T = se3.exp([-0.4, 1.0, 0.2, -0.7, 0.5, 0.9]) @ T @ se3.exp([0.02, -0.05, 0.08, 0.6, -0.4, 1.1])
    found = calibrate(samples_of(ur10(), q, T), ur10(), np.random.default_rng(0), look_for_effects=False)
    return found.calibration, found.report


def side(name: str, of: int, seed: int, remounted: bool = False) -> Side:
    calibration, report = session(of, seed, remounted)
    return Side(name, calibration, to_json_data(report))


@pytest.mark.slow
@pytest.mark.parametrize("remounted", [False, True])
def test_the_same_arm_twice_shows_no_difference(remounted: bool) -> None:
    found = compare(side("a", 1, 10), side("b", 1, 11, remounted), 0.2).data
    assert found["result"] == "same"
    assert found["tool"]["mm"]["rms"] < found["tool"]["expected_rms_mm"] < 0.1
    assert not any(p["shown"] for p in found["parameters"])


@pytest.mark.slow
def test_another_arm_differs_by_as_much_as_the_arms_do() -> None:
    """The size by MuJoCo's poses of both arms, base and tool fitted by a solver of its own."""
    found = compare(side("a", 1, 10), side("b", 2, 11), 0.2).data
    assert found["result"] == "beyond tolerance"
    q = tool_difference(session(1, 10)[0], session(2, 11)[0]).q
    # the worlds' own trackers and targets are the same, so that poses of the tool can be compared
    T, other = (world(k).tool_in_tracker(q) for k in (1, 2))

    def left(x: np.ndarray) -> np.ndarray:
        moved = se3.exp(x[:6]) @ T @ se3.exp(x[6:])
        turn = so3.log(other[:, :3, :3] @ np.swapaxes(moved[:, :3, :3], 1, 2))
        return np.c_[other[:, :3, 3] - moved[:, :3, 3], turn].ravel()

    truth = left(least_squares(left, np.zeros(12)).x).reshape(-1, 6)[:, :3]
    rms = 1e3 * np.sqrt(np.mean(np.sum(truth**2, axis=1)))
    assert found["tool"]["mm"]["rms"] == pytest.approx(rms, rel=0.05)
    assert sum(bool(p["shown"]) for p in found["parameters"]) > 5


def test_reports_alone_are_compared_by_their_intervals() -> None:
    one, other = side("a", 1, 10), side("b", 1, 11)
    worse = {
        **(other.report or {}),
        "error_mm": {"final": {**(one.report or {})["error_mm"]["final"], "rms": 9.0, "rms_ci95": [8, 10]}},
    }
    alone = Side("a", report=one.report)
    assert compare(alone, Side("b", report=one.report)).data["result"] == "same"
    found = compare(alone, Side("b", report=worse))
    assert found.data["result"] == "differs"
    assert found.data["tool"] is None
    assert found.data["verdict"] in text(found.said)
    assert "do not overlap" in text(found.said)


def test_what_cannot_be_compared_is_refused() -> None:
    one = side("a", 1, 10)
    joints = {**(one.report or {}), "recording": {"joints": list(slider_arm().names)}}
    with pytest.raises(BadRobot, match="compare calibrations of one arm"):
        compare(one, Side("b", report=joints))
    with pytest.raises(NotEnoughData, match="holds no error to compare"):
        compare(one, Side("b", report={"modcal_report": 1}))
