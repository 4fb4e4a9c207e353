"""Checks of a cell that was set up again: another frame, instrument and target moved at once, readings of another kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, Recorded, record, samples_of, ur10

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.store import Calibration
from modcal_core.checkup import Checked
from modcal_core.errors import BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.samples import Samples
from modcal_core.public import calibrate, check
from modcal_core.report.blocks import SummaryLine
from modcal_core.report.checkup import checkup_data, checkup_summary
from modcal_core.robot import Robot
from modcal_core.robots.kinematics import spatial_jacobian
from modcal_nodes.simulation.world import World

pytestmark = pytest.mark.slow
FLOOR = np.sqrt(3.0) * NOISE_M
ELSEWHERE = se3.exp([1.8, -0.7, 0.4, 0.3, -0.5, 2.1])  # where the instrument stands the next day
ANOTHER = se3.exp([0.04, -0.02, 0.06, 0.5, 0.3, -0.8])  # the target, mounted anew
Poses = Callable[[Array], Array]


@pytest.fixture(scope="module")
def cell() -> tuple[Recorded, Calibration]:
    """A world, and what was calibrated from eighty stations of it."""
    recorded = record(4, 80)
    return recorded, calibrate(Robot(ur10()), recorded.samples, geometry_only=True).calibration


def checked(
    cell: tuple[Recorded, Calibration],
    seen: Callable[[Array, Poses], Array],
    seed: int = 0,
    count: int = 12,
    kind: str = "pose",
    frame: str = "tracker",
) -> tuple[Checked, Array]:
    """A check by stations at random postures, and where the tool truly was at a hundred others."""
    rng = np.random.default_rng([seed, 12])
    q = rng.uniform(-2.5, 2.5, (count, 6))
    T = seen(q, cell[0].world.tool_in_tracker).copy()
    T[:, :3, 3] += NOISE_M * rng.standard_normal((count, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((count, 3)))
    read = {"poses": T} if kind == "pose" else {"points": T[:, :3, 3]}
    samples = Samples.from_arrays(q, names=ur10().names, stamps=1e6 + 5.0 * np.arange(count), frame=frame, **read)
    fresh = np.random.default_rng(78).uniform(-2.5, 2.5, (100, 6))
    return check(cell[1], samples), seen(fresh, cell[0].world.tool_in_tracker)


def missed(calibration: Calibration, truth: Array, frame: str) -> float:
    """RMS distance [m] of predictions at a hundred postures from where the tool is."""
    fresh = np.random.default_rng(78).uniform(-2.5, 2.5, (100, 6))
    away = calibration.predict(fresh, frame)[:, :3, 3] - truth[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def names(found: Checked) -> set[tuple[str, str]]:
    return {(c.kind, c.place) for c in found.changes}


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_an_unknown_frame_is_placed_and_no_change(cell: tuple[Recorded, Calibration], kind: str) -> None:
    first = f"zero of {ur10().names[0]}"
    for seed in range(2):
        found, truth = checked(cell, lambda q, world: ELSEWHERE @ world(q), seed, kind=kind, frame="leica")
        assert found.status == "unchanged", found.sentence
        assert "where frame leica stands was found" in found.sentence
        assert found.advice.action == "refit_base"
        assert not {"base", "frame"} & {n.label for n in found.noticed}
        zeros = next(n for n in found.noticed if n.label == "joint zero")
        assert zeros.unseen == (first,)  # the frame that was placed takes it up
        assert zeros.mm < 10.0
        assert checkup_data(found)["not_noticed"] == [first]
        lines = [line.text for line in checkup_summary(found) if isinstance(line, SummaryLine)]
        assert any(line.endswith(f"These stations do not show: {first}.") for line in lines)
        assert found.expected[0] is not None
        assert found.expected[0] < 2e3 * FLOOR
        assert found.repaired is not None
        assert found.repaired.frames == ("tracker", "leica")
        assert missed(found.repaired, truth, "leica") < 1.2 * FLOOR
        assert found.report.claim is not None
        assert found.report.claim.mm["p95"].ci95[1] > 1e3 * missed(found.repaired, truth, "leica")


@pytest.mark.parametrize(
    ("name", "seen"),
    [
        (("tool", "tool"), lambda q, world: world(q) @ se3.exp(3e-4 * np.array([1, 0.5, -1, 1, -1, 1]))),
        (("joint_zero", "elbow_joint"), lambda q, world: world(q + 8e-4 * np.eye(6)[2])),
    ],
)
def test_a_change_is_named_beside_an_unknown_frame(
    cell: tuple[Recorded, Calibration], name: tuple[str, str], seen: Callable[[Array, Poses], Array]
) -> None:
    for seed in range(2):
        found, truth = checked(cell, lambda q, world: ELSEWHERE @ seen(q, world), seed, 16, frame="leica")
        assert name in names(found), found.sentence
        assert len(found.changes) == 1
        assert found.repaired is not None
        assert missed(found.repaired, truth, "leica") < 1.2 * FLOOR


def test_instrument_and_target_that_were_set_up_again_are_base_and_tool(cell: tuple[Recorded, Calibration]) -> None:
    for seed in range(2):
        found, truth = checked(cell, lambda q, world: ELSEWHERE @ world(q) @ ANOTHER, seed)
        assert names(found) == {("base", "base"), ("tool", "tool")}, found.sentence
        assert found.status == "changed"
        assert found.repaired is not None
        assert missed(found.repaired, truth, "tracker") < 1.2 * FLOOR


def test_of_another_target_in_an_unknown_frame_the_tool_is_named(cell: tuple[Recorded, Calibration]) -> None:
    for kind in ("pose", "point"):
        found, _ = checked(cell, lambda q, world: ELSEWHERE @ world(q) @ ANOTHER, 1, 20, kind, "leica")
        assert names(found) == {("tool", "tool")}, found.sentence
        assert any("a moved tool is that target" in note for note in found.notes)


def test_a_zero_is_named_beside_base_and_tool_that_were_set_up_again(cell: tuple[Recorded, Calibration]) -> None:
    for joint in (1, 2, 3):
        found, truth = checked(
            cell, lambda q, world, j=joint: ELSEWHERE @ world(q + 1e-3 * np.eye(6)[j]) @ ANOTHER, joint, 20
        )  # type: ignore[misc]
        assert names(found) == {("base", "base"), ("tool", "tool"), ("joint_zero", ur10().names[joint])}, found.sentence
        assert found.repaired is not None
        assert missed(found.repaired, truth, "tracker") < 1.2 * FLOOR


def test_another_arm_of_the_make_is_not_explained_by_setting_up_again(cell: tuple[Recorded, Calibration]) -> None:
    for seed, frame in ((9, "tracker"), (10, "leica")):
        other = replace(record(seed, 14).samples, frames=(frame,))
        assert check(cell[1], other).status == "unexplained"


def held(world: World, frame: str, zero: Array, rng: np.random.Generator, count: int = 14) -> Samples:
    """Joints that MuJoCo's arm has with its ball in one socket, to a tenth of the noise. zero: what joints report more
    than they are [rad].
    """
    chain, q = ur10(), rng.uniform(-1.2, 1.2, (1, 6)) + rng.uniform(-0.7, 0.7, (4 * count, 6))
    socket = world.tool_in_tracker(q[:1])[0, :3, 3]
    for _ in range(60):
        gap = socket - world.tool_in_tracker(q)[:, :3, 3]
        J = spatial_jacobian(
            chain, q
        )  # of the drawing, with the ball where it is: near enough to come closer each time
        p = world.tool_in_tracker(q)[:, :3, 3]
        Jp = J[:, :3] + np.cross(J[:, 3:], p[:, :, None], axis=1)
        step = np.swapaxes(Jp, 1, 2) @ np.linalg.solve(Jp @ np.swapaxes(Jp, 1, 2) + 1e-6 * np.eye(3), gap[..., None])
        q = q + np.clip(step[..., 0], -0.3, 0.3)
    q = q[np.linalg.norm(gap, axis=1) < 1e-6][:count]
    assert len(q) == count
    q = q + zero + 2e-5 * rng.standard_normal(q.shape)
    T = np.tile(np.eye(4), (count, 1, 1))
    return replace(samples_of(chain, q, T, "point", frame), sockets=(frame,))


def together(parts: list[Samples]) -> Samples:
    out = parts[0]
    for part in parts[1:]:
        out = out.followed_by(part)
    return out


def test_sockets_of_another_place_are_placed_and_the_arm_is_checked() -> None:
    """A ball in sockets: the next day the plate lies elsewhere, and its sockets have other names."""
    rng = np.random.default_rng(9)
    world = World(ur10(), rng, T_tip_tool=se3.transform(p=[0.03, 0.02, 0.15]))
    still, zero = np.zeros(6), np.zeros(6)
    zero[2] = 1.5e-3
    before = together([held(world, f"left_{k}", still, rng) for k in range(4)])
    known = Cell(sockets=before.frames)
    calibration = calibrate(Robot(ur10()), before, cell=known, geometry_only=True).calibration
    for moved, status in ((still, "unchanged"), (zero, "changed")):
        after = together([held(world, f"right_{k}", moved, rng) for k in range(3)])
        found = check(calibration, after, cell=Cell(sockets=after.frames))
        assert (found.status == "unchanged") == (status == "unchanged"), found.sentence
        labels = {label for c in found.changes for label in (c.label, *c.same_as)}
        assert not moved.any() or "zero of elbow_joint" in labels, found.sentence


def test_beyond_the_calibrated_ranges_scatter_may_be_the_calibration(cell: tuple[Recorded, Calibration]) -> None:
    narrow = replace(cell[1], seen=np.array([np.full(6, -0.5), np.full(6, 0.5)]))
    rng = np.random.default_rng(5)
    q = rng.uniform(-2.5, 2.5, (14, 6))
    for noise, tool, kind in ((4.0, 0.0, "tracker_noise"), (1.0, 3e-4, "tool")):
        T = cell[0].world.tool_in_tracker(q) @ se3.exp(tool * np.array([1, 0.5, -1, 1, -1, 1]))
        T[:, :3, 3] += noise * NOISE_M * rng.standard_normal((14, 3))
        T[:, :3, :3] = T[:, :3, :3] @ so3.exp(noise * NOISE_RAD * rng.standard_normal((14, 3)))
        samples = Samples.from_arrays(q, poses=T, names=ur10().names)
        for calibration, doubted in ((cell[1], False), (narrow, kind == "tracker_noise")):
            found = check(calibration, samples)
            assert [c.kind for c in found.changes] == [kind], found.sentence
            assert ("beyond the joint ranges" in found.sentence) == doubted
            assert (found.advice.action == "add_stations") == doubted
            if doubted:
                assert found.status == "ambiguous"
                assert np.isin(found.advice.stations, calibration.postures).all()


def test_readings_that_place_no_frame_are_refused(cell: tuple[Recorded, Calibration]) -> None:
    q = np.random.default_rng(0).uniform(-2.5, 2.5, (10, 6))
    samples = Samples.from_arrays(q, poses=cell[0].world.tool_in_tracker(q), names=ur10().names, frame="wire")
    ranges = replace(samples, kind=np.full(10, "range", dtype=KIND_NAMES), reading=np.full((10, 3), 1.5))
    with pytest.raises(BadTable, match="such readings do not place it"):
        check(cell[1], ranges, cell=Cell())
