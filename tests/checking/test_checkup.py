"""What a check names and repairs when one thing has changed, what is put back by hand, and which stations it looks at."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from cells import NOISE_M, record, ur10
from checking.checks import (
    FLOOR,
    FRESH,
    Cell,
    Poses,
    Seen,
    about,
    checked,
    missed,
    names,
    postures,
    readings,
    rms,
    twist,
)

from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dwells import spread_rows
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.moves.history import series_of
from modcal_core.moves.known import spread_out
from modcal_core.moves.likelihood import witnesses
from modcal_core.public import calibrate, check
from modcal_core.report.checkup import checkup_data
from modcal_core.robot import Robot
from modcal_core.robots import forward
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow
BASE, TOOL = ("base", "base"), ("tool", "tool")
MOVE = twist(1.5e-4, (1, -1, 1, 0.5, 1, -0.5))


def zero(joint: int, size: float) -> Seen:
    return lambda q, world: world(q + about(joint, size))


def target(*motion: float) -> Seen:
    return lambda q, world: world(q) @ se3.exp(np.array(motion))


def curve(joint: int, size: float, cycles: float) -> Seen:
    return lambda q, world: world(q + np.outer(size * np.sin(cycles * q[:, joint] + 0.4), np.eye(6)[joint]))


def scaled(q: Array, world: Poses) -> Array:
    T = world(q).copy()
    T[:, :3, 3] *= 1.0 + 4e-4
    return T


def bent(link: int, *bend: float) -> Seen:
    """A link that is no longer straight."""
    origins = ur10().origins.copy()
    origins[link] = origins[link] @ se3.exp(np.array(bend))
    root = record(3, 1).world.T_tracker_base  # as in the cell
    arms = ur10().with_origins(origins), ur10()

    def seen(q: Array, world: Poses) -> Array:
        after, before = (forward(arm, q) for arm in arms)
        return root @ after @ se3.inverse(before) @ se3.inverse(root) @ world(q)

    return seen


def loose(q: Array, world: Poses) -> Array:
    """A tool that rests on one side or the other, by whether its weight turns the second wrist joint forwards."""
    little = about(4, 1e-4)
    rise = forward(ur10(), q + little)[:, 2, 3] - forward(ur10(), q - little)[:, 2, 3]
    return world(q) @ se3.exp(np.sign(rise)[:, None] * np.array([3e-4, 0.0, 0.0, 0.0, 1e-3, 5e-4]))


@dataclass(frozen=True)
class Change:
    """seen, and what is to be named of it, by poses and by points (empty: nothing). words: of the sentence. left: RMS
    that the repair may miss by, in noise of a reading; None where predictions are not what is read.
    """

    seen: Seen
    expected: set[tuple[str, str]]
    kinds: tuple[str, ...] = ("pose", "point")
    words: str = ""
    left: float | None = 1.0
    count: int = 10


CHANGES = {
    "base": Change(lambda q, world: MOVE @ world(q), {BASE}),
    "far base": Change(lambda q, world: se3.exp([0.2, -0.1, 0.05, 0.3, 0.2, -0.4]) @ world(q), {BASE}, left=2.0),
    "tracker turned": Change(lambda q, world: twist(2e-3, (0, 0, 0, 0, 0, 1)) @ world(q), {BASE}, words="the tracker"),
    "tool": Change(target(2e-4, 1e-4, -2e-4, 2e-4, -2e-4, 2e-4), {TOOL}),
    "target aside": Change(target(1.2e-3, 0, 0, 0, 0, 0), {TOOL}, words="or the target has moved"),
    "target along the axis": Change(target(0, 0, 1.2e-3, 0, 0, 0), {TOOL}),
    "target turned": Change(target(0, 0, 0, 0, 0, 5e-3), {TOOL}, ("pose",), words="0.28"),
    "zero": Change(zero(2, 8e-4), {("joint_zero", "elbow_joint")}),
    "two zeros": Change(
        lambda q, world: world(q + np.radians(3.0) * (np.eye(6)[1] + np.eye(6)[4])),
        {("joint_zero", "shoulder_lift_joint"), ("joint_zero", "wrist_2_joint")},
    ),
    "scale": Change(scaled, {("tracker_scale", "tracker")}, left=None),
    "gear": Change(curve(3, 1e-3, 101.0), {("gear", "wrist_1_joint")}, ("pose",), "at 101 a turn"),
    "bent link": Change(bent(2, 0, 0, 0, 0, 3e-3, 0), {("link", "elbow_joint")}, left=2.0, count=16),
    "loose tool": Change(loose, {("tool_play", "tool")}, words="loose"),
    "base and zero": Change(
        lambda q, world: twist(4e-4, (1, -1, 1, 0.5, 1, -0.5)) @ world(q + about(2, 8e-4)),
        {BASE, ("joint_zero", "elbow_joint")},
        count=14,
    ),
}


@pytest.mark.parametrize(("name", "kind"), [(name, kind) for name, change in CHANGES.items() for kind in change.kinds])
def test_a_change_is_named_and_repaired(cell: Cell, name: str, kind: str) -> None:
    change = CHANGES[name]
    found = checked(cell, change.seen, count=change.count, kind=kind)
    assert names(found) == change.expected, found.sentence
    assert change.words in found.sentence
    assert all(c.moved_mm[1] <= c.moved_mm[0] <= c.moved_mm[2] for c in found.changes)
    if change.left is not None:
        left, before = missed(cell, found.repaired, change.seen), missed(cell, cell[1], change.seen)
        assert left < max(change.left * FLOOR, 0.01 * before)
        assert left < 0.6 * before or name == "target turned"  # which moves no point


def test_nothing_is_named_while_nothing_has_changed(cell: Cell) -> None:
    for seed in range(3):
        found = checked(cell, lambda q, world: world(q), seed)
        assert found.status == "unchanged", found.sentence
        assert found.advice.action == "nothing"
        assert found.repaired is None
        assert all(3.0 * n.mm > 1e3 * FLOOR / 3.0 for n in found.noticed)  # ten stations do not show what is far below


def test_sizes_lie_in_their_intervals_and_claims_cover_what_a_repair_misses_by(cell: Cell) -> None:
    inside, ratios, move = 0, [], twist(2e-4, (1, -1, 1, 0.5, 1, -0.5))
    for seed in range(8):
        found = checked(cell, zero(1, 6e-4), seed)
        (size,) = found.changes[0].sizes
        assert size.unit == "mrad"
        inside += size.low <= 0.6 <= size.high
        found = checked(cell, lambda q, world: move @ world(q), seed)
        truth = move @ cell[0].world.tool_in_tracker(FRESH)
        gap = np.linalg.norm(found.repaired.predict(FRESH)[:, :3, 3] - truth[:, :3, 3], axis=1)
        ratios.append(found.report.claim.mm["p95"].ci95[1] / (1e3 * np.percentile(gap, 95)))
    assert inside >= 6  # of eight intervals of 95 %, fewer once in two hundred times
    assert np.sum(np.array(ratios) >= 1.0) >= 7
    assert np.median(ratios) < 3.0


def test_a_curve_without_a_form_asks_for_stations_along_it(cell: Cell) -> None:
    wander = np.random.default_rng(5)  # another error at every posture
    found = checked(cell, lambda q, world: world(q + np.outer(8e-4 * wander.standard_normal(len(q)), np.eye(6)[3])))
    assert names(found) == {("gear", "wrist_1_joint")}
    assert found.advice.action == "add_stations"
    assert found.repaired is None
    assert np.ptp(found.advice.stations[:, 3]) > 4.5


def test_one_wrong_reading_is_set_aside(cell: Cell) -> None:
    def seen(q: Array, world: Poses) -> Array:
        T = world(q)
        T[4, :3, 3] += [2e-3, -1e-3, 1e-3]
        return T

    found = checked(cell, seen)
    assert found.status == "unchanged"
    assert found.aside == (5,)


@pytest.mark.parametrize(("at", "kind"), [("elbow_joint", "pose"), ("z", "point")])
def test_stations_at_which_a_joint_or_a_coordinate_stands_at_its_limit_are_set_aside(
    cell: Cell, at: str, kind: str
) -> None:
    """What lies beyond is said to be the limit itself; a base that moved as well is named alone."""
    q = postures(8, 14)
    T = MOVE @ cell[0].world.tool_in_tracker(q)
    samples = readings(q, T, np.random.default_rng(8), kind=kind)
    field = "q" if at == "elbow_joint" else "reading"
    clipped = getattr(samples, field).copy()
    beyond = np.argsort(clipped[:, 2])[-3:]
    clipped[beyond, 2] = np.sort(clipped[:, 2])[-4] + 0.002
    found = check(cell[1], replace(samples, **{field: clipped}))  # type: ignore[arg-type]
    assert set(found.aside) == {int(i) + 1 for i in beyond}, found.sentence
    assert names(found) == {BASE}, found.sentence
    assert any(f"{at} at its limit" in note for note in found.notes)


@pytest.mark.parametrize("what", ["tool", "elbow_joint"])
def test_what_gives_way_under_a_recorded_load_only_is_named(cell: Cell, what: str) -> None:
    """A tool that shifts with what it holds; a joint whose spring has become softer under it."""
    q, rng = postures(9, 12), np.random.default_rng(9)
    kg = np.where(np.arange(12) % 3 == 0, 5.0, 0.0)
    T = cell[0].world.tool_in_tracker(q)
    if what == "tool":
        T = T @ se3.exp(kg[:, None] * np.array([1e-4, 0.0, -6e-5, 0.0, 2e-4, 0.0]))
    else:
        little = about(2, 1e-4)
        lever = (forward(ur10(), q + little)[:, 2, 3] - forward(ur10(), q - little)[:, 2, 3]) / 2e-4
        T = cell[0].world.tool_in_tracker(q - np.outer(9.81 * 3e-5 * kg * lever, np.eye(6)[2]))
    samples = readings(q, T, rng)
    samples = replace(samples, signals=(SignalTrack("signal:/payload_kg", samples.stamps, kg[:, None], "/payload_kg"),))
    found = check(cell[1], samples)
    assert names(found) == {("carried", "tool") if what == "tool" else ("load", what)}, found.sentence
    missed = np.linalg.norm(found.repaired.predict(samples)[:, :3, 3] - T[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(missed**2)) < FLOOR


def test_a_repaired_calibration_is_read_back_and_checks_clean(cell: Cell) -> None:
    found = checked(cell, CHANGES["tool"].seen)
    assert found.repaired is not None
    again = from_data(to_data(found.repaired))
    after = checked((cell[0], again), CHANGES["tool"].seen, seed=5)
    assert after.status == "unchanged", after.sentence
    # what ten stations say of a tool is less than what eighty did, and the covariance says so
    assert again.uncertainty.covariance.trace() > cell[1].uncertainty.covariance.trace()


FIRST, LAST = "shoulder_pan_joint", "wrist_3_joint"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joint", "place", "other", "name"), [(0, "base", "tracker", FIRST), (5, "tool", "target", LAST)]
)
def test_a_turn_about_an_outer_axis_is_put_back(cell: Cell, joint: int, place: str, other: str, name: str) -> None:
    found = checked(cell, lambda q, world: world(q + about(joint, 1e-3)))
    assert names(found) == {(place, place)}
    assert found.changes[0].same_as[:2] == (other, f"zero of {name}")
    assert found.changes[0].alike == "poses"
    assert found.status == "changed"  # the repaired poses are the same
    assert f"The {place} or the {other} has moved" in found.sentence


@pytest.mark.slow
@pytest.mark.parametrize("count", [8, 20])
def test_points_turn_no_flange(cell: Cell, count: int) -> None:
    """A target that was mounted a millimetre further round the last axis: the arm would be turned by degrees."""
    at = cell[0].world.tool_in_tracker
    angle = 1e-3 / (rms(at(FRESH + about(5, 1e-3)), at(FRESH)) / 1e-3)
    found = checked(cell, lambda q, world: world(q + about(5, angle)), 3, count, "point")
    assert names(found) == {("tool", "tool")}
    assert {"target", f"zero of {LAST}"} <= set(found.changes[0].same_as)
    assert found.changes[0].alike == "positions"
    assert "orientations" in found.sentence
    (said,) = checkup_data(found)["changes"]
    assert (said["same_at_every_posture"], said["same_orientation"]) == (True, False)
    old, new = cell[1].predict(FRESH), found.repaired.predict(FRESH)
    assert np.abs(so3.log(np.swapaxes(old[:, :3, :3], 1, 2) @ new[:, :3, :3])).max() < 1e-9
    assert missed(cell, found.repaired, lambda q, world: world(q + about(5, angle))) < 3.0 * NOISE_M


def raster(levels: int, joints: int) -> Samples:
    """A raster of postures, the last joint fastest, read as points."""
    q = np.array(list(itertools.product(np.linspace(-2.0, 2.0, levels), repeat=joints)))
    return Samples.from_arrays(q, points=np.zeros((len(q), 3)), stamps=np.arange(len(q), dtype=float))


def test_stations_of_a_raster_cover_every_joint_and_the_whole_time() -> None:
    samples = raster(12, 3)  # 1 728 stations
    part = spread_out(samples, 48)
    assert part.stations == 48
    for column in part.q.T:
        assert np.ptp(column) > 3.9
    gaps = np.diff(np.r_[-1, np.sort(part.stamps), len(samples)])
    assert gaps.max() <= 2 * len(samples) / 48
    every = samples.select(np.arange(0, len(samples), len(samples) // 48))
    assert np.ptp(every.q[:, 2]) < 0.1  # every 36th has the last joint where it was
    assert witnesses(part) > 2.0 * witnesses(every)
    assert witnesses(part) > 1.2 * witnesses(samples.select(spread_rows(len(samples), 48)))


DAY = 86400.0


def entries(
    values: list[float], std: float = 0.1, size: bool = True
) -> list[tuple[str, float, dict[str, tuple[str, float, float, bool]]]]:
    return [(f"e{i}", 30.0 * DAY * i, {"curve of j3": ("mrad", v, std, size)}) for i, v in enumerate(values)]


def test_growth_is_said_with_its_share() -> None:
    rng = np.random.default_rng(1)
    (series,) = series_of(entries(list(2.0 + 0.1 * np.arange(5) + 0.01 * rng.standard_normal(5)), std=0.02))
    assert series.trend.low < 0.4 < series.trend.high
    assert series.trend.share == pytest.approx(0.2, abs=0.03)
    assert series.sentence.startswith("The curve of j3 grew by 0.")
    assert series.sentence.endswith("% in 4 months.")


def test_of_noise_alone_few_series_have_a_trend() -> None:
    rng = np.random.default_rng(2)
    names = [f"zero of j{k}" for k in range(8)]
    found = 0
    for _ in range(300):
        draw = 0.1 * rng.standard_normal((4, 8))
        own = [(f"e{i}", i * DAY, {n: ("mrad", float(v), 0.1, False) for n, v in zip(names, draw[i], strict=True)})
               for i in range(4)]  # fmt: skip
        found += any(s.trend is not None for s in series_of(own))
    assert found <= 9  # 1 % of 300 is three; more than nine once in two thousand


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    """An arm with a gear's wave on its elbow."""
    found = calibrate(Robot(ur10()), record(3, 60).samples, geometry_only=True).calibration
    wave = Effect(
        "gear_harmonic", "elbow_joint", "axis", "position:elbow_joint", Shape("turn", {"cycles": 1.0}),
        np.array([1e-3, 0.0]), np.array([1e-5, 1e-5]),
    )  # fmt: skip
    return replace(found, calibrated=found.calibrated.with_effects((wave,)), uncertainty=found.uncertainty and replace(
        found.uncertainty, covariance=np.pad(found.uncertainty.covariance, (0, 2))
    ))  # fmt: skip


