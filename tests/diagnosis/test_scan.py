"""What is left is traced to its place and driver; a clean arm comes out clean.

The truth is MuJoCo's: effects are put into the joint angles or the tool that MuJoCo is given, with joints that do not
repeat, so that noise is far from white at the tool.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from cells import record, samples_of, ur10
from cli.recordings import streams

from modcal_core.diagnosis.scan import Finding, independent_unit
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.prepare import prepare
from modcal_core.report.report import Report, to_json_data

REPEATABILITY = 3e-5  # rad
COUNT = 160


def report_of(seed: int, effect: Callable[[Array], Array], kind: str = "pose", tool: Array | None = None) -> Report:
    """A calibration of an arm whose joints are off by effect(q), and whose tool has moved by these twists (N, 6)."""
    made = record(seed, COUNT, kind)
    rng = np.random.default_rng(seed + 77)
    q = made.samples.q
    T = made.world.tool_in_tracker(q + effect(q) + REPEATABILITY * rng.standard_normal(q.shape))
    if tool is not None:
        T = T @ se3.exp(tool)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((COUNT, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(5e-5 * rng.standard_normal((COUNT, 3)))
    return calibrate(samples_of(ur10(), q, T, kind), ur10(), np.random.default_rng(seed)).report


def at_joint(joint: int, size: Callable[[Array], Array]) -> Callable[[Array], Array]:
    def effect(q: Array) -> Array:
        out = np.zeros_like(q)
        out[:, joint] = size(q)
        return out

    return effect


def nothing(q: Array) -> Array:
    return np.zeros_like(q)


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_clean_arms_come_out_clean(kind: str) -> None:
    """One in two hundred may be wrong; of these twelve none is."""
    found = [report_of(seed, nothing, kind).left for seed in range(12)]
    assert found == [None] * 12


EFFECTS: dict[str, tuple[Callable[[Array], Array], str, str]] = {
    "gear of the elbow, 101 a turn": (
        at_joint(2, lambda q: 2e-4 * np.sin(101 * q[:, 2] + 0.3)), "elbow_joint", "position:elbow_joint"
    ),
    "encoder of the base, once a turn": (
        at_joint(0, lambda q: 3e-4 * np.sin(q[:, 0] + 1.0)), "shoulder_pan_joint", "position:shoulder_pan_joint"
    ),
    "a triangular wave, which is in no vocabulary": (
        at_joint(1, lambda q: 3e-4 * (2 / np.pi) * np.arcsin(np.sin(20 * q[:, 1]))),
        "shoulder_lift_joint", "position:shoulder_lift_joint",
    ),
    "wrist coupling": (at_joint(4, lambda q: 4e-4 * np.sin(q[:, 3])), "wrist_2_joint", "position:wrist_1_joint"),
}  # fmt: skip


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_planted_effects_are_traced(name: str, seed: int) -> None:
    effect, place, driver = EFFECTS[name]
    found = report_of(seed, effect).left
    assert found is not None
    said = [f"{found.place} {found.direction} by {found.driver}", *found.same_as]
    assert f"{place} axis by {driver}" in said
    if "101" in name:
        assert found.cycles == pytest.approx(101, abs=1)


def test_a_drifting_tool_is_traced_to_time() -> None:
    drift = np.linspace(0.0, 1.0, COUNT)[:, None] * np.array([0.0, 0.0, 4e-4, 0.0, 0.0, 0.0])
    found = report_of(4, nothing, tool=drift).left
    assert found is not None
    assert (found.place, found.driver) == ("tool", "time")


def test_what_is_found_is_reported() -> None:
    effect, place, driver = EFFECTS["gear of the elbow, 101 a turn"]
    report = report_of(1, effect)
    data = to_json_data(report)["unexplained"]
    assert (data["place"], data["driver"], data["cycles_per_turn"]) == (place, driver, 101.0)
    assert 0.0 < data["p_value"] <= 0.005
    assert 0.03 < data["found_mm"] < 0.2
    assert "elbow_joint (axis)" in report.verdict
    assert to_json_data(report_of(1, nothing))["unexplained"] is None


def test_noise_of_a_motion_has_a_memory() -> None:
    samples = prepare(streams(10, dwell=0.0), ur10()).samples
    units = len(np.unique(independent_unit(samples)))
    assert units == pytest.approx(np.ptp(samples.stamps) / 0.5, abs=2)
    still = record(1, 30).samples
    assert len(np.unique(independent_unit(still))) == 30


def test_a_clean_motion_comes_out_clean() -> None:
    samples = prepare(streams(60, dwell=0.0), ur10()).samples
    found: Finding | None = calibrate(samples, ur10(), np.random.default_rng(0)).report.left
    assert found is None
