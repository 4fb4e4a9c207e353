"""Base and tool that are moved during a recording, by MuJoCo's truth: what moved, when, and by how much."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.model import place_model
from modcal_core.calibration.noise import errors
from modcal_core.effects.effect import SHIFT, is_move
from modcal_core.effects.families import step
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.moves.regimes import Move, find_regimes, is_possible, moves_of
from tests.cells import NOISE_M, NOISE_RAD, record, samples_of, ur10

COUNT = 160
# first station with it, motion of the tool in itself, motion of the arm's base in the tracker's frame
Moved = tuple[int, Sequence[float], Sequence[float]]
NOT = (0.0,) * 6


def recorded(
    moved: Sequence[Moved],
    kind: str = "pose",
    seed: int = 1,
    order: Callable[[Array], Array] | None = None,
    true: Callable[[Array], Array] = lambda q: q,
    change: Callable[[Array], Array] = lambda T: T,
) -> Samples:
    """Readings of a displaced arm whose tool and base move.

    order: of the postures. true: where the joints are, by what they say. change: of the exact readings.
    """
    world = record(seed, COUNT, kind)
    rng = np.random.default_rng(seed + 100)
    q = world.samples.q if order is None else world.samples.q[order(world.samples.q)]
    T = world.world.tool_in_tracker(true(q)).copy()
    for first, tool, base in moved:
        T[first:] = se3.exp(np.array(base)) @ T[first:] @ se3.exp(np.array(tool))
    T = change(T)
    T[:, :3, 3] += NOISE_M * rng.standard_normal((COUNT, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((COUNT, 3)))
    return samples_of(ur10(), q, T, kind)


def found(samples: Samples) -> list[tuple[int, str]]:
    """First station of each regime but the first, and what moved."""
    model = find_regimes(samples, ur10(), Cell())
    if model is None:
        return []
    return [(int(np.searchsorted(np.sort(samples.stamps), m.at)), m.what) for m in moves_of(model)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "moved", "expected"),
    [
        pytest.param("point", [(22, (0.01, 0, 0, 0, 0.1, 0), NOT)], [(22, "tool")], id="turned tool"),
        pytest.param("point", [(80, NOT, (0.2, 0.3, 0, 0, 0, 1.5))], [(80, "base")], id="base turned by 86 degrees"),
        pytest.param("pose", [(80, (0.05, 0, 0, 0, 2.5, 0), NOT)], [(80, "tool")], id="another tool, half and half"),
        pytest.param(
            "point",
            [(50, (0, 0.01, 0, 0, 0.05, 0), NOT), (110, NOT, (0.01, 0, 0.02, 0, 0, 0.02))],
            [(50, "tool"), (110, "base")],
            id="tool, then base",
        ),
        pytest.param(
            "point", [(70, (0, 0.01, 0, 0, 0.3, 0), (0.1, 0, 0.02, 0, 0.4, 0.02))], [(70, "both")], id="both at once"
        ),
    ],
)
def test_what_moved_and_when(kind: str, moved: list[Moved], expected: list[tuple[int, str]]) -> None:
    assert found(recorded(moved, kind)) == expected


def nothing(T: Array) -> Array:
    return T


def settling(size: float) -> Callable[[Array], Array]:
    u = np.arange(COUNT) / COUNT
    axis = np.array([1.0, 0.5, 0.0, 0.3, 0.0, 0.2])
    return lambda T: se3.exp(size * np.exp(-u / 0.1)[:, None] * axis) @ T


def drifting(size: float) -> Callable[[Array], Array]:
    axis = np.array([1.0, 0.5, 0.0, 0.3, 0.0, 0.2])
    return lambda T: se3.exp(size * (np.arange(COUNT) / COUNT)[:, None] * axis) @ T


def wrong(share: float, size: float) -> Callable[[Array], Array]:
    def change(T: Array) -> Array:
        T = T.copy()
        T[np.random.default_rng(3).random(COUNT) < share, 0, 3] += size
        return T

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "change"),
    [
        pytest.param("point", nothing, id="clean"),
        pytest.param("pose", settling(0.01), id="settles 10 mm"),
        pytest.param("pose", drifting(0.05), id="drifts 50 mm"),
        pytest.param("point", wrong(0.45, 0.005), id="45 % wrong"),
    ],
)
def test_what_is_no_move(kind: str, change: Callable[[Array], Array]) -> None:
    assert found(recorded([], kind, change=change)) == []


def rings(q: Array) -> Array:
    """Joint 1 goes round once, in rings of 45 degrees."""
    return np.argsort(np.round(q[:, 0] * 4.0 / np.pi), kind="stable")


def eccentric(amplitude: float, cycles: float) -> Callable[[Array], Array]:
    return lambda q: q + np.c_[amplitude * np.sin(cycles * q[:, 0] + 0.3), np.zeros((len(q), 5))]


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "cycles"), [(0.0, 1.0), (0.02, 3.0)])
def test_rings_of_joint_1_are_no_moves(amplitude: float, cycles: float) -> None:
    assert found(recorded([], order=rings, true=eccentric(amplitude, cycles))) == []


def calibrated(samples: Samples) -> Solution:
    return calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)


@pytest.mark.slow
def test_a_regime_is_a_step_with_its_size_and_the_last_one_holds() -> None:
    samples = recorded([(50, (0, 0.01, 0, 0, 0.3, 0), NOT), (110, NOT, (0.01, 0, 0.02, 0, 0, 0))])
    result = calibrated(samples)
    report = result.report
    assert [(r.from_station, r.to_station, r.what) for r in report.grounds.regimes] == [
        (0, 49, "tool"),
        (50, 109, "tool"),
        (110, 159, "base"),
    ]
    steps = {f.place: f for f in report.effects}
    assert {(f.family, f.driver) for f in report.effects} == {("step", "time")}
    tool = [steps["tool"].parameters[d][0] for d in ("x", "y", "z", "rx", "ry", "rz")]
    np.testing.assert_allclose(tool, [0.0, 0.01, 0.0, 0.0, 0.3, 0.0], atol=2e-4)
    base = np.linalg.norm([steps["base"].parameters[d][0] for d in "xyz"])
    assert base == pytest.approx(np.hypot(0.01, 0.02), abs=2e-4)
    assert "10 mm and 300 mrad" in steps["tool"].sentence
    # all stations are met, and the model without its steps is that of the end
    assert report.rejection is not None
    assert report.rejection.stations == 0
    size = report.size_mm("final")
    assert size is not None
    assert size.rms < 0.2
    last = samples.select(slice(110, None))
    assert np.median(errors(result.calibration.calibrated.with_effects(()), last).position_norm) < 2e-4
    assert all(is_move(e) for e in result.calibration.calibrated.effects)


@pytest.mark.slow
def test_where_order_goes_with_posture_both_are_named() -> None:
    report = calibrated(recorded([(60, (0.02, 0, 0, 0, 0, 0.02), NOT)], order=rings, seed=2)).report
    (step,) = (f for f in report.effects if f.family == "step")
    assert "shoulder_pan_joint axis by position:shoulder_pan_joint" in step.same_as
    assert "either" in step.sentence
    assert "posture and time cannot be distinguished" in step.sentence


def test_no_move_is_looked_for_where_it_is_fixed() -> None:
    samples = recorded([(80, NOT, (0.02, 0, 0, 0, 0, 0))])
    model = find_regimes(samples, ur10(), Cell(fixed=("tool",)))
    assert model is not None
    assert [m.what for m in moves_of(model)] == ["base"]


def test_a_move_that_is_told_is_there_however_small() -> None:
    samples = recorded([(80, (5e-6, 0, 0, 0, 0, 0), NOT)])
    at = float(0.5 * (samples.stamps[79] + samples.stamps[80]))
    model = find_regimes(samples, ur10(), Cell(), stated=(Move(at, "tool"),))
    assert model is not None
    assert moves_of(model) == (Move(at, "tool"),)


@pytest.mark.parametrize(("shift", "possible"), [(0.012, True), (1.0, True), (171.0, False)])
def test_a_tool_does_not_move_by_more_than_the_arm_reaches(shift: float, possible: bool) -> None:
    """Where tools hardly turn, base and tool are one motion, and a search may put any length into either."""
    model = place_model(ur10(), ("tracker",))
    tool = step.moved("tool", SHIFT, 1.0).with_values(np.array([shift, 0.0, 0.0]))
    base = step.moved("base", SHIFT, 1.0).with_values(np.array([-shift, 0.0, 0.0]))
    assert is_possible(model.with_effects((tool, base))) == possible


def test_a_stated_target_is_no_effect_and_no_error_of_the_tool() -> None:
    """Rows of a table without a clock, the second half of them read at another target, as the table says."""
    samples = replace(recorded([(80, (0.1, 0, 0.05, 0, 0, 0), NOT)], "point"), clock=False)
    at = 0.5 * float(samples.stamps[79] + samples.stamps[80])
    solution = calibrate(samples, ur10(), np.random.default_rng(0), Cell(moved=(Move(at, "tool"),)))
    report = solution.report
    assert not [finding for finding in report.effects if finding.family == "step"]
    assert any(note.startswith("As stated") and "112 mm" in note for note in report.notes)
    size = report.errors["nominal"].size_mm()
    assert size is not None
    assert size.rms < 10.0, "the nominal arm, with both targets"
    assert not [row for row in report.judged.account_mm2 if "tool" in row.what]
    assert report.claim is not None
    assert report.claim.mm["p95"].ci95[1] < 0.5, "the tool at the last target"