@pytest.mark.slow
def test_the_verb_reads_a_folder(calibration: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    begin = datetime(2026, 3, 1, tzinfo=UTC)
    (wave,) = calibration.calibrated.effects
    for month in range(5):
        grown = wave.with_values((1.0 + 0.05 * month) * wave.values, wave.std)
        part = tmp_path / f"c{month}"
        part.mkdir()
        replace(calibration, calibrated=calibration.calibrated.with_effects((grown,))).save(part / "calibration.yaml")
        date = (begin + timedelta(days=30 * month)).isoformat()
        (part / "report.json").write_text(json.dumps({"trace": {"date": date, "robot": "cell 3"}, "verdict": "Fine."}))
    (tmp_path / "k").mkdir()
    (tmp_path / "k" / "check.json").write_text(json.dumps({"date": "2026-04-15T10:00:00Z", "verdict": "Nothing."}))
    assert run(["history", str(tmp_path), "--json"]) == 0
    (robot,) = json.loads(capsys.readouterr().out)["robots"]
    assert robot["robot"] == "cell 3"
    assert [e["what"] for e in robot["entries"]].index("check") == 2  # in order of time
    grows = [s for s in robot["series"] if s["trend"]]
    assert [s["name"] for s in grows] == ["curve of elbow_joint"]
    assert grows[0]["trend"]["share"] == pytest.approx(0.2, abs=0.02)
    assert "elbow_joint grew by" in robot["verdict"]
    assert json.loads((tmp_path / "history.json").read_text())["robots"] == [robot]


def test_a_folder_without_any_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["history", str(tmp_path)]) == 2
    assert "holds no folder of modcal calibrate" in capsys.readouterr().err
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "check.json").write_text("{broken")
    assert run(["history", str(tmp_path)]) == 2
    assert "is not JSON" in capsys.readouterr().err
